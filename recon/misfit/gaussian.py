"""The squared residual over its variance: the misfit of normal noise."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit.base import Misfit
from recon.misfit.level import image_means, neighbours
from recon.recording.noise import NoiseModel


class GaussianMisfit(Misfit):
    """Mean squared residual over a variance, which is each prism's spatial one or the noise's own at each pixel.

    Without a noise model the squared residual of each prism is divided by the prism's spatial variance, and the prisms
    are averaged: each counts alike, whatever its contrast. The misfit is 1 for a model that shows nothing.

    With one, each pixel counts by its own noise, and the whole is divided by one number, the misfit of the best uniform
    images. A pixel's variance is that of the mean of its neighbours without itself (of one photon at least). Taken from
    the pixel, it would be too small where noise has made the pixel too dark, and the fit would follow the dark pixels:
    by one photon a pixel, whatever the brightness. Neighbours know nothing of a pixel's noise, so nothing is biased.

    data, mask, unit: as of any misfit. noise: in the unit of the data; it broadcasts to them.
    Raises ValueError as any misfit does, and where the noise model doesn't fit the data.
    """

    name = "gaussian"

    def __init__(
        self, data: Tensor, noise: NoiseModel | None = None, mask: Tensor | None = None, unit: Misfit | None = None
    ) -> None:
        super().__init__(data, mask, unit)
        self.noise = noise
        self._shares = torch.ones_like(self.variance.flatten())  # of the prisms, 1 on average
        if noise is None:
            return
        model = noise.like(self.data)
        level, number = neighbours(self.data, self.mask)
        variance = model.variance(torch.maximum(level, model.gain))
        if isinstance(unit, GaussianMisfit):
            self._empty = unit._empty
        else:
            empty = image_means(self.data, self.mask, 1 / variance)
            self._empty = self.mean((self.data - empty).square() / variance)
        self._divisor = variance * self._empty
        # the mean of 1/variance is a little more than 1 over the mean, because the neighbours are noisy too
        scatter = model.gain.square() * model.variance(level) / number.clamp_min(1)
        self._noise_alone = self.mean(model.variance(level) / variance + scatter / variance.square())

    def again(self, data: Float[Tensor, "prism focus y x"]) -> "GaussianMisfit":
        """The misfit of other images, see `Misfit.again`."""
        return type(self)(data, self.noise, self.mask)

    def part(self, rows: slice, columns: slice, unit: Misfit | None = None) -> "GaussianMisfit":
        """The misfit of a part of the images, see `Misfit.part`.

        Without a noise model a prism of which few pixels count there counts for less, as it would in the whole.
        """
        noise = None if self.noise is None else self.noise.part(rows, columns)
        part = GaussianMisfit(self.data[..., rows, columns], noise, self._mask_of_part(rows, columns), unit)
        shares = self._shares * part.pixels / self.pixels
        part._shares = shares / shares.mean()
        return part

    def __call__(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """The misfit of modelled images, in the unit of the data; differentiable."""
        squares = (self.counted(images) - self.data).square()
        if self.noise is None:
            return (self._shares * self.prism_means(squares) / self.variance.flatten()).mean()
        return self.mean(squares / self._divisor)

    def curvature(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "#prism #focus #y #x"]:
        """Twice each pixel's weight, whatever the images: the misfit is a parabola."""
        if self.noise is None:
            weight = 2 * self._shares / (self.pixels * len(self.data))
            return self.where_counted(weight[:, None, None, None] / self.variance)
        return self.where_counted(2 / (self.pixels.sum() * self._divisor))

    def of_noise(self, noise: Sequence[float] | None = None) -> float | None:
        """The noise's variance over the variance that divides: the spatial one's, averaged over the prisms, or its own.

        noise: as of any misfit; it has no say where the misfit has a noise model.
        """
        if self.noise is not None:
            return float(self._noise_alone / self._empty)
        if noise is None:
            return None
        variances, shares = self.variance.flatten().tolist(), self._shares.tolist()
        return sum(s * n**2 / v for s, n, v in zip(shares, noise, variances, strict=True)) / len(variances)
