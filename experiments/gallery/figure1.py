"""The paper's Figure 1: a bead in and out of focus
================================================

A bead, 10 µm across, of index 1.59 in cement of 1.56, as Kagalwala and Kanade made it. Its exact field is a sum of
partial waves, in which none of torchdic's propagations takes part. The wave's images are shown above those of that
field. They differ by one or two hundredths of the images' standard deviation.
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from recon import exact_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid, bead = Grid((100, 100, 100), (0.1, 0.17, 0.17)), Bead(radius=5.0, contrast=0.03, background=1.56)
microscope, focus = Microscope(0.546, Objective(0.9), Condenser(0.7)), [0.0, 4.0, 8.0]
acquisition = Acquisition([Prism((0.0, 0.24), math.pi / 2)], focus)
fidelity = Fidelity("wave", sources=72, padding=grid.shape[1] // 2)  # as wide as the exact field
volume = Volume(grid, bead.delta(grid, dtype=torch.float32), bead.background)
wave = image(volume, microscope, acquisition, fidelity)[0]
exact = exact_images(bead, grid, microscope, acquisition, fidelity)[0]
errors = (wave - exact).square().mean((1, 2)).sqrt() / exact.std((1, 2), correction=0)

half, gray = grid.extent[1] / 2, {"cmap": "gray", "vmin": 0.15, "vmax": 0.85}
rows = {"wave": (wave, gray), "exact field": (exact, gray), "wave − exact": (wave - exact, {"cmap": "RdBu_r"})}
figure, axes = plt.subplots(3, 3, figsize=(8.6, 7.4), layout="constrained", sharex=True, sharey=True)
for row, (name, (stack, colours)) in zip(axes, rows.items(), strict=True):
    for axis, plane in zip(row, stack, strict=True):
        axis.imshow(plane, **{"vmin": -0.01, "vmax": 0.01} | colours, extent=(-half, half, half, -half))
    row[0].set_ylabel(f"{name}\ny, µm")
    figure.colorbar(row[0].images[0], ax=row, label="of the empty bright field")
for top, bottom, z, error in zip(axes[0], axes[2], focus, errors, strict=True):
    top.set_title(f"focus {z:g} µm")
    bottom.set(xlabel="x, µm", title=f"rms {error:.3f} of the std")
plt.show()
