"""What the pixels around a pixel say of its intensity: smoothed images, of pixels that count alone."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

# Half the side of the square of neighbours, without the pixel itself: 24 of them know a variance of many photons to a
# fraction of a per cent, and a microscope's image hardly changes over two pixels.
_REACH = 2


def image_means(
    data: Float[Tensor, "prism focus y x"],
    mask: Bool[Tensor, "prism focus y x"] | None = None,
    weights: Float[Tensor, "#prism #focus #y #x"] | None = None,
) -> Float[Tensor, "prism focus 1 1"]:
    """Each image's mean over the pixels that count (True in the mask); 0 where none does.

    weights: of the pixels, above 0; None is equal ones.
    """
    if mask is None and weights is None:
        return data.mean((2, 3), keepdim=True)
    weight = torch.ones_like(data) if weights is None else weights.expand(data.shape)
    if mask is not None:
        weight = torch.where(mask, weight, 0)
    total = weight.sum((2, 3), keepdim=True)
    return (weight * data).sum((2, 3), keepdim=True) / torch.where(total > 0, total, 1)


def neighbours(
    data: Float[Tensor, "prism focus y x"], mask: Bool[Tensor, "prism focus y x"] | None = None
) -> tuple[Float[Tensor, "prism focus y x"], Float[Tensor, "prism focus y x"]]:
    """The mean of each pixel's neighbours that count, without the pixel itself, and their number.

    data: finite. mask: the pixels that count (True); None is all.
    The mean of a pixel without neighbours is the image's, or 0 where no pixel of the image counts.
    """
    counts = torch.ones_like(data) if mask is None else mask.to(data)
    side = 2 * _REACH + 1
    square = data.new_ones(1, 1, side, side)
    square[0, 0, _REACH, _REACH] = 0

    def total(values: Tensor) -> Tensor:
        return F.conv2d(values.flatten(0, 1)[:, None], square, padding=_REACH).reshape(data.shape)

    number = total(counts).round()
    mean = total(data * counts) / number.clamp_min(1)
    return torch.where(number > 0, mean, image_means(data, mask)), number


def filled(data: Float[Tensor, "prism focus y x"], mask: Bool[Tensor, "prism focus y x"]) -> Tensor:
    """The data with each masked pixel (False) replaced by the mean of its neighbours that count.

    An image without any such pixel becomes its prism's mean.
    """
    known = torch.where(mask, data, 0)
    mean, _ = neighbours(known, mask)
    prism = known.sum((1, 2, 3), keepdim=True) / mask.sum((1, 2, 3), keepdim=True)
    mean = torch.where(mask.any(3, keepdim=True).any(2, keepdim=True), mean, prism)
    return torch.where(mask, data, mean)
