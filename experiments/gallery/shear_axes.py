"""One or two shear axes
=====================

A rod that lies along the shear has no edge across it: with one shear axis its image is nearly flat but at its ends.
With a second shear, across the first, its sides show. Whatever is to be reconstructed in all directions wants two.
"""

import math

import matplotlib.pyplot as plt

from data_synthetic.ellipsoid import Ellipsoid
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid = Grid(shape=(16, 64, 80), spacing=(0.2, 0.15, 0.15))
rod = Ellipsoid(semi_axes=(0.7, 0.7, 4.5))  # along x
volume = Volume(grid, 0.02 * rod.fill(grid).float(), 1.335)
microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
shears = {"shear along x, along the rod": (0.0, 0.2), "shear along y, across the rod": (0.2, 0.0)}
acquisition = Acquisition([Prism(shear, math.pi / 2) for shear in shears.values()])
images = image(volume, microscope, acquisition, Fidelity("wave"))[:, 0]

_, height, width = grid.extent
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharey=True)
for axis, shown, title in zip(axes, images, shears, strict=True):
    contrast = float(shown.std() / shown.mean())
    axis.imshow(shown, cmap="gray", vmin=0.2, vmax=0.8, extent=(-width / 2, width / 2, height / 2, -height / 2))
    axis.set(title=f"{title}\ncontrast {100 * contrast:.1f} %", xlabel="x, µm")
axes[0].set_ylabel("y, µm")
plt.show()
