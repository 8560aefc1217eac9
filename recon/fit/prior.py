"""What is known of a specimen before it is measured: it has few edges, and most of its volume is medium."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from recon.fit.schedule import held_then_annealed
from torchdic import Volume

# Rounds off the corner of |∇Δn| at 0. It is far below any contrast that DIC sees.
SMOOTHING = 1e-5


def total_variation(delta: Float[Tensor, "z y x"], spacing: tuple[float, float, float]) -> Float[Tensor, ""]:
    """Mean length of the differences to the next voxel along z, y and x, each scaled to the spacing along x."""
    squares = delta.new_full(delta.shape, SMOOTHING**2)
    for axis, step in enumerate(spacing):
        if delta.shape[axis] > 1:
            difference = delta.diff(dim=axis, append=delta.narrow(axis, -1, 1)) * (spacing[2] / step)
            squares = squares + difference.square()
    return squares.sqrt().mean()


def magnitude(delta: Float[Tensor, "z y x"]) -> Float[Tensor, ""]:
    """Mean |Δn|. DIC does not see a uniform Δn; this term draws it to 0 where the images say nothing."""
    return delta.abs().mean()


class Prior(ABC):
    """A term that is added to the misfit, with a weight that may change over the steps."""

    @abstractmethod
    def weight(self, step: int, steps: int) -> float:
        """The weight at one of the steps, which are counted from 0. A term of weight 0 is not computed."""

    @abstractmethod
    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """The term's value without its weight; differentiable."""


@dataclass(frozen=True)
class TotalVariation(Prior):
    """Few and sharp edges: `total_variation` of Δn.

    first, last: the weight, which is held and then annealed as `held_then_annealed` says.
    """

    first: float
    last: float

    def weight(self, step: int, steps: int) -> float:
        """The weight at one of the steps."""
        return held_then_annealed(step, steps, self.first, self.last)

    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """Total variation of the volume's Δn."""
        return total_variation(volume.delta, volume.grid.spacing)


@dataclass(frozen=True)
class Magnitude(Prior):
    """Mostly medium: the mean |Δn|, of one weight at every step."""

    constant: float

    def weight(self, step: int, steps: int) -> float:
        """The weight, the same at every step."""
        return self.constant

    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """Mean |Δn| of the volume."""
        return magnitude(volume.delta)
