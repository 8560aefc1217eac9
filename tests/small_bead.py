"""A bead that is simulated into made/stack.ome.tif and reconstructed within seconds, as a configuration."""

CONFIG = """
[volume]
shape = [6, 26, 24]
spacing = [0.5, 0.25, 0.25]
background = 1.4
[microscope]
wavelength = 0.546
objective = { na = 0.8 }
condenser = { na = 0.5 }
camera = { photons = 3000 }
[acquisition]
focus = [-1.0, 0.0, 1.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5 }, { shear = [0.24, 0.0], bias = 1.5 }]
[specimen]
kind = "bead"
radius = 1.0
contrast = 0.03
[data]
path = "made/stack.ome.tif"
[reconstruction]
steps = 4
[fidelity]
sources = 8
"""
