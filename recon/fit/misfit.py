"""How far the model's images are from the measured ones: the number that a descent lowers."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def spatial_variance(data: Float[Tensor, "prism focus y x"]) -> Float[Tensor, " prism"]:
    """Each prism's variance over the image, averaged over its focus planes.

    It is taken within each image, because the differences between the backgrounds of images say nothing about the
    specimen. Raises ValueError where the images of a prism are uniform: there is nothing to fit.
    """
    variance = data.var(dim=(2, 3), correction=0).mean(1)
    rounding = (4 * torch.finfo(data.dtype).eps * data.abs().amax((1, 2, 3))).square()
    for prism, (value, least) in enumerate(zip(variance.tolist(), rounding.tolist(), strict=True)):
        if not value > least:
            raise ValueError(f"the images of prism {prism} are uniform (variance {value:g}): there is nothing to fit")
    return variance


class Misfit(ABC):
    """A measure of the difference between the model's images and the measured ones.

    A subclass has a name, by which checkpoints know it, and says what its value is for given images and what noise
    alone leaves of it. Its value is scaled so that a model that shows nothing of the specimen has a misfit of about 1:
    the weights of the priors are relative to that.
    data: the measured images (prism, focus, y, x), relative to the empty bright field; their dtype and device are the
    descent's. variance: divides a squared residual, one value per prism, shape (prism, 1, 1, 1), or one per pixel.
    Raises ValueError where the data don't have four axes, or where the images of a prism are uniform.
    """

    name: str
    data: Float[Tensor, "prism focus y x"]
    variance: Float[Tensor, "prism #focus #y #x"]

    def __init__(self, data: Tensor) -> None:
        if data.ndim != 4:
            raise ValueError(f"the data have shape {tuple(data.shape)}, a misfit asks for (prism, focus, y, x)")
        self.data = data
        self.variance = spatial_variance(data)[:, None, None, None]

    @abstractmethod
    def __call__(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """The misfit of modelled images, in the unit of the data; differentiable."""

    @abstractmethod
    def of_noise(self, noise: Sequence[float]) -> float:
        """The misfit that the true specimen has because of the noise.

        noise: standard deviation of the noise in each prism's images, in the unit of the data.
        """


class GaussianMisfit(Misfit):
    """Mean squared residual of each prism over the prism's spatial variance, averaged over the prisms.

    Every prism counts alike, whatever its contrast. The misfit is 1 for a model that shows nothing of the specimen.
    """

    name = "gaussian"

    def __call__(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, ""]:
        """The misfit of modelled images, in the unit of the data; differentiable."""
        return ((images - self.data).square().mean((1, 2, 3)) / self.variance.flatten()).mean()

    def of_noise(self, noise: Sequence[float]) -> float:
        """The noise's variance over the images' variance, averaged over the prisms."""
        variances = self.variance.flatten().tolist()
        return sum(n**2 / v for n, v in zip(noise, variances, strict=True)) / len(variances)
