"""Etched glass
============

A ridge of 0.3 µm, etched into glass and covered by water: the paper's other specimen. Its walls show only for a shear
across them. A thin step without a lens has a law: I = sin²((bias ± φ)/2) over the width of the shear at each wall,
where φ is the step's phase. The lens blurs it; the wave agrees with the same thin step seen through that lens.
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import EtchedGlassGrating
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field

grid, bias, shear = Grid((16, 96, 96), (0.025, 0.125, 0.125)), math.pi / 2, 0.25
glass = EtchedGlassGrating(height=0.3, glass=1.46, background=1.333, period=12.0, duty=0.4, offset=-2.4)
delta = glass.delta(grid, dtype=torch.float64)
microscope = Microscope(0.546, Objective(0.9), Condenser(0.3))
acquisition = Acquisition([Prism((0.0, shear), bias), Prism((shear, 0.0), bias)])
wave = image(Volume(grid, delta, glass.background), microscope, acquisition, Fidelity("wave"))[:, 0]
phase = 2 * math.pi / microscope.wavelength * grid.spacing[0] * delta.sum(0)
thin = image_field(torch.polar(torch.ones_like(phase), phase), grid, microscope, acquisition, background=1.333)[0, 0]
pixel = round(shear / grid.spacing[2] / 2)
law = torch.sin((bias + phase.roll(-pixel, 1) - phase.roll(pixel, 1)) / 2).square()

half, x = grid.extent[2] / 2, grid.coordinates(2, dtype=torch.float64)
figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained", width_ratios=(1, 1, 1.5))
for axis, shown, words in zip(axes, wave, ("across the walls", "along the walls"), strict=False):
    axis.imshow(shown, cmap="gray", vmin=0.3, vmax=0.7, extent=(-half, half, half, -half))
    axis.set(title=f"shear {words}", xlabel="x, µm", ylabel="y, µm")
figure.colorbar(axes[0].images[0], ax=axes[:2], label="of the empty bright field")
for profile, words, style in ((law, "law, no lens", "k:"), (thin, "thin, lens", "C1"), (wave[0], "wave, lens", "C0--")):
    axes[2].plot(x, profile[grid.shape[1] // 2], style, label=words)
axes[2].set(title="profile across the walls", xlabel="x, µm", ylabel="of the empty bright field")
axes[2].legend()
plt.show()
