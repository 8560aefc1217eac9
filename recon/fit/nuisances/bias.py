"""The bias of the prisms: the setting of a compensator, which is seldom read to a degree."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.misfit.base import Misfit
from torchdic import Prism
from torchdic.scalar import number

# Difference in rad between the declared |bias| of prisms from which on they aren't the same.
_SAME = 1e-3


@dataclass(frozen=True)
class Bias(Nuisance):
    """The bias of each prism (prism,) in rad; 0 for bright field, which has none.

    learning_rate, step: in rad.
    """

    learning_rate: float = 0.02
    step: float = 0.03
    name = "bias"
    axes = ("prism",)

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The declared biases. Raises ValueError where all images are bright field."""
        prisms = setup.acquisition.prisms
        _declared(prisms)
        return torch.stack([misfit.data.new_tensor(0.0 if p is None else number(p.bias)) for p in prisms])

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with these biases."""
        return _with_biases(setup, lambda index, _: value[index])


@dataclass(frozen=True)
class CommonBias(Nuisance):
    """The |bias| in rad that all prisms have in common, as with one compensator set to either side of extinction.

    Each prism keeps its sign. learning_rate, step: in rad.
    """

    learning_rate: float = 0.02
    step: float = 0.03
    name = "bias"

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The declared |bias|, 0-d. Raises ValueError where prisms differ in it, or all images are bright field."""
        sizes = [abs(bias) for bias in _declared(setup.acquisition.prisms)]
        if max(sizes) - min(sizes) > _SAME:
            raise ValueError(f"prisms of |bias| {min(sizes):g} and {max(sizes):g} rad have no common one to learn")
        return misfit.data.new_tensor(sum(sizes) / len(sizes))

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with this |bias| in all prisms."""
        return _with_biases(setup, lambda _, prism: -value if number(prism.bias) < 0 else value)


def _declared(prisms: Sequence[Prism | None]) -> list[float]:
    """The biases of the prisms that are no bright field. Raises ValueError where there is none."""
    biases = [number(prism.bias) for prism in prisms if prism is not None]
    if not biases:
        raise ValueError("all images are bright field: there is no bias to learn")
    return biases


def _with_biases(setup: Setup, bias: Callable[[int, Prism], Tensor]) -> Setup:
    """The setup with the bias that a prism of an index gets."""
    prisms = [p if p is None else replace(p, bias=bias(i, p)) for i, p in enumerate(setup.acquisition.prisms)]
    return replace(setup, acquisition=replace(setup.acquisition, prisms=prisms))
