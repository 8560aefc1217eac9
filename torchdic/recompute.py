"""Memory bounded: sources in batches, and intermediate values recomputed where there is no room to keep them."""

import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

T = TypeVar("T")
# Values per source and pixel that a pass without gradients holds at once.
TRANSIENT = 60


def recompute(function: Callable[..., T], *arguments: object, when: bool) -> T:
    """function(*arguments), whose intermediate values are computed again in the backward pass instead of kept."""
    if not (when and torch.is_grad_enabled()):
        return function(*arguments)
    return checkpoint(function, *arguments, use_reentrant=False, preserve_rng_state=False)  # pyright: ignore[reportReturnType]


def slabs(steps: int, *, split: bool) -> Iterator[tuple[int, int]]:
    """Steps 0 … steps as consecutive (first, last) ranges: about √steps of them where `split`, or a single one."""
    count = math.isqrt(steps - 1) + 1 if split else 1
    edges = [i * steps // count for i in range(count + 1)]
    yield from pairwise(edges)


def sum_over_sources(
    function: Callable[..., Tensor], per_source: tuple[Tensor, ...], pixels: int, kept: int, memory: int
) -> Tensor:
    """Σ of function(batch of each tensor) over batches of sources.

    pixels: of one source's field. kept: values per pixel and source that the backward pass wants. memory: bytes that
    the batches may keep together; where they want more, each batch is as large as fits and computed again.
    """
    count = len(per_source[0])
    values = kept if torch.is_grad_enabled() else TRANSIENT
    each = values * pixels * per_source[0].element_size()
    size = min(count, max(1, memory // each))
    batches = zip(*(t.split(size) for t in per_source), strict=True)
    total = recompute(function, *next(batches), when=size < count)
    for batch in batches:
        total = total + recompute(function, *batch, when=size < count)
    return total
