"""What all ranks do at once ends alike on all of them: an error of one is raised on each."""

import pickle
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
import torch.distributed as dist

from torchdic.errors import LostRankError
from torchdic.memory.batches import worst_of_each_kind
from torchdic.ranks.group import note_loss, rank, ranks
from torchdic.ranks.signals import signals_later

# What a rank says at the end of its part.
WELL, WARNED, FAILED = range(3)
# Marks an error that all ranks know of.
SETTLED = "is_settled"
# Warnings of the current task: message, category, file and line of each.
_kept: list[tuple[Warning, type[Warning], str, int]] = []
# What torch says where a connection has ended.
ENDED = ("onnection", "peer", "socket", "Socket", "pipe", "NCCL")


@contextmanager
def connected() -> Iterator[None]:
    """Raise LostRankError where, within this block, another rank doesn't answer any more."""
    try:
        yield
    except RuntimeError as error:
        if not isinstance(error, dist.DistError) and not any(word in str(error) for word in ENDED):
            raise
        note_loss()
        raise LostRankError("another process of this run has ended, without which it can't go on") from error


@contextmanager
def settled(*, keep_warnings: bool = True) -> Iterator[None]:
    """Every rank enters this block. Where it fails on any of them, the error of the first is raised on all of them.

    keep_warnings: whether rank 0 keeps the warnings of all ranks, for `give_warnings`; else each gives its own.
    """
    error: BaseException | None = None
    with _caught() if keep_warnings else nullcontext(()) as caught:
        try:
            yield
        except (Exception, KeyboardInterrupt) as raised:
            if isinstance(raised, LostRankError) or is_settled(raised):
                raise
            error = raised
    with signals_later():
        _agree(error, caught)


@contextmanager
def _caught() -> Iterator[Sequence[warnings.WarningMessage]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield caught


def give_warnings() -> None:
    """Give the warnings that were kept, of each kind about images the worst.

    Only when nobody waits for rank 0: a warning may be made an error.
    """
    given = list(_kept)
    _kept.clear()
    with worst_of_each_kind():
        for warning in given:
            warnings.warn_explicit(*warning)


def gathered(value: Any) -> list[Any]:
    """Every rank's value, in their order, on all of them; all must call this. It also lets each wait for the others."""
    if ranks() == 1:
        return [value]
    with signals_later():
        _agree(None, ())
        return _all(value)


def _agree(error: BaseException | None, caught: Sequence[warnings.WarningMessage]) -> None:
    state = torch.tensor(FAILED if error is not None else WARNED if caught else WELL)
    with connected():
        dist.all_reduce(state, dist.ReduceOp.MAX)
    if int(state) == WELL:
        return
    told = _all((_portable(error), [_parts_of(w) for w in caught]))
    for number, (theirs, _) in enumerate(told):
        if theirs is not None:
            first = error if error is not None and number == rank() else theirs
            first.__dict__[SETTLED] = True
            raise first
    if rank() == 0:
        _kept.extend(warning for _, given in told for warning in given)


def is_settled(error: BaseException) -> bool:
    """Whether all ranks know of an error: each has raised it."""
    return SETTLED in error.__dict__


def _parts_of(warning: warnings.WarningMessage) -> tuple[Warning, type[Warning], str, int]:
    assert isinstance(warning.message, Warning)
    return warning.message, warning.category, warning.filename, warning.lineno


def _all(value: Any) -> list[Any]:
    told = [None] * ranks()
    with connected():
        dist.all_gather_object(told, value)
    return told


def _portable(error: BaseException | None) -> BaseException | None:
    """An error that the other ranks can be told of, with where it happened."""
    if error is None or rank() == 0:
        return error and _pickled(error)
    error.add_note(f"It happened on rank {rank()}:\n{''.join(traceback.format_exception(error))}")
    return _pickled(error)


def _pickled(error: BaseException) -> BaseException:
    """The error, or its words where it can't be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
