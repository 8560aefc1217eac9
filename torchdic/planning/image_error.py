"""How far images are from the true ones, as one number."""

import torch
from jaxtyping import Float
from torch import Tensor

# The least contrast (standard deviation, in units of the empty bright field) that an error is divided by. It is the
# shot noise of ten thousand electrons, a usual camera's, and gives the error of an empty scene a meaning.
FLOOR = 0.01


def image_error(images: Float[Tensor, "prism focus y x"], truth: Float[Tensor, "prism focus y x"]) -> float:
    """How far images are from the true ones, relative to the true images' contrast; the worst image counts.

    For each prism setting and focus plane: the root mean square of the difference, divided by the standard deviation of
    the true image. A standard deviation below 0.01 (FLOOR) counts as 0.01. The largest of these numbers is returned:
    0 where all images are right, 0.05 where the worst one is off by 5 % of its contrast.

    images: what was computed, in units of the empty bright field.
    truth: what it should be, in the same units.
    """
    truth = truth.to(torch.float64)
    return relative(images.to(truth) - truth, truth)


def relative(difference: Float[Tensor, "prism focus #y #x"], truth: Float[Tensor, "prism focus y x"]) -> float:
    """The `image_error` of images that differ from the true ones by `difference`."""
    contrast = truth.std((2, 3), correction=0).clamp_min(FLOOR)
    return float((difference.square().mean((2, 3)).sqrt() / contrast).max())
