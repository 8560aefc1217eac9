"""The descent to the volume that explains a stack, and what it is made of."""
