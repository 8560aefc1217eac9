"""Choosing planes and a bias
==========================

Which planes and which bias show most of a specimen 6 µm deep? Coverage answers before anything is recorded, by how many
frequencies are seen, here with the same light in all stacks. Seven planes want to be about 1 µm apart, and more
planes gain nothing. Biases of 30° to 60° are best: above, the background's noise grows; below, the camera's counts.
"""

import math

import matplotlib.pyplot as plt

from recon import ExpectedSpecimen, NoisyAcquisition, shot_noise
from torchdic import Acquisition, Condenser, Grid, Microscope, Objective, Prism

grid, microscope = Grid((20, 32, 32), (0.3, 0.17, 0.17)), Microscope(0.546, Objective(0.9), Condenser(0.7))


def seen(planes, spacing, degrees, photons=14000):
    """The share of frequencies that a stack sees. photons: per pixel of the bright field, over all planes."""
    bias, focus = math.radians(degrees), [spacing * (i - (planes - 1) / 2) for i in range(planes)]
    noise = shot_noise(math.sin(bias / 2) ** 2, photons / planes, read_noise=3)
    acquisition = Acquisition([Prism((0.0, 0.2), bias), Prism((0.2, 0.0), bias)], focus)
    plan = NoisyAcquisition(grid, 1.335, microscope, acquisition, (noise, noise))
    return plan.coverage(ExpectedSpecimen(contrast=0.02), roughly=True).share


spacings, numbers = [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 2.5], [1, 2, 3, 4, 5, 7, 9, 13]
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
for degrees in (15, 30, 60, 90, 120):
    left.plot(spacings, [100 * seen(7, spacing, degrees) for spacing in spacings], "o-", label=f"bias {degrees}°")
    right.plot(numbers, [100 * seen(number, 6 / number, degrees) for number in numbers], "o-", label=f"bias {degrees}°")
left.set(xlabel="distance of seven planes, µm", ylabel="% of the frequencies are seen")
right.set(xlabel="number of planes over 6 µm, the same light in all")
right.set_xticks(numbers)
left.legend()
plt.show()
