"""Numbers that say how good a reconstruction is."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

# Pixels along a side over which `coarse_residual` takes means.
COARSE = 3


def volume_error(delta: Float[Tensor, "z y x"], truth: Float[Tensor, "z y x"]) -> float:
    """The relative L2 error of Δn over the volume: 0 is perfect, and an empty volume has 1."""
    return float((delta - truth).norm() / truth.norm())


def mean_inside(delta: Float[Tensor, "z y x"], inside: Bool[Tensor, "z y x"]) -> float:
    """The mean of Δn over the voxels where `inside` is true."""
    return float(delta[inside].mean())


def residual_rms(
    images: Float[Tensor, "prism focus y x"],
    data: Float[Tensor, "prism focus y x"],
    mask: Bool[Tensor, "prism focus y x"] | None = None,
) -> list[float]:
    """The rms difference between model and data for each prism setting, in units of the empty bright field.

    mask: the pixels that count (True); None is all.
    """
    squares = (images - data).square()
    if mask is None:
        return squares.mean((1, 2, 3)).sqrt().tolist()
    return (torch.where(mask, squares, 0).sum((1, 2, 3)) / mask.sum((1, 2, 3))).sqrt().tolist()


def coarse_residual(residual: Float[Tensor, "prism focus y x"], noise: Sequence[float]) -> float:
    """The power of the residual's means over COARSE × COARSE pixels, over what white noise leaves of them.

    1 is noise alone. It rises where structure is left, though the fit has followed as much of the noise elsewhere.
    noise: standard deviation of each prism's, in the residual's unit. Fewer pixels than COARSE a side give 1.
    """
    if min(residual.shape[2:]) < COARSE:
        return 1.0
    power = COARSE**2 * F.avg_pool2d(residual, COARSE, 1).square().mean((1, 2, 3))
    return float((power / power.new_tensor(list(noise)).square()).mean())
