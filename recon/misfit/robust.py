"""Huber's loss of the standardised residual: the misfit that pixels which don't belong hardly move."""

import copy
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit.base import Misfit
from recon.recording.background import NORMAL_MAD, noise_level

# Standardised residuals beyond it count by their magnitude, no longer by their square: Huber's choice, which is 95 % as
# precise as least squares where all noise is normal.
_KNEE = 1.345


class RobustMisfit(Misfit):
    """Mean of Huber's loss of the residual over the noise's standard deviation, relative to that of uniform images.

    The loss is r² up to a knee of 1.345 and grows linearly beyond (Huber, Annals of Mathematical Statistics 35, 73,
    1964), so that a hot pixel or a grain of dust pulls no more than noise does, however bright it is. It is convex in
    the images: unlike a loss that forgets far residuals, it doesn't take the specimen for outliers before it is fitted.

    data, mask, unit: as of any misfit. noise: standard deviation of each prism's noise, shape (prism,), in the unit of
    the data; None measures it in the data, by the median magnitude of what remains of a pixel beside its neighbours.
    Raises ValueError as any misfit does, where the noise isn't one number above 0 per prism, or can't be measured.
    """

    name = "robust"
    knows_all = False

    def __init__(
        self,
        data: Tensor,
        noise: Float[Tensor, " prism"] | None = None,
        mask: Tensor | None = None,
        unit: Misfit | None = None,
    ) -> None:
        super().__init__(data, mask, unit)
        noise = _measured(self.data, self.mask) if noise is None else noise.to(self.data)
        if noise.shape != self.data.shape[:1]:
            raise ValueError(f"the noise has shape {tuple(noise.shape)}, the data have {len(self.data)} prisms")
        for prism, value in enumerate(noise.tolist()):
            if not 0 < value < math.inf:
                raise ValueError(f"the noise {value:g} of prism {prism + 1} must be above 0 and finite")
        self.noise = noise
        if isinstance(unit, RobustMisfit):
            self._scale, self._empty = unit._scale, unit._empty
        else:
            self._set_scale(noise)

    def _set_scale(self, scale: Float[Tensor, " prism"]) -> None:
        """Standardise residuals by a scale per prism."""
        self._scale = scale[:, None, None, None]
        medians = torch.stack([image.nanmedian() for image in self._known(self.data).flatten(0, 1)])
        uniform = medians.nan_to_num(0).reshape(*self.data.shape[:2], 1, 1)  # an image without pixels has no median
        self._empty = self.mean(huber((self.data - uniform) / self._scale))

    def again(self, data: Float[Tensor, "prism focus y x"]) -> "RobustMisfit":
        """The misfit of other images, see `Misfit.again`."""
        return type(self)(data, self.noise, self.mask)

    def part(self, rows: slice, columns: slice, unit: Misfit | None = None) -> "RobustMisfit":
        """The misfit of a part of the images, see `Misfit.part`."""
        return RobustMisfit(self.data[..., rows, columns], self.noise, self._mask_of_part(rows, columns), unit)

    def rescaled(self, images: Float[Tensor, "prism focus y x"]) -> "RobustMisfit":
        """The same misfit with each prism's scale from the median magnitude of the images' residual.

        For a model that doesn't reach the noise: what most of its pixels are off by then counts as ordinary. Raises
        ValueError where more than half of a prism's pixels have no residual at all.
        """
        residual = self._known((images.detach() - self.data).abs())
        scale = torch.stack([prism.nanmedian() for prism in residual]) / NORMAL_MAD
        for prism, value in enumerate(scale.tolist()):
            if not value > 0:
                raise ValueError(f"the residual's median in prism {prism + 1} is {value:g}: it gives no scale")
        other = copy.copy(self)
        other._set_scale(scale)
        return other

    def __call__(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """The misfit of modelled images, in the unit of the data; differentiable."""
        return self.mean(huber((self.counted(images) - self.data) / self._scale)) / self._empty

    def curvature(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "prism focus y x"]:
        """The weights of iteratively reweighted least squares: the loss's slope over the residual.

        Parabolas of this curvature lie above the loss and touch it at the images.
        """
        standard = ((self.counted(images.detach()) - self.data) / self._scale).abs()
        weights = _KNEE / standard.clamp_min(_KNEE)
        return self.where_counted(2 * weights / (self.pixels.sum() * self._empty * self._scale.square()))

    def of_noise(self, noise: Sequence[float] | None = None) -> float:
        """The expected loss of normal noise.

        noise: standard deviation of each prism's noise, in the unit of the data; None is what the misfit was made with.
        """
        known = self.noise.tolist() if noise is None else noise
        ratios = [n / scale for n, scale in zip(known, self._scale.flatten().tolist(), strict=True)]
        pixels = self.pixels.tolist()
        total = sum(number * expected_huber(ratio) for number, ratio in zip(pixels, ratios, strict=True))
        return total / sum(pixels) / float(self._empty)

    def _known(self, values: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "prism focus y x"]:
        """Values of pixels, NaN where the mask leaves a pixel out."""
        return values if self.mask is None else torch.where(self.mask, values, torch.nan)


def huber(standard: Tensor) -> Tensor:
    """Huber's loss of standardised residuals: r² up to the knee k, 2k|r| − k² beyond."""
    within = standard.clamp(-_KNEE, _KNEE)
    return within * (2 * standard - within)


def expected_huber(deviation: float) -> float:
    """The mean of Huber's loss of normal residuals of a standard deviation, which is at least 0."""
    if deviation == 0:
        return 0.0
    k, knee = _KNEE / deviation, _KNEE
    density = math.exp(-(k**2) / 2) / math.sqrt(2 * math.pi)
    beyond = math.erfc(k / math.sqrt(2))
    squares = deviation**2 * (1 - beyond - 2 * k * density)
    return squares + 4 * knee * deviation * density - knee**2 * beyond


def _measured(data: Tensor, mask: Tensor | None) -> Tensor:
    """Standard deviation of each prism's noise in the pixels that count. Raises ValueError where it can't be told."""
    known = data if mask is None else torch.where(mask, data, torch.nan)
    levels = [noise_level(prism) for prism in known.cpu().numpy()]
    for prism, level in enumerate(levels):
        if level is None:
            raise ValueError(
                f"the noise of prism {prism + 1} can't be measured: no 3 × 3 pixels count together; give it"
            )
    return data.new_tensor(levels)
