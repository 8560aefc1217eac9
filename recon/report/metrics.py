"""Numbers that say how good a reconstruction is."""

from jaxtyping import Bool, Float
from torch import Tensor


def volume_error(delta: Float[Tensor, "z y x"], truth: Float[Tensor, "z y x"]) -> float:
    """The relative L2 error of Δn over the volume: 0 is perfect, and an empty volume has 1."""
    return float((delta - truth).norm() / truth.norm())


def mean_inside(delta: Float[Tensor, "z y x"], inside: Bool[Tensor, "z y x"]) -> float:
    """The mean of Δn over the voxels where `inside` is true."""
    return float(delta[inside].mean())


def residual_rms(images: Float[Tensor, "prism focus y x"], data: Float[Tensor, "prism focus y x"]) -> list[float]:
    """The rms difference between model and data for each prism setting, in units of the empty bright field."""
    return (images - data).square().mean((1, 2, 3)).sqrt().tolist()
