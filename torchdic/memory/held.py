"""The memory that a computation holds: the bytes of all tensors that it makes, counted while it runs."""

import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

# Two runs agree again where this many operations in a row are the same.
ALIKE = 8


class Allocation(NamedTuple):
    """An allocation of memory for a tensor: the operation that made it, and the bytes in use after it."""

    operation: str
    held: int


# All allocations of a run, in order.
Course = list[Allocation]


class Held(TorchDispatchMode):
    """Counts the bytes of the tensors that were made while it is entered and are still in use.

    bytes: in use now.
    course: the allocations so far.
    Tensors that existed before don't count. Nor does the workspace that a kernel takes and gives back within one
    operation.
    """

    def __init__(self) -> None:
        super().__init__()
        self.bytes = 0
        self.course: Course = []
        self._known: dict[int, weakref.ref] = {}

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """False: nothing is compiled here, and the default loads torch's compiler, which takes seconds."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Run one operation, and count the memory of the tensors that it makes."""
        result = func(*args, **(kwargs or {}))
        for made in _tensors((result,)):
            storage = made.untyped_storage()
            key = storage._cdata
            if key not in self._known:
                before = any(key == part.untyped_storage()._cdata for part in _tensors(args))
                self._meet(storage, 0 if before else storage.nbytes(), func)
        return result

    def _meet(self, storage: torch.UntypedStorage, size: int, func: Any) -> None:
        """Count a storage from its first appearance until it is freed."""
        key = storage._cdata
        self._known[key] = weakref.ref(storage, partial(self._forget, key, size))
        if size:
            self.bytes += size
            self.course.append(Allocation(func.__name__, self.bytes))

    def _forget(self, key: int, size: int, _: object) -> None:
        del self._known[key]
        self.bytes -= size


def _tensors(values: Iterable[object]) -> Iterator[Tensor]:
    """The tensors among an operation's arguments or results, some of which may be lists."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from (part for part in value if isinstance(part, Tensor))


def course_of(run: Callable[[], object]) -> Course:
    """The allocations that a function makes when it runs."""
    with Held() as held:
        run()
    return held.course


def most(course: Course) -> int:
    """The largest number of bytes in use at once."""
    return max((allocation.held for allocation in course), default=0)


@dataclass(frozen=True)
class Growth:
    """How the most bytes in use at once grow with the number of equal parts that are computed together.

    After each allocation that two parts and three parts both make, the bytes in use are linear in the number of parts.
    One stage may hold the most in a small run, another stage in a large run: the largest of these lines counts.
    lines: bytes of two parts, and of each further part; only those that are the largest for some number of parts.
    """

    lines: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, two: Course, three: Course) -> "Growth":
        """The growth that the courses of two parts and of three parts show.

        Where a run makes allocations for each of its parts in turn, the first parts of both runs are compared, and the
        last ones. (A single part would not do: its arrays of length 1 are treated in other ways.)
        """
        pairs = {(a, b - a) for run in (1, -1) for a, b in aligned(two[::run], three[::run])}
        lines: list[tuple[int, int]] = []
        for held, further in sorted(pairs, key=lambda line: (-line[1], -line[0])):  # the steepest one first
            if not lines or held > lines[-1][0]:
                lines.append((held, further))
        return cls(tuple(lines))

    def at(self, parts: int) -> int:
        """The most bytes that so many parts hold, two or more."""
        return max((held + further * (parts - 2) for held, further in self.lines), default=0)


def aligned(one: Course, other: Course) -> Iterator[tuple[int, int]]:
    """The bytes after each allocation of one run, beside those after the same allocation of a second run.

    Where the operations differ, allocations of the second run are skipped until both agree again. Where they do not
    agree again, the first run's allocation is skipped.
    """
    if len(one) == len(other):
        yield from ((a.held, b.held) for a, b in zip(one, other, strict=True))
        return
    first, second = ([allocation.operation for allocation in course] for course in (one, other))
    most_skipped = max(len(other) - len(one), 0) + ALIKE
    j = 0
    for i, operation in enumerate(first):
        if j >= len(other):
            return
        if second[j] != operation:
            ahead = first[i : i + ALIKE]
            following = (k for k in range(j, j + most_skipped) if second[k : k + ALIKE] == ahead)
            found = next(following, None)
            if found is None:
                continue
            j = found
        yield one[i].held, other[j].held
        j += 1


def crowded(step: Callable[[], object], steps: int, budget: int) -> bool:
    """Whether that many steps keep more bytes than a budget for the backward pass, if each keeps what the first keeps.

    step: runs the first step and returns its result.
    """
    with Held() as held:
        result = step()
    kept = held.bytes  # the result keeps its graph alive, and the graph keeps what it saved
    del result
    return kept * steps > budget
