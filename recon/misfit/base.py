"""What every misfit has: the data, the pixels that count, a value, a curvature, and what noise alone leaves of it."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from recon.misfit.level import filled, image_means


class UniformImagesError(ValueError):
    """The images of a prism are uniform: there is nothing to fit."""


def spatial_variance(
    data: Float[Tensor, "prism focus y x"], mask: Bool[Tensor, "prism focus y x"] | None = None
) -> Float[Tensor, " prism"]:
    """Each prism's variance over the image, averaged over its focus planes.

    It is taken within each image, because the differences between the backgrounds of images say nothing about the
    specimen. mask: the pixels that count (True); None is all, else an image counts by their number.
    Raises UniformImagesError where the images of a prism are uniform: there is nothing to fit.
    """
    if mask is None:
        variance = data.var(dim=(2, 3), correction=0).mean(1)
    else:
        squares = torch.where(mask, data - image_means(data, mask), 0).square()
        variance = squares.sum((1, 2, 3)) / mask.sum((1, 2, 3))
    rounding = (4 * torch.finfo(data.dtype).eps * data.abs().amax((1, 2, 3))).square()
    for prism, (value, least) in enumerate(zip(variance.tolist(), rounding.tolist(), strict=True)):
        if not value > least:
            raise UniformImagesError(
                f"the images of prism {prism + 1} are uniform (variance {value:g}): there is nothing to fit"
            )
    return variance


class Misfit(ABC):
    """A measure of the difference between the model's images and the measured ones.

    A subclass has a name, by which checkpoints know it, and says what its value is for given images, how strongly it is
    curved and what noise alone leaves of it. Its value is scaled so that a model that shows nothing of the specimen has
    a misfit of about 1: the weights of the priors are relative to that.
    data: the measured images (prism, focus, y, x), relative to the empty bright field; their dtype and device are the
    descent's. A masked pixel, whatever it held, holds the mean of its neighbours that count.
    mask: the pixels that count (True), given as boolean and broadcastable to the data; None is all of them. The others
    count in no mean and have neither gradient nor curvature.
    variance: each prism's spatial variance, shape (prism, 1, 1, 1).
    unit: a misfit of the same kind whose scale this one has, so that images of a part of the same field count alike,
    and may be uniform; None is its own.
    Raises ValueError where the data don't have four axes, a pixel that counts isn't finite, the images of a prism are
    uniform or without a pixel that counts, or the mask isn't boolean or doesn't fit the data.
    """

    name: str
    knows_all: ClassVar[bool] = True  # whether noise is all that the true specimen leaves; no outliers
    data: Float[Tensor, "prism focus y x"]
    mask: Bool[Tensor, "prism focus y x"] | None
    variance: Float[Tensor, "prism 1 1 1"]

    def __init__(self, data: Tensor, mask: Tensor | None = None, unit: "Misfit | None" = None) -> None:
        if data.ndim != 4:
            raise ValueError(f"the data have shape {tuple(data.shape)}, a misfit asks for (prism, focus, y, x)")
        self.mask = None if mask is None else _fitted(mask, data)
        unknown = ~torch.isfinite(data) if self.mask is None else self.mask & ~torch.isfinite(data)
        if number := int(unknown.sum()):
            raise ValueError(f"{number} of {data.numel()} pixels are not finite; a mask must leave them out")
        self.data = data if self.mask is None else filled(data, self.mask)
        if unit is not None and type(unit) is not type(self):
            raise ValueError(f"a misfit of the kind {self.name} has no scale of the kind {unit.name}")
        if unit is None:
            self.variance = spatial_variance(self.data, self.mask)[:, None, None, None]
        else:
            self.variance = unit.variance

    @property
    def pixels(self) -> Float[Tensor, " prism"]:
        """How many pixels of each prism count."""
        if self.mask is None:
            return self.data.new_full((self.data.shape[0],), self.data[0].numel())
        return self.mask.sum((1, 2, 3)).to(self.data)

    def counted(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "prism focus y x"]:
        """The modelled images, with the data in place of masked pixels: no residual there, and no gradient."""
        return images if self.mask is None else torch.where(self.mask, images, self.data)

    def where_counted(self, values: Float[Tensor, "#prism #focus #y #x"]) -> Float[Tensor, "#prism #focus #y #x"]:
        """Values of pixels, 0 where the mask leaves a pixel out."""
        return values if self.mask is None else torch.where(self.mask, values, 0)

    def prism_means(self, values: Float[Tensor, "prism focus y x"]) -> Float[Tensor, " prism"]:
        """Mean of each prism's values over the pixels that count."""
        if self.mask is None:
            return values.mean((1, 2, 3))
        return self.where_counted(values).sum((1, 2, 3)) / self.pixels

    def mean(self, values: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """Mean of values over all pixels that count."""
        return values.mean() if self.mask is None else self.where_counted(values).sum() / self.pixels.sum()

    def part(self, rows: slice, columns: slice, unit: "Misfit | None" = None) -> "Misfit":
        """The misfit of a part of the images. rows, columns: of their pixels. unit: as above.

        Raises ValueError where no pixel of a prism counts there, NotImplementedError for a kind that has no parts.
        """
        raise NotImplementedError(f"a misfit of the kind {self.name} can't be cut into tiles")

    def again(self, data: Float[Tensor, "prism focus y x"]) -> "Misfit":
        """The misfit of other images of the same scene: with this one's noise and mask, and their own scale.

        What fits again to other images, as error bars do, needs it. A subclass whose constructor takes something else
        than that of the class on which it builds has its own. Raises ValueError as any misfit does, NotImplementedError
        for a kind that has none.
        """
        raise NotImplementedError(f"a misfit of the kind {self.name} can't be made of other images: it has no again()")

    def _mask_of_part(self, rows: slice, columns: slice) -> Bool[Tensor, "prism focus y x"] | None:
        """The mask of a part of the images."""
        return None if self.mask is None else self.mask[..., rows, columns]

    @abstractmethod
    def __call__(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """The misfit of modelled images, in the unit of the data; differentiable."""

    @abstractmethod
    def curvature(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "#prism #focus #y #x"]:
        """Second derivative of the misfit by each pixel of the modelled images, as Gauss and Newton have it.

        It is never negative, 0 at masked pixels, and may have any shape that broadcasts to the images'.
        """

    @abstractmethod
    def of_noise(self, noise: Sequence[float] | None = None) -> float | None:
        """The misfit that the true specimen has because of the noise; None where the noise isn't known.

        noise: standard deviation of the noise in each prism's images, in the unit of the data, as it was measured
        there; None where it wasn't. A misfit that was made with the noise of each pixel goes by that instead.
        """


def _fitted(mask: Tensor, data: Tensor) -> Bool[Tensor, "prism focus y x"] | None:
    """The mask in the data's shape and on their device; None where all pixels count. Raises ValueError."""
    if mask.dtype != torch.bool:
        raise ValueError(f"the mask holds {str(mask.dtype).removeprefix('torch.')}, a mask is boolean")
    try:
        mask = mask.to(data.device).broadcast_to(data.shape)
    except RuntimeError as error:
        raise ValueError(f"the mask has shape {tuple(mask.shape)}, the data {tuple(data.shape)}") from error
    for prism, number in enumerate(mask.sum((1, 2, 3)).tolist()):
        if number == 0:
            raise ValueError(f"the mask leaves no pixel of prism {prism + 1}: there is nothing to fit")
    return None if bool(mask.all()) else mask
