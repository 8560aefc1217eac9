"""Calibrating with a bead
=======================

A bead of known size and index tells the optics behind its noisy images: here the bias, the length of the shear and the
condenser's aperture, all told wrongly by 14 %. What is found lies within one standard deviation of the truth. Bias and
length are known less well than the aperture, because both grown together change the images little.
"""

import matplotlib.pyplot as plt
import torch

from data_synthetic import Bead
from recon import ModelledSpecimen, Setup, calibrate, empty_medium, exact_images
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism

grid, bead, focus = Grid((10, 36, 36), (0.3, 0.17, 0.17)), Bead(1.5, 0.06, 1.52), [-2.0, 0.0, 2.0]
true = Acquisition([Prism((0.0, 0.22), bias) for bias in (1.4, -1.4)], focus)
told = Acquisition([Prism((0.0, 0.25), bias) for bias in (1.6, -1.6)], focus)
noiseless = exact_images(bead, grid, Microscope(0.546, Objective(0.9), Condenser(0.7)), true, Fidelity(sources=128))
data = Camera(photons=5000).record(noiseless.float(), torch.Generator().manual_seed(0))
setup = Setup(empty_medium(grid, 1.52, data), Microscope(0.546, Objective(0.9), Condenser(0.6)), told)
found = calibrate(data, setup, ModelledSpecimen(bead.delta, height=3.0, width=3.0))

names, wrong = ["bias", "shear's length", "condenser's NA"], [1.6 / 1.4, 0.25 / 0.22, 0.6 / 0.7]
value, sure = found.values, found.deviations  # of length and NA: factors, and deviations of their logarithms
right = [float(value["bias"][0]) / 1.4, float(value["shear"][0, 0]) * wrong[1], float(value["condenser"]) * wrong[2]]
bars = [float(sure["bias"][0]) / 1.4, float(sure["shear"][0, 0]), float(sure["condenser"])]
figure, axis = plt.subplots(figsize=(6.5, 4), layout="constrained")
axis.axhline(1, color="gray", label="true")
axis.plot(names, wrong, "C1s", label="told")
axis.errorbar(names, right, bars, fmt="C0o", capsize=4, label="found, with its standard deviation")
axis.set(ylabel="over the true value", xlim=(-0.5, 2.5))
axis.legend()
plt.show()
