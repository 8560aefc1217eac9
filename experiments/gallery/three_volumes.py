"""One stack, three propagations
=============================

The same images, from a bead's exact field, are fitted through straight rays, bent rays and the wave. A sharp edge
diffracts, and rays know nothing of diffraction: what they can't explain they put into the volume, which is drawn out
along z and uneven at its edge. The wave finds the bead. (Rays are fitted by Adam, which suits them better.)
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from recon import Recipe, descend, exact_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism

grid, bead = Grid((16, 40, 40), (0.35, 0.17, 0.17)), Bead(radius=1.8, contrast=0.03, background=1.56)
microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
prisms = [Prism((0.0, 0.24), math.pi / 2), Prism((0.24, 0.0), math.pi / 2)]
acquisition = Acquisition(prisms, focus=[-3.0, -1.5, 0.0, 1.5, 3.0])
data = exact_images(bead, grid, microscope, acquisition, Fidelity(sources=50)).float()
volumes = {"truth": bead.delta(grid, dtype=torch.float32)}
for name, recipe in {"projection": Recipe("adam", 40), "rays": Recipe("adam", 40), "wave": Recipe("newton")}.items():
    *_, last = descend(data, grid, 1.56, microscope, acquisition, Fidelity(name, sources=32), recipe)
    volumes[name] = last.delta

depth, height, width = (side / 2 for side in grid.extent)
figure, axes = plt.subplots(2, 4, figsize=(10.5, 5), layout="constrained", sharex=True, sharey="row")
for column, (name, delta) in zip(axes.T, volumes.items(), strict=True):
    error = float((delta - volumes["truth"]).norm() / volumes["truth"].norm())
    column[0].imshow(delta[8], vmin=0, vmax=0.04, extent=(-width, width, height, -height))
    column[1].imshow(delta[:, 20], vmin=0, vmax=0.04, extent=(-width, width, -depth, depth), origin="lower")
    column[0].set_title(name if name == "truth" else f"{name}: error {error:.2f}")
    column[1].set_xlabel("x, µm")
axes[0, 0].set_ylabel("y, µm")
axes[1, 0].set_ylabel("z, µm")
figure.colorbar(axes[0, 0].images[0], ax=axes, label="Δn")
plt.show()
