"""A misfit that the toolbox doesn't have, as a user would add one."""

import math

from recon.misfit.base import Misfit


class Absolute(Misfit):
    """Mean |residual| over each prism's spatial standard deviation: outliers count less than in a squared one."""

    name = "absolute"

    def __call__(self, images):
        return self.mean((self.counted(images) - self.data).abs() / self.variance.sqrt())

    def curvature(self, images):
        deviation = self.variance.sqrt()
        residual = (self.counted(images) - self.data).abs().clamp_min(1e-3 * deviation)
        return self.where_counted(1 / (self.pixels.sum() * deviation * residual))

    def of_noise(self, noise=None):
        if noise is None:
            return None
        deviations = self.variance.flatten().sqrt().tolist()  # of a normal distribution: mean |x| = √(2/π)·sd
        return math.sqrt(2 / math.pi) * sum(n / d for n, d in zip(noise, deviations, strict=True)) / len(noise)
