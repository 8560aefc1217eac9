"""A cell from its noisy images
============================

What a fit finds of a cell from two shear axes and nine planes of focus. The images come from finer voxels and more
directions than the fit's, and have the noise of 5000 photons per pixel. Nucleus and nucleoli come out where they are,
a little paler; along z, of which images say least, a faint haze is left above and below.
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import CellPhantom
from recon import Recipe, descend
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

cell, lenses = CellPhantom(), (0.546, Objective(0.9), Condenser(0.7))
grid, fine = Grid((18, 60, 68), (0.4, 0.17, 0.17)), Grid((54, 120, 136), (0.4 / 3, 0.085, 0.085))
prisms = [Prism((0.0, 0.2), math.pi / 2), Prism((0.2, 0.0), math.pi / 2)]
acquisition = Acquisition(prisms, focus=[float(z) for z in range(-4, 5)])
volume = Volume(fine, cell.delta(fine, dtype=torch.float32), cell.background)
noiseless = image(volume, Microscope(*lenses, Camera(pixel_size=0.17)), acquisition, Fidelity(sources=128))
data = Camera(photons=5000).record(noiseless, torch.Generator().manual_seed(0))
*_, last = descend(data, grid, cell.background, Microscope(*lenses), acquisition, Fidelity(sources=72), Recipe())

truth, (depth, height, width) = cell.delta(grid), (side / 2 for side in grid.extent)
across, along = (-width, width, height, -height), (-width, width, -depth, depth)
figure, axes = plt.subplots(2, 3, figsize=(10, 5.6), layout="constrained", sharex=True)
for axis, shown, shear in zip(axes[:, 0], data[:, 4], "xy", strict=True):
    axis.imshow(shown, cmap="gray", vmin=0.2, vmax=0.8, extent=across)
    axis.set(title=f"focus 0 µm, shear along {shear}", xlabel="x, µm", ylabel="y, µm")
for column, delta, name in zip(axes.T[1:], (truth, last.delta), ("truth", "found"), strict=True):
    column[0].imshow(delta[7], vmin=0, vmax=0.05, extent=across)  # across z through the nucleus
    column[1].imshow(delta[:, 33], vmin=0, vmax=0.05, extent=along, origin="lower")
    for axis, title, down in zip(column, ("z = −0.6 µm", "y = 0.6 µm"), "yz", strict=True):
        axis.set(title=f"{name}, {title}", xlabel="x, µm", ylabel=f"{down}, µm")
figure.colorbar(axes[0, 0].images[0], ax=axes[:, 0], label="of the empty bright field")
figure.colorbar(axes[0, 1].images[0], ax=axes[:, 1:], label="Δn")
plt.show()
