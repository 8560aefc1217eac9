"""Measured agar beads: shear axis and phase
=========================================

A real image, of the dicsuite project (BSD-3), whose optics nobody has noted. Its spectrum tells the shear's axis, and
the image integrated along it is the phase, but for its scale; beads that the border cuts leave streaks. The image is in
the folder that TORCHDIC_DATA names; where that isn't set, this page shows the script without its picture.
"""

import math
import os

import matplotlib.pyplot as plt
import tifffile
import torch

from recon import background_surface, estimate_shear_axis, noise_level, phase_of_image

if "TORCHDIC_DATA" not in os.environ:
    raise SystemExit("agar_beads.py: TORCHDIC_DATA must name the folder that holds dic_agar_beads.tiff")
picture = tifffile.imread(f"{os.environ['TORCHDIC_DATA']}/dic_agar_beads.tiff")
shear = estimate_shear_axis(picture)
flat = picture / background_surface(picture)  # the lamp's unevenness is divided out
phase = phase_of_image(torch.from_numpy(flat), shear.direction, noise_level(flat))
phase = phase if phase.mean() >= 0 else -phase  # either sign explains the image; beads have more index than water

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", sharey=True)
shown = left.imshow(picture, cmap="gray")
left.axline((400, 300), (400 + 100 * shear.direction[1], 300 + 100 * shear.direction[0]), color="C1", linestyle="--")
angle, error = math.degrees(shear.angle), math.degrees(shear.uncertainty)
left.set(title=f"recorded, shear axis at {angle:.0f}° ± {error:.0f}°", xlabel="x, pixels", ylabel="y, pixels")
figure.colorbar(shown, ax=left, label="counts")
shown = right.imshow(phase, cmap="magma")
right.set(title="phase", xlabel="x, pixels")
figure.colorbar(shown, ax=right, label="on an unknown scale")
plt.show()
