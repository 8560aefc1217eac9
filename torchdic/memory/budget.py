"""How many sources are computed at once, so that the memory they hold stays within a budget."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Batches:
    """How the sources of an image are computed.

    sources: number of sources in a batch.
    slabs: whether the backward pass computes the steps of each batch again, slab by slab.
    """

    sources: int
    slabs: bool = False


@dataclass(frozen=True)
class Foreseen:
    """The memory that an image will hold at once, in bytes of tensors without the volume, and its batches.

    peak: the largest number of bytes held at once, with the backward pass if a gradient is wanted.
    least: the smallest peak that is possible: single sources, whose steps are computed again. A budget below it is
    exceeded, and `peak` then equals `least`.
    sources, slabs: see `Batches`.
    """

    peak: int
    least: int
    sources: int
    slabs: bool = False


# The largest number of bytes held at once when sources are computed in these batches.
Peak = Callable[[Batches], int]


def ways(sources: int, *, gradient: bool, small_batches: bool) -> Iterator[Batches]:
    """Ways to compute that many sources, from the fastest to the one that holds least.

    They are: all at once; all at once, with their steps in slabs; batches of equal size; single sources, with their
    steps in slabs.
    gradient: whether a gradient is wanted. Without one nothing is kept, so there are no slabs.
    small_batches: whether small batches are faster than slabs.
    """
    yield Batches(sources)
    if gradient and not small_batches:
        yield Batches(sources, slabs=True)
    sizes = dict.fromkeys(math.ceil(sources / n) for n in range(2, sources + 1))
    yield from map(Batches, sizes)
    if gradient:
        yield Batches(1, slabs=True)


def least_of(peak: Peak, sources: int, *, gradient: bool, small_batches: bool) -> Batches:
    """The way that holds least: all sources at once or single ones, with slabs or without."""
    tried = ways(sources, gradient=gradient, small_batches=small_batches)
    return min((way for way in tried if way.sources in (1, sources)), key=peak)


def fitted(peak: Peak, sources: int, budget: int, *, gradient: bool, small_batches: bool) -> Batches:
    """The first of the `ways` that stays within a budget in bytes. If none does, the one that holds least."""
    kind = {"gradient": gradient, "small_batches": small_batches}
    together = [way for way in ways(sources, **kind) if way.sources == sources]
    for way in together:
        if peak(way) <= budget:
            return way
    # the least is found before batches are, because a small budget makes them needless
    least = least_of(peak, sources, **kind)
    if peak(least) >= budget:
        return least
    return next(way for way in ways(sources, **kind) if way not in together and peak(way) <= budget)
