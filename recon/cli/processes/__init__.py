"""One command by several processes, as torchrun starts them, or the command itself."""
