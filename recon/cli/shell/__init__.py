"""What makes the command line easier to type."""
