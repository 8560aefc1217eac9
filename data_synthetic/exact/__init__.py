"""The exact fields of a sphere and of a ball of any radial index, as sums of partial waves."""
