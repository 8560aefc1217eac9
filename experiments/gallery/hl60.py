"""A measured cell, imaged and found again
=======================================

An HL60 cell, whose index a tomogram of the ODTbrain examples (CC0) gives, is imaged on the tomogram's fine voxels with
noise, and found again. Across z nucleus and nucleolus come out; along z so wide a cell isn't seen to end. The tomogram
is in the folder that TORCHDIC_DATA names; where that isn't set, this page shows the script without its picture.
"""

import os

import matplotlib.pyplot as plt
import numpy as np
import torch

from recon import Recipe, descend
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

if "TORCHDIC_DATA" not in os.environ:
    raise SystemExit("hl60.py: TORCHDIC_DATA must name the folder that holds ri_hl60_tomogram_derived.npz")
tomogram = np.load(f"{os.environ['TORCHDIC_DATA']}/ri_hl60_tomogram_derived.npz")
medium, half = float(tomogram["n_medium"]), 64 * float(tomogram["voxel_um"])  # 128³ of its voxels hold the cell
measured = (torch.from_numpy(tomogram["ri"])[None, 6:-6, 6:-6, 6:-6] - medium).clamp_min(0)
fine, grid = (Grid((nz, n, n), (2 * half / nz, 2 * half / n, 2 * half / n)) for nz, n in ((64, 128), (32, 92)))
cell, truth = (torch.nn.functional.interpolate(measured[None], g.shape, mode="area")[0, 0] for g in (fine, grid))
prisms = [Prism((0.0, 0.2), torch.pi / 2), Prism((0.2, 0.0), torch.pi / 2)]
lenses, plan = (0.546, Objective(0.8), Condenser(0.6)), Acquisition(prisms, [float(z) for z in range(-7, 8, 2)])
clean = image(Volume(fine, cell, medium), Microscope(*lenses, Camera(pixel_size=half / 46)), plan, Fidelity(sources=72))
data = Camera(photons=5000).record(clean, torch.Generator().manual_seed(0))
*_, last = descend(data, grid, medium, Microscope(*lenses), plan, Fidelity(sources=50), Recipe(steps=12))

shown = {"image, shear along x": data[0, 4], "truth, z = 0": truth[16], "found, z = 0": last.delta[16]}
shown |= {"image, shear along y": data[1, 4], "truth, y = 0": truth[:, 46], "found, y = 0": last.delta[:, 46]}
figure, axes = plt.subplots(2, 3, figsize=(10, 5.6), layout="constrained", sharex=True)
for axis, (title, picture) in zip(axes.flat, shown.items(), strict=True):
    colours = {"cmap": "gray", "vmin": 0.2, "vmax": 0.8} if "image" in title else {"vmin": 0, "vmax": 0.03}
    axis.imshow(picture, extent=(-half, half, half, -half), **colours)
    axis.set(title=title, xlabel="x, µm", ylabel="z, µm" if "y = 0" in title else "y, µm")
figure.colorbar(axes[0, 0].images[0], ax=axes[:, 0], label="of the empty bright field")
figure.colorbar(axes[0, 1].images[0], ax=axes[:, 1:], label="Δn")
plt.show()
