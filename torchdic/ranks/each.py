"""Many things of one kind computed by all ranks at once, each by one of them."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import TypeVar

from torchdic.ranks.group import rank, ranks, shares_out
from torchdic.ranks.shared import everywhere

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """function(item) of each item, in their order, as soon as it and those before it are there.

    As many are computed at once as there are ranks, each by one of them, which computes by itself; by one process, one
    after the other. function, items and results: as those of `everywhere`, whose errors it raises.
    """
    if not shares_out():
        yield from map(function, items)
        return
    left = iter(items)
    while some := list(islice(left, ranks())):
        yield from everywhere(_own, function, some)[: len(some)]


def _own(function: Callable[[Item], Result], items: Sequence[Item]) -> Result | None:
    """The item of this rank, computed; None where there is none for it."""
    return function(items[rank()]) if rank() < len(items) else None
