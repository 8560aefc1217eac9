"""A descent that is saved on disk, so that it can go on after an interruption."""

import warnings
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch

from recon.fit.step import Row, Step
from torchdic.files.whole import WriteError, written_whole
from torchdic.memory.shortage import is_shortage

# Number of the format that is written and read. Checkpoints of before the second had none.
FORMAT = 2


class CheckpointError(ValueError):
    """A checkpoint that a run can't go on from: one line with the file and the reason."""


class UnsavedWarning(UserWarning):
    """A file that a run leaves on its way cannot be written. The run goes on without it."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A step of a descent and the log up to it.

    step: to go on from. rows: (number, misfit, loss, seconds) of every step so far. identity: what the descent depends
    on, that is the resolved configuration, the misfit and the data's digest, one line `key = value` each.
    """

    step: Step
    rows: list[Row]
    identity: str


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint. If that fails, an earlier one in the file stays as it was. Raises WriteError."""
    step = {f.name: getattr(checkpoint.step, f.name) for f in fields(Step)}
    content = {"format": FORMAT, "step": step, "rows": checkpoint.rows, "identity": checkpoint.identity}
    with written_whole(path) as partial, partial.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # torch's own words for what the file raised
            if isinstance(error.__context__, OSError):
                raise error.__context__ from None
            raise


def save_if_possible(path: Path, checkpoint: Checkpoint) -> bool:
    """Write a checkpoint, or warn UnsavedWarning where it cannot be written; returns whether it was."""
    try:
        save(path, checkpoint)
    except WriteError as error:
        warnings.warn(f"{error}; the run goes on without this checkpoint", UnsavedWarning, stacklevel=3)
        return False
    return True


def load(path: Path, identity: str) -> Checkpoint:
    """Read a checkpoint of the same configuration and data, onto the CPU.

    Raises CheckpointError where the file is none, is of an earlier version, or belongs to another descent.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        earlier = _is_earlier(content)
        checkpoint = None if earlier else Checkpoint(Step(**content["step"]), content["rows"], content["identity"])
    except Exception as error:
        if is_shortage(error):
            raise
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        advice = "remove it, and what it holds is computed again, or begin anew with --restart"
        raise CheckpointError(f"{path}: is no checkpoint of this version: {reason}; {advice}") from error
    if checkpoint is None:
        raise CheckpointError(
            f"{path}: is a checkpoint of an earlier version, from which this one can't go on; begin anew with --restart"
        )
    if checkpoint.identity != identity:
        theirs, ours = _values(checkpoint.identity), _values(identity)
        changed = next(key for key in theirs | ours if theirs.get(key) != ours.get(key))
        raise CheckpointError(
            f"{path}: belongs to another configuration or other data: "
            f"{changed} was {theirs.get(changed, 'absent')}, is {ours.get(changed, 'absent')}"
        )
    return checkpoint


def _is_earlier(content: dict[str, Any]) -> bool:
    """Whether a file's content is a checkpoint of an earlier format."""
    return {"step", "rows", "identity"} <= content.keys() and content.get("format", 1) < FORMAT


def _values(identity: str) -> dict[str, str]:
    parts = (line.partition(" = ") for line in identity.splitlines())
    return {key: value for key, _, value in parts}
