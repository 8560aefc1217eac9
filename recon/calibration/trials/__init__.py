"""Short fits with several descriptions of a stack: which of them, or which value, explains it best."""
