"""One command by several processes, as torchrun starts them."""
