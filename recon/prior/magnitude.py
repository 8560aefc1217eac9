"""The prior of a specimen that is mostly medium."""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from recon.prior.base import Majorant, Prior
from torchdic import Volume


def magnitude(delta: Float[Tensor, "z y x"]) -> Float[Tensor, ""]:
    """Mean |Δn|. DIC does not see a uniform Δn; this term draws it to 0 where the images say nothing."""
    return delta.abs().mean()


@dataclass(frozen=True)
class Magnitude(Prior):
    """Mostly medium: the mean |Δn|, of one weight at every step."""

    constant: float

    def __post_init__(self) -> None:
        if not (0 <= self.constant < math.inf):
            raise ValueError(f"weight {self.constant} of the magnitude must be at least 0")

    def weight(self, step: int, steps: int) -> float:
        """The weight, the same at every step."""
        return self.constant

    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """Mean |Δn| of the volume."""
        return magnitude(volume.delta)

    def majorant(self, volume: Volume) -> Majorant:
        """It is its own."""
        return Majorant(sparse=1.0)
