"""What a stack can say of a specimen, before it is recorded: frequencies that are seen, and resolution."""
