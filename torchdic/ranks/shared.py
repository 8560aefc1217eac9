"""Work that rank 0 hands out to all ranks: a sum of their parts with its gradient, or anything else.

Each rank computes its part from the same arguments, which rank 0 sends. For a sum S = Σ_r f_r(x) the backward pass does
likewise: from the gradient S̄, which rank 0 sends, rank r finds (∂f_r/∂x)ᵀ S̄, and those add up to x̄.
"""

import itertools
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchdic.errors import LostRankError
from torchdic.memory.batches import once
from torchdic.ranks.agreement import connected, gathered, give_warnings, is_settled, settled
from torchdic.ranks.group import alone, is_complete, note_loss, shares_out
from torchdic.ranks.parcel import Parcel, add_up, broadcast
from torchdic.ranks.signals import signals_later, signals_raised

_numbers = itertools.count()
# Numbers of sums whose gradients nobody will ask for any more; the others are told so with the next task.
_forgotten: list[int] = []
_one_at_a_time = threading.RLock()


@dataclass(eq=False)
class KeptPart:
    """A rank's part of a sum, with its graph, and the leaves of that."""

    result: Tensor
    leaves: list[Tensor]


Parts = dict[int, KeptPart]


@dataclass(frozen=True, eq=False)
class Sum:
    """A task: the sum over the ranks of function(*arguments). forgotten: numbers of sums whose graphs go."""

    number: int
    function: Callable[..., Tensor]
    arguments: tuple[Any, ...]
    forgotten: tuple[int, ...]

    def run(self, leaves: list[Tensor], parts: Parts) -> Tensor:
        """Compute a rank's part, keep it where it has learned leaves, and return the sum."""
        for number in self.forgotten:
            parts.pop(number, None)
        with settled(), alone(), torch.set_grad_enabled(bool(leaves)):
            result = self.function(*self.arguments)
            total = result.detach().clone(memory_format=torch.contiguous_format)
        if leaves:
            parts[self.number] = KeptPart(result, leaves)
        with connected():
            add_up(total)
        return total


@dataclass(frozen=True, eq=False)
class Gradient:
    """A task: the gradient to the leaves of a sum. bar: the gradient to the sum."""

    number: int
    bar: Tensor

    def run(self, _: list[Tensor], parts: Parts) -> list[Tensor]:
        """Compute a rank's part and return the sum."""
        with settled():
            part = parts.pop(self.number)
            with torch.enable_grad():
                # a scalar, because a gradient to a result that isn't one makes torch load sympy, which takes seconds
                result, bar = (torch.view_as_real(t) if t.is_complex() else t for t in (part.result, self.bar))
                loss = (result * bar).sum()
            bars = torch.autograd.grad(loss, part.leaves, materialize_grads=True)
            bars = [bar.clone(memory_format=torch.contiguous_format) for bar in bars]
        with connected():
            for bar in bars:
                add_up(bar)
        return bars


@dataclass(frozen=True, eq=False)
class Each:
    """A task: function(*arguments) on every rank, which computes by itself."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]

    def run(self, _: list[Tensor], parts: Parts) -> list[Any]:
        """Run the function and return the results of all ranks."""
        with settled(keep_warnings=False), alone(), signals_raised():
            result = self.function(*self.arguments)
        return gathered(result)


Task = Sum | Gradient | Each


def shared(whole: Callable[..., Tensor], part: Callable[..., Tensor], *arguments: Any) -> Tensor:
    """whole(*arguments), which is the sum over all ranks of part(*arguments); differentiable in tensors among these.

    part: finds a rank's part by `rank` and `ranks`; of a module, so that it can be sent by its name. arguments: what
    can be pickled, with tensors anywhere in it.
    Where nothing is shared out, the whole is computed; else its parts are, and there is no second derivative. Raises
    what the part raises on any rank, and LostRankError where one has ended.
    """
    if not shares_out():
        return whole(*arguments)
    number = next(_numbers)
    parcel = Parcel.of(Sum(number, part, arguments, _taken(_forgotten)))
    return _Shared.apply(parcel, number, *parcel.learned)  # pyright: ignore[reportReturnType]


def everywhere(function: Callable[..., Any], *arguments: Any) -> list[Any]:
    """The results of function(*arguments) on all ranks, in their order. Within it nothing else is shared out.

    function: of a module. arguments: what can be pickled, as the results can. Within it `gathered` lets the ranks meet.
    Errors as of `shared`.
    """
    if not shares_out():
        return [function(*arguments)]
    parcel = Parcel.of(Each(function, arguments))
    with _in_turn():
        with signals_later():
            task, leaves = _received(parcel)
        return task.run(leaves, _parts)


def check_ranks() -> None:
    """Raise LostRankError where another rank has ended."""
    everywhere(_nothing)


def _nothing() -> None:
    pass


@contextmanager
def leading() -> Iterator[None]:
    """Within this block the process is rank 0; at its end the others end."""
    try:
        yield
    finally:
        _parts.clear()
        if is_complete():  # what was being sent when one was lost has no end
            with suppress(LostRankError), connected():
                broadcast(Parcel.of(None))


def follow() -> None:
    """Compute what rank 0 hands out, until it ends. Raises LostRankError where it ends without a word."""
    parts: Parts = {}
    while True:
        task, leaves = _received(None)
        if task is None:
            return
        try:
            task.run(leaves, parts)
        except BaseException as error:
            if not is_settled(error):  # rank 0 raises it else
                raise


# Rank 0's own parts.
_parts: Parts = {}


class _Shared(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, parcel: Parcel, number: int, *_: Tensor) -> Tensor:
        total = _handed_out(parcel)
        ctx.number = number
        ctx.mark = _Mark()
        weakref.finalize(ctx.mark, _forget, number)
        return total

    @staticmethod
    @once
    def backward(ctx: Any, total_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, None, *_handed_out(Parcel.of(Gradient(ctx.number, total_bar)))


class _Mark:
    """Ends with the graph that holds it."""


def _forget(number: int) -> None:
    if _parts.pop(number, None) is not None:
        _forgotten.append(number)


def _taken(numbers: list[int]) -> tuple[int, ...]:
    taken = tuple(numbers)
    del numbers[: len(taken)]
    return taken


def _handed_out(parcel: Parcel) -> Any:
    """Send a task to the others and take part in it; returns its result."""
    with signals_later(), _in_turn():
        task, leaves = _received(parcel)
        return task.run(leaves, _parts)


@contextmanager
def _in_turn() -> Iterator[None]:
    """One task at a time; after one that ended otherwise than on the other ranks there are no more."""
    with _one_at_a_time:
        if not is_complete():
            raise LostRankError("the other processes of this run are lost, without which it can't go on")
        try:
            yield
        except BaseException as error:
            if not is_settled(error):
                note_loss()
            raise
    give_warnings()


def _received(parcel: Parcel | None) -> tuple[Any, list[Tensor]]:
    """Rank 0's task on every rank, of which one is None on the others, and its learned tensors."""
    with connected():
        parcel = broadcast(parcel)
    tensors = [
        tensor.detach().requires_grad_(learned)
        for tensor, learned in zip(parcel.tensors, parcel.is_learned, strict=True)
    ]
    return parcel.opened(tensors), [t for t in tensors if t.requires_grad]
