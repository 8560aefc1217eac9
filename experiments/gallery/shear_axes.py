"""One or two shear axes
=====================

Two faint rods lie across each other. The one along the shear has no edge across it and hardly shows: a fit to images of
one shear axis finds a quarter of its Δn, and most of the other's. Two axes find both alike. The light is the same: 4000
photons per pixel of one shear, or 2000 of each of two. (Out of focus both rods show a little, as without a prism.)
"""

import math

import matplotlib.pyplot as plt
import torch

from data_synthetic import Ellipsoid
from recon import Recipe, descend
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

grid, focus = Grid((12, 72, 72), (0.4, 0.17, 0.17)), [-0.5, 0.5]
along_y, along_x = Ellipsoid((0.9, 3.4, 0.9), (0.0, -1.4, -3.2)), Ellipsoid((0.9, 0.9, 3.4), (0.0, 3.2, 1.6))
truth = 0.01 * (along_y.fill(grid) + along_x.fill(grid)).float()
microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
prisms, images, volumes = [Prism((0.0, 0.2), math.pi / 2), Prism((0.2, 0.0), math.pi / 2)], {}, {}
for name, used in (("found by shear x", prisms[:1]), ("found by both", prisms)):
    acquisition, camera = Acquisition(used, focus), Camera(photons=4000 / len(used))
    noiseless = image(Volume(grid, truth, 1.335), microscope, acquisition, Fidelity(sources=128))
    data = camera.record(noiseless, torch.Generator().manual_seed(0))
    *_, last = descend(data, grid, 1.335, microscope, acquisition, Fidelity(sources=72), Recipe())
    images |= {f"image, shear {axis}": planes[0] for axis, planes in zip("xy", data, strict=False)}
    volumes[name] = last.delta[6]

half = grid.extent[1] / 2
figure, axes = plt.subplots(1, 5, figsize=(11, 3.6), layout="constrained", sharex=True, sharey=True)
for axis, (title, picture) in zip(axes, {**images, **volumes, "truth": truth[6]}.items(), strict=True):
    colours = {"cmap": "gray", "vmin": 0.35, "vmax": 0.65} if "image" in title else {"vmin": 0, "vmax": 0.012}
    axis.imshow(picture, extent=(-half, half, half, -half), **colours)
    axis.set(title=title, xlabel="x, µm")
axes[0].set_ylabel("y, µm")
figure.colorbar(axes[0].images[0], ax=axes[:2], label="of the empty bright field", location="bottom")
figure.colorbar(axes[2].images[0], ax=axes[2:], label="Δn", location="bottom")
plt.show()
