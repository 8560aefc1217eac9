"""The folder of a run: whether it can be written to, and whether it holds what must not be replaced unasked."""
