"""How far the model's images are from the measured ones, the number that a descent lowers: a file per kind of noise."""
