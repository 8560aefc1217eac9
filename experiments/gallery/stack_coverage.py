"""What a stack can say, before it is recorded
===========================================

Each spatial frequency of a specimen is seen by a stack or guessed. Which ones is known from optics, planes and noise.
Above: waves across z. One shear axis sees less of what hardly changes along it (left border); two see all directions
alike. Below: waves along x and z. Nothing sees the missing cone, the dark wedge: what is wide isn't told in depth.
"""

import math

import matplotlib.pyplot as plt
import torch

from recon import ExpectedSpecimen, NoisyAcquisition, shot_noise
from torchdic import Acquisition, Condenser, Grid, Microscope, Objective, Prism

grid, microscope = Grid((24, 48, 48), (0.35, 0.17, 0.17)), Microscope(0.546, Objective(0.9), Condenser(0.7))
prisms = [Prism((0.0, 0.2), math.pi / 2), Prism((0.2, 0.0), math.pi / 2)]
plans = {"shear along x, 2000 photons": (prisms[:1], 2000), "x and y, 1000 photons each": (prisms, 1000)}
fz, fy, fx = (0.5 / side for side in grid.spacing)  # the highest frequencies

colours = {"vmin": 0, "vmax": 1, "cmap": "magma", "aspect": "auto"}
figure, axes = plt.subplots(2, 2, figsize=(8, 7), layout="constrained", sharex=True)
for column, (name, (used, photons)) in zip(axes.T, plans.items(), strict=True):
    acquisition = Acquisition(used, focus=[float(z) for z in range(-4, 5)])
    noise = (shot_noise(math.sin(math.pi / 4) ** 2, photons),) * len(used)
    found = NoisyAcquisition(grid, 1.335, microscope, acquisition, noise).coverage(ExpectedSpecimen(contrast=0.02))
    column[0].imshow(torch.fft.fftshift(found.seen[..., 0], dim=0), extent=(0, fx, fy, -fy), **colours)
    column[0].set(title=f"{name}:\n{found.share:.0%} are seen", ylabel="frequency along y, 1/µm")
    column[1].imshow(found.seen[0].T, extent=(0, fx, 0, fz), origin="lower", **colours)
    column[1].set(xlabel="frequency along x, 1/µm", ylabel="frequency along z, 1/µm")
figure.colorbar(axes[0, 0].images[0], ax=axes, label="seen (1) or guessed (0)")
plt.show()
