"""The deviance of counted photons: the misfit of light that is weak enough for its counts to be few."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit.base import Misfit
from recon.misfit.level import image_means, neighbours
from recon.recording.noise import NoiseModel

# Photons below which the deviance goes on as a parabola: a model may pass through 0, where there is no logarithm.
_DARKEST = 0.01
# Expected counts from which on the deviance's expectation is that of its expansion, which then errs by 1e-4.
_MANY = 60
# Pixels, evenly spaced in the order of their brightness, that stand for all in the expectation.
_SAMPLES = 64
# Nodes of the integral over read noise, from −6 to 6 standard deviations.
_NODES = 128


class PoissonMisfit(Misfit):
    """Twice the mean Poisson deviance of the counted photons, relative to that of uniform images.

    Read noise counts as a Poisson process of its own variance: the data's photons n = intensity/gain + (read/gain)²
    have the model's μ = I/gain + (read/gain)² as mean and as variance (Snyder, Hammoud and White, J. Opt. Soc. Am. A
    10, 1014, 1993), and a pixel's deviance is 2(μ − n + n·log(n/μ)). Where read noise makes n negative, n·log n counts
    as 0: this adds a constant, and the deviance's slope, 2(1 − n/μ), stays without bias. Below the μ of darkness, or a
    hundredth of a photon, the deviance goes on as the parabola of the same slope and of that variance.

    data, mask, unit: as of any misfit. noise: in the unit of the data; it broadcasts to them.
    Raises ValueError as any misfit does, and where the noise model doesn't fit the data.
    """

    name = "poisson"

    def __init__(self, data: Tensor, noise: NoiseModel, mask: Tensor | None = None, unit: Misfit | None = None) -> None:
        super().__init__(data, mask, unit)
        self.noise = noise
        self._model = noise.like(self.data)
        self._read = (self._model.read / self._model.gain).square()
        self._darkest = self._read.clamp_min(_DARKEST)
        self._counts = self._photons(self.data)
        if isinstance(unit, PoissonMisfit):
            self._empty = unit._empty
        else:
            uniform = image_means(self.data, self.mask).expand_as(self.data)
            self._empty = self.mean(deviance(self._counts, self._photons(uniform), self._darkest))

    def again(self, data: Float[Tensor, "prism focus y x"]) -> "PoissonMisfit":
        """The misfit of other images, see `Misfit.again`."""
        return type(self)(data, self.noise, self.mask)

    def part(self, rows: slice, columns: slice, unit: Misfit | None = None) -> "PoissonMisfit":
        """The misfit of a part of the images, see `Misfit.part`."""
        noise = self.noise.part(rows, columns)
        return PoissonMisfit(self.data[..., rows, columns], noise, self._mask_of_part(rows, columns), unit)

    def __call__(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """The misfit of modelled images, in the unit of the data; differentiable."""
        expected = self._photons(self.counted(images))
        return self.mean(deviance(self._counts, expected, self._darkest)) / self._empty

    def curvature(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "prism focus y x"]:
        """Twice each pixel's Fisher information 1/(gain²·μ), over the number of pixels and uniform images' deviance."""
        expected = self._photons(self.counted(images.detach())).clamp_min(self._darkest)
        weight = 2 / (self.pixels.sum() * self._empty)
        return self.where_counted(weight / (self._model.gain.square() * expected))

    def of_noise(self, noise: Sequence[float] | None = None) -> float:
        """The expected deviance of the pixels' own levels, which are the means of their neighbours.

        noise: has no say, the misfit has a noise model.
        """
        level, _ = neighbours(self.data, self.mask)
        light, read = (level / self._model.gain).clamp_min(0), self._read.sqrt().expand_as(level)
        if self.mask is not None:
            light, read = light[self.mask], read[self.mask]
        light, order = light.flatten().sort()
        chosen = ((torch.arange(_SAMPLES) + 0.5) * (len(light) / _SAMPLES)).long().to(light.device)
        expected = expected_deviance(light[chosen].double().cpu(), read.flatten()[order[chosen]].double().cpu())
        return float(expected.mean()) / float(self._empty)

    def _photons(self, intensity: Tensor) -> Tensor:
        """Photons with those that read noise counts as."""
        return intensity / self._model.gain + self._read


def deviance(counts: Tensor, expected: Tensor, darkest: Tensor) -> Tensor:
    """Twice the logarithm of how much likelier Poisson counts are under a mean of themselves than under the expected.

    counts: any number of photons, also below 0. expected: of a model, differentiable. darkest: the expected photons,
    above 0, below which the deviance goes on as a parabola. They broadcast; so does the result.
    """
    dark = expected < darkest
    mean = torch.where(dark, darkest, expected)
    positive = torch.where(counts > 1e-9, counts, 0)
    excess = mean - positive
    # log(n/μ) by log1p: the two terms nearly cancel where there are many photons
    half = excess - positive * torch.log1p(excess / torch.where(positive > 0, positive, 1))
    half = half + (counts - positive).abs() * (1 + mean.log())
    below = torch.where(dark, expected - darkest, 0)
    return 2 * half + below * (below + 2 * (darkest - counts)) / darkest


def expected_deviance(light: Float[Tensor, " pixel"], read: Float[Tensor, " pixel"]) -> Float[Tensor, " pixel"]:
    """The expectation of the deviance under the true model, for each pixel; 1 for many photons.

    light: photons, at least 0. read: standard deviation of the read noise in photons. Both float64.

    The photons are summed over, and normal read noise is integrated in equal steps, as the deviance has a kink at 0.
    For many expected photons μ = light + read² it is 1 − light/(3μ²) + 1/(2μ), from its expansion to fourth order.
    """
    mean = light + read.square()
    result = 1 - light / (3 * mean.square()) + 1 / (2 * mean)
    few = mean < _MANY
    if not bool(few.any()):
        return result
    light, read, mean = light[few, None, None], read[few, None, None], mean[few, None, None]
    photons = torch.arange(math.ceil(_MANY + 10 * math.sqrt(_MANY)), dtype=torch.float64)[:, None]
    probability = (torch.xlogy(photons, light) - light - torch.lgamma(photons + 1)).exp()
    # without read noise a single node, of any place, stands for all
    noise = torch.linspace(-6, 6, _NODES if bool(read.any()) else 1, dtype=torch.float64)
    weight = (-noise.square() / 2).softmax(0)
    values = deviance(photons + read * noise + read.square(), mean, read.square().clamp_min(_DARKEST))
    result[few] = (probability * (values * weight)).sum((1, 2))
    return result
