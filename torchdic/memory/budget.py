"""How many sources are computed at once, so that what is held stays within a budget."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Batches:
    """How the sources of an image are computed.

    sources: in a batch. slabs: whether the steps of each batch are computed again in the backward pass, slab by slab.
    """

    sources: int
    slabs: bool = False


@dataclass(frozen=True)
class Foreseen:
    """What an image will hold at once, in bytes of tensors beyond the volume, and how its sources are computed.

    peak: at most, the backward pass included where a gradient is wanted. least: the least that it can be brought to, by
    single sources whose steps are computed again; equal to `peak` where the budget is smaller. sources, slabs: see
    `Batches`.
    """

    peak: int
    least: int
    sources: int
    slabs: bool = False


# Bytes that are held at most when a batch has so many sources.
Peak = Callable[[Batches], int]


def ways(sources: int, *, gradient: bool, small_batches: bool) -> Iterator[Batches]:
    """Ways to compute that many sources, from the one that is fastest to the one that holds least.

    All at once; all at once with their steps in slabs; batches of equal size; single sources with their steps in slabs.
    gradient: without one nothing is kept, and there are no slabs. small_batches: whether small batches are faster than
    slabs.
    """
    yield Batches(sources)
    if gradient and not small_batches:
        yield Batches(sources, slabs=True)
    sizes = dict.fromkeys(math.ceil(sources / n) for n in range(2, sources + 1))
    yield from map(Batches, sizes)
    if gradient:
        yield Batches(1, slabs=True)


def least_of(peak: Peak, sources: int, *, gradient: bool, small_batches: bool) -> int:
    """The least that can be held at once, in bytes: by all sources or by single ones."""
    tried = ways(sources, gradient=gradient, small_batches=small_batches)
    return min(peak(way) for way in tried if way.sources in (1, sources))


def fitted(peak: Peak, sources: int, budget: int, *, gradient: bool, small_batches: bool) -> Batches:
    """The first of the `ways` that stays within a budget in bytes, or else the one that holds least."""
    tried = ways(sources, gradient=gradient, small_batches=small_batches)
    first = next(tried)
    if peak(first) <= budget:
        return first
    budget = max(budget, least_of(peak, sources, gradient=gradient, small_batches=small_batches))
    return next(way for way in (first, *tried) if peak(way) <= budget)
