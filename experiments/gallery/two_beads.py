"""Two beads, one above the other
==============================

Light meets the lower bead first. A straight projection adds the paths of both into one plane between them, so that
neither bead is sharp where it lies. The wave has each sharp in its own plane, and the other blurred.
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid = Grid(shape=(64, 64, 64), spacing=(0.125, 0.15, 0.15))
beads = [Bead(1.6, 0.03, 1.56, centre=(-1.9, -0.5, -0.5)), Bead(1.6, 0.03, 1.56, centre=(1.9, 0.5, 0.5))]
delta = torch.stack([bead.delta(grid, dtype=torch.float32) for bead in beads]).sum(0)
volume = Volume(grid, delta, 1.56)
microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
acquisition = Acquisition([Prism((0.0, 0.24), math.pi / 2)], focus=[-1.9, 1.9])
stacks = {name: image(volume, microscope, acquisition, Fidelity(name))[0] for name in ("projection", "wave")}

half = grid.extent[1] / 2
figure, axes = plt.subplots(2, 2, figsize=(7.5, 6.4), layout="constrained", sharex=True, sharey=True)
for row, (name, stack) in zip(axes, stacks.items(), strict=True):
    for axis, plane, which in zip(row, stack, ("lower", "upper"), strict=True):
        axis.imshow(plane, cmap="gray", vmin=0.2, vmax=0.8, extent=(-half, half, half, -half))
        axis.set(title=f"{name}: {which} bead in focus")
    row[0].set_ylabel("y, µm")
for axis in axes[1]:
    axis.set_xlabel("x, µm")
figure.colorbar(axes[0, 0].images[0], ax=axes, label="of the empty bright field")
plt.show()
