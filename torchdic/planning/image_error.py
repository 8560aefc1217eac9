"""How far images are from the truth, as one number."""

import torch
from jaxtyping import Float
from torch import Tensor

# Least standard deviation, in units of the empty bright field, that an image's error is compared with: the shot noise
# of ten thousand electrons, a usual camera's. It gives an empty scene's error a meaning.
FLOOR = 0.01


def image_error(images: Float[Tensor, "prism focus y x"], truth: Float[Tensor, "prism focus y x"]) -> float:
    """The largest over the images of rms difference over the true image's standard deviation, at least FLOOR."""
    truth = truth.to(torch.float64)
    return relative(images.to(truth) - truth, truth)


def relative(difference: Float[Tensor, "prism focus #y #x"], truth: Float[Tensor, "prism focus y x"]) -> float:
    """The same of a difference."""
    contrast = truth.std((2, 3), correction=0).clamp_min(FLOOR)
    return float((difference.square().mean((2, 3)).sqrt() / contrast).max())
