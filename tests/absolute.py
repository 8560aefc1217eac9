"""A misfit that the toolbox doesn't have, as a user would add one."""

import math

from recon.fit.misfit import Misfit


class Absolute(Misfit):
    """Mean |residual| over each prism's spatial standard deviation: outliers count less than in a squared one."""

    name = "absolute"

    def __call__(self, images):
        return ((images - self.data).abs() / self.variance.sqrt()).mean()

    def of_noise(self, noise):
        deviations = self.variance.flatten().sqrt().tolist()  # of a normal distribution: mean |x| = √(2/π)·sd
        return math.sqrt(2 / math.pi) * sum(n / d for n, d in zip(noise, deviations, strict=True)) / len(noise)
