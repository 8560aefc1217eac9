"""Memory bounded: sources in batches, and intermediate values recomputed where there is no room to keep them."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

T = TypeVar("T")


@dataclass(frozen=True)
class Demand:
    """Values per source and pixel that a stage of the computation holds; 1 is a real number of the volume's dtype.

    alone: at most, where no gradient is wanted. kept: for the backward pass, and each of `steps` steps keeps `step`
    more. working: at most beside all that is kept. back: at most beside the steps' part alone, while the backward pass
    takes them back. carried: from slab to slab of steps that are computed again. shared: kept (by each step, if any),
    however many sources there are. once: at most beside the steps' part, or alone, by one source after
    the other.
    """

    alone: float
    kept: float
    working: float
    steps: int = 0
    step: float = 0
    back: float = 0
    carried: float = 0
    shared: float = 0
    once: float = 0

    @property
    def whole(self) -> float:
        """All that is kept."""
        return self.kept + self.steps * self.step


def indices(dtype: torch.dtype) -> float:
    """How many values of a dtype an index takes."""
    return torch.int64.itemsize / dtype.itemsize


def recompute(function: Callable[..., T], *arguments: object, when: bool) -> T:
    """function(*arguments), whose intermediate values are computed again in the backward pass instead of kept."""
    if not (when and torch.is_grad_enabled()):
        return function(*arguments)
    return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)  # pyright: ignore[reportReturnType]


def replay(function: Callable[..., Tensor], *tensors: Tensor, when: bool) -> Tensor:
    """As `recompute`, of a function of these tensors alone; no graph is built before the backward pass.

    A graph's nodes are small and lie between the large temporaries, whose memory glibc (2.36) then hardly uses again:
    to hold 1 GiB, a gradient took 8 from the system.
    """
    if not (when and torch.is_grad_enabled()):
        return function(*tensors)
    return _Replayed.apply(function, *tensors)  # pyright: ignore[reportReturnType]


class _Replayed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
        ctx.function = function
        ctx.save_for_backward(*tensors)
        return function(*tensors)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        tensors = [t.detach().requires_grad_(t.requires_grad) for t in ctx.saved_tensors]
        with torch.enable_grad():
            result = ctx.function(*tensors)
        learned = [t for t in tensors if t.requires_grad]
        bars = iter(torch.autograd.grad(result, learned, result_bar, allow_unused=True))
        return (None, *(next(bars) if t.requires_grad else None for t in tensors))


def slabs(steps: int, *, split: bool) -> Iterator[tuple[int, int]]:
    """Steps 0 … steps as consecutive (first, last) ranges: about √steps of them where `split`, or a single one."""
    count = math.isqrt(steps - 1) + 1 if split else 1
    edges = [i * steps // count for i in range(count + 1)]
    yield from pairwise(edges)


def sum_over_sources(function: Callable[..., Tensor], per_source: tuple[Tensor, ...], size: int) -> Tensor:
    """Σ of function(batch of each tensor) over batches of `size` sources; several are computed again when needed."""
    count = len(per_source[0])
    batches = zip(*(t.split(size) for t in per_source), strict=True)
    total = recompute(function, *next(batches), when=size < count)
    for batch in batches:
        total = total + recompute(function, *batch, when=size < count)
    return total
