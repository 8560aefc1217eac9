"""The error of three propagations
===============================

The field behind a bead is known exactly, as a sum of partial waves. Straight rays, bent rays and the wave are compared
with it for beads of rising contrast; the error is the rms difference over the exact image's standard deviation.
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from recon import exact_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid = Grid(shape=(24, 56, 56), spacing=(0.15, 0.15, 0.15))
microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
acquisition = Acquisition([Prism((0.0, 0.24), math.pi / 2)], focus=[0.0])
contrasts = [0.005, 0.01, 0.02, 0.04, 0.08]
errors = {name: [] for name in ("projection", "rays", "wave")}
for contrast in contrasts:
    bead = Bead(1.5, contrast, 1.335)
    volume = Volume(grid, bead.delta(grid, dtype=torch.float32), bead.background)
    exact = exact_images(bead, grid, microscope, acquisition, Fidelity(sources=18))
    for name, found in errors.items():
        difference = image(volume, microscope, acquisition, Fidelity(name, sources=18)) - exact
        found.append(float(difference.square().mean().sqrt() / exact.std(correction=0)))

figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
for name, found in errors.items():
    axis.loglog(contrasts, found, "o-", label=name)
axis.set_xticks(contrasts, [str(contrast) for contrast in contrasts])
axis.set_yticks(ticks := [0.02, 0.05, 0.1, 0.2, 0.4], [str(tick) for tick in ticks])
axis.minorticks_off()
axis.set(xlabel="Δn of the bead, 3 µm across, in 1.335", ylabel="error of the image in focus")
axis.legend()
plt.show()
