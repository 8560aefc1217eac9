"""Numbers that say how good a reconstruction is."""

from jaxtyping import Bool, Float
from torch import Tensor


def volume_error(delta: Float[Tensor, "z y x"], truth: Float[Tensor, "z y x"]) -> float:
    """Relative L2 error of Δn over the volume: 0 is perfect, 1 is as wrong as an empty volume."""
    return float((delta - truth).norm() / truth.norm())


def mean_inside(delta: Float[Tensor, "z y x"], inside: Bool[Tensor, "z y x"]) -> float:
    """Mean Δn over a region."""
    return float(delta[inside].mean())


def residual_rms(images: Float[Tensor, "prism focus y x"], data: Float[Tensor, "prism focus y x"]) -> list[float]:
    """Each prism's rms residual, in units of the empty bright field."""
    return (images - data).square().mean((1, 2, 3)).sqrt().tolist()
