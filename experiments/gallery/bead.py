"""A bead
======

Three focus planes of a 4 µm bead of index 1.59 in optical cement of 1.56, in DIC. The image is brighter than the
background where the optical path rises along the shear, which goes to the right, and darker where it falls.
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid = Grid(shape=(40, 64, 64), spacing=(0.125, 0.15, 0.15))  # (z, y, x) voxels, µm
bead = Bead(radius=2.0, contrast=0.03, background=1.56)
volume = Volume(grid, bead.delta(grid, dtype=torch.float32), bead.background)
microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
focus = [-2.0, 0.0, 2.0]
images = image(volume, microscope, Acquisition([Prism((0.0, 0.24), math.pi / 2)], focus), Fidelity("wave"))

half = grid.extent[1] / 2
figure, axes = plt.subplots(1, 3, figsize=(9, 3.2), layout="constrained")
for axis, plane, z in zip(axes, images[0], focus, strict=True):
    axis.imshow(plane, cmap="gray", vmin=0.2, vmax=0.8, extent=(-half, half, half, -half))
    axis.set(title=f"focus {z:g} µm", xlabel="x, µm")
axes[0].set_ylabel("y, µm")
figure.colorbar(axes[0].images[0], ax=axes, label="intensity, of the empty bright field")
plt.show()
