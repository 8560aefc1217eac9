"""Priors: terms that are added to a misfit.

All are means over the voxels. Each knows its value, which Adam lowers, and a majorant, which Newton's method lowers: a
sum that touches the term at one volume and lies above it everywhere else.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic import Volume


@dataclass(frozen=True, eq=False)
class Majorant:
    """Mean over the voxels of edges·|∇Δn| + sparse·|Δn| + rough·½|∇Δn|²; ∇ is that of `recon.prior.edges`.

    edges: one weight, one per voxel (z, y, x), or one per corner of each (corner, z, y, x). sparse, rough: one weight
    each, at least 0 as all are.
    """

    edges: Tensor | float = 0.0
    sparse: float = 0.0
    rough: float = 0.0

    def __add__(self, other: "Majorant") -> "Majorant":
        return Majorant(self.edges + other.edges, self.sparse + other.sparse, self.rough + other.rough)

    def __rmul__(self, weight: float) -> "Majorant":
        return Majorant(weight * self.edges, weight * self.sparse, weight * self.rough)


class Prior(ABC):
    """A term that is added to the misfit, with a weight that may change over the steps."""

    @abstractmethod
    def weight(self, step: int, steps: int) -> float:
        """The weight at one of the steps, which are counted from 0. A term of weight 0 is not computed."""

    @abstractmethod
    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """The term's value without its weight; differentiable."""

    def majorant(self, volume: Volume) -> Majorant:
        """A sum that is the term at this volume and nowhere below it, up to a constant, without the weight.

        Newton's method needs it. Raises NotImplementedError where a prior has none.
        """
        raise NotImplementedError(f"{type(self).__name__} has no majorant: fit with method 'adam'")

    def at_contrast(self, contrast: float) -> "Prior":
        """The prior for a specimen of this typical Δn; most don't depend on it."""
        return self


def contrast(delta: Float[Tensor, "z y x"]) -> float:
    """The specimen's typical |Δn|: Σ|Δn|³/Σ|Δn|². It doesn't depend on how much of the volume is medium."""
    size = delta.detach().abs()
    squares = size.square()
    norm = float(squares.sum(dtype=torch.float64))
    return float(squares.mul_(size).sum(dtype=torch.float64)) / norm if norm > 0 else 0.0


def weighted(priors: Sequence[Prior], factor: float, step: int, steps: int) -> list[tuple[float, Prior]]:
    """The priors with their weights at one of the steps, each times a common factor; those of weight 0 are left out."""
    weights = [(factor * prior.weight(step, steps), prior) for prior in priors]
    return [(weight, prior) for weight, prior in weights if weight > 0]
