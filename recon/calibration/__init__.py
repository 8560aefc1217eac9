"""What the images tell of the optics: signs and orders by short fits, and values with their uncertainties."""
