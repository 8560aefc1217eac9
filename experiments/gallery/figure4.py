"""The paper's Figure 4: bent planes of focus
==========================================

An object bends the light of its own deeper parts. A point at z looks as if it were at z + δ, where δ, its effective
defocus, comes from the curvature of its wave at the lens. So what is sharp at a focus isn't a plane: here are the sharp
points of six focal planes (dotted: those of an empty medium) in an object with a depression on the lens' side.
"""

import math

import matplotlib.pyplot as plt
import torch

from torchdic import Grid, Volume
from torchdic.object_aberration.wavefront import effective_defocus


def covered(level):
    """1 where a level is below 1, 0 beyond, with an edge of 0.25 µm."""
    slope = torch.hypot(*torch.gradient(level, spacing=0.1)).clamp_min(1e-6)
    return torch.sigmoid((1 - level) / slope / 0.125)


grid, half_angle = Grid((46, 1, 130), (0.1, 0.1, 0.1)), math.asin(0.5 / 1.33)  # uniform along y; condenser's NA 0.5
z, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (0, 2))
body = covered(((z[:, None] / 1.5).abs() ** 3 + (x / 5).abs() ** 3) ** (1 / 3))
delta = 0.08 * body * (1 - covered(torch.hypot((z[:, None] - 1.9) / 1.3, (x - 1.2) / 2)))
volume, planes = Volume(grid, delta[:, None], 1.33), [-1.5, -1.0, -0.5, 0.0, 0.5, 1.0]
defocus = torch.stack([effective_defocus(volume, d, method="cone", half_angle=half_angle)[0] for d in z.tolist()])

box = {"origin": "lower", "extent": (-6.5, 6.5, -2.3, 2.3)}
figure, axes = plt.subplots(3, 1, figsize=(7, 7.4), layout="constrained", sharex=True, sharey=True)
index, shown = axes[0].imshow(1.33 + delta, **box), axes[1].imshow(defocus, cmap="RdBu_r", vmin=-0.6, vmax=0.6, **box)
sharp = axes[2].contour(x, z, z[:, None] + defocus, levels=planes, cmap="plasma")
axes[2].hlines(planes, -6.5, 6.5, colors=sharp.get_edgecolor(), linestyles=":")
for axis, drawn, label in ((axes[0], index, "index"), (axes[1], shown, "δ, µm"), (axes[2], sharp, "focus, µm")):
    figure.colorbar(drawn, ax=axis, label=label)
    axis.contour(x, z, delta, levels=[0.04], colors="gray", linewidths=0.8)
    axis.set(xlabel="x, µm", ylabel="z, µm (light goes up)", aspect="equal")
plt.show()
