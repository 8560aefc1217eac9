"""What a computation holds: the bytes of all tensors that it makes, counted while it runs."""

import weakref
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

# Operations in a row by which two runs are found to agree again.
ALIKE = 8


class Allocation(NamedTuple):
    """A tensor's memory taken from the system: by which operation, and the bytes in use after it."""

    operation: str
    held: int


# All allocations of a run, one after the other.
Course = list[Allocation]


class Held(TorchDispatchMode):
    """Counts, while it is entered, the bytes of the tensors that were made in it and are still in use.

    bytes: in use now. course: the allocations so far. Tensors that were there before don't count, and neither do the
    workspaces that a kernel takes and gives back within one operation.
    """

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0
        self.course: Course = []
        self._known: dict[int, weakref.ref] = {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Nothing is compiled here, so that torch's compiler, which takes seconds to load, need not be told."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Run one operation, and count what it has made."""
        result = func(*args, **(kwargs or {}))
        for made in _tensors((result,)):
            storage = made.untyped_storage()
            key = storage._cdata
            if key not in self._known:
                before = any(key == part.untyped_storage()._cdata for part in _tensors(args))
                self._meet(storage, 0 if before else storage.nbytes(), func)
        return result

    def _meet(self, storage: torch.UntypedStorage, size: int, func: Any) -> None:
        """Count a storage that is met for the first time, until it is freed."""
        key = storage._cdata
        self._known[key] = weakref.ref(storage, partial(self._forget, key, size))
        if size:
            self.bytes += size
            self.course.append(Allocation(func.__name__, self.bytes))

    def _forget(self, key: int, size: int, _: object) -> None:
        del self._known[key]
        self.bytes -= size


def _tensors(values: Iterable[object]) -> Iterator[Tensor]:
    """The tensors among an operation's arguments or results, which may come in lists."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from (part for part in value if isinstance(part, Tensor))


def course_of(run: Callable[[], object]) -> Course:
    """The allocations of a function."""
    with Held() as held:
        run()
    return held.course


def most(course: Course) -> int:
    """The most bytes in use at once."""
    return max((allocation.held for allocation in course), default=0)


def extrapolated(one: Course, two: Course, count: int) -> int:
    """The most bytes that `count` equal parts hold at once, from the courses of one part and of two.

    The bytes after each allocation that both runs make are linear in the number of parts, and the largest of these
    lines counts: one stage may hold the most in a small run, another one in a large run. Where the second run makes
    allocations for each of its parts in turn, those of its first part and those of its last one are compared.
    """
    forward, backward = aligned(one, two), aligned(one[::-1], two[::-1])
    return max((a + (b - a) * (count - 1) for a, b in (*forward, *backward)), default=0)


def aligned(one: Course, two: Course) -> Iterator[tuple[int, int]]:
    """The bytes after each allocation of one run beside those after the same one of a run that may make more.

    Where the operations differ, allocations of the second run are skipped until both agree again; where they do not
    agree again, the first run's allocation is.
    """
    if len(one) == len(two):
        yield from ((a.held, b.held) for a, b in zip(one, two, strict=True))
        return
    first, second = ([allocation.operation for allocation in course] for course in (one, two))
    most_skipped = max(len(two) - len(one), 0) + ALIKE
    j = 0
    for i, operation in enumerate(first):
        if j >= len(two):
            return
        if second[j] != operation:
            ahead = first[i : i + ALIKE]
            following = (k for k in range(j, j + most_skipped) if second[k : k + ALIKE] == ahead)
            found = next(following, None)
            if found is None:
                continue
            j = found
        yield one[i].held, two[j].held
        j += 1


def crowded(step: Callable[[], object], steps: int, budget: int) -> bool:
    """Whether that many steps keep more than a budget in bytes for the backward pass, by what the first one keeps.

    step: runs the first step and returns its result.
    """
    with Held() as held:
        result = step()
    kept = held.bytes  # the result holds its graph, and the graph what it saved
    del result
    return kept * steps > budget
