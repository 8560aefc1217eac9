"""What memory is free, what a computation holds, and how it is kept within bounds. It knows no optics."""
