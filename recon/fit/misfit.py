"""How far the model's images are from the measured ones."""

import torch
from jaxtyping import Float
from torch import Tensor


def spatial_variance(data: Float[Tensor, "prism focus y x"]) -> Float[Tensor, " prism"]:
    """Each prism's variance over the image, averaged over the focus planes.

    A variance over all prisms would include the differences between their backgrounds, which say nothing of the
    specimen. Raises ValueError where a prism's images are uniform: there is nothing to fit.
    """
    variance = data.var(dim=(2, 3), correction=0).mean(1)
    rounding = (4 * torch.finfo(data.dtype).eps * data.abs().amax((1, 2, 3))).square()
    for prism, (value, least) in enumerate(zip(variance.tolist(), rounding.tolist(), strict=True)):
        if not value > least:
            raise ValueError(f"the images of prism {prism} are uniform (variance {value:g}): there is nothing to fit")
    return variance


def gaussian(
    images: Float[Tensor, "prism focus y x"],
    data: Float[Tensor, "prism focus y x"],
    variance: Float[Tensor, " prism"],
) -> Float[Tensor, ""]:
    """Mean squared residual over the prisms' spatial variances: 1 for a model that shows nothing of the specimen."""
    return ((images - data).square().mean((1, 2, 3)) / variance).mean()
