"""A descent saved on disk, to go on with after an interruption."""

from dataclasses import dataclass, fields
from pathlib import Path

import torch

from recon.fit.descent import Step
from torchdic.files.whole import written_whole

Row = tuple[int, float, float, float]


class CheckpointError(ValueError):
    """A checkpoint that can't be gone on with: one line with the file and the reason."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A step of a descent and the log up to it.

    step: to go on from. rows: (step, misfit, loss, seconds) of every step so far. identity: what the descent depends
    on, the resolved configuration and the data's digest, a line `key = value` each.
    """

    step: Step
    rows: list[Row]
    identity: str


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, whole or not at all."""
    step = {f.name: getattr(checkpoint.step, f.name) for f in fields(Step)}
    with written_whole(path) as partial:
        torch.save({"step": step, "rows": checkpoint.rows, "identity": checkpoint.identity}, partial)


def load(path: Path, identity: str) -> Checkpoint:
    """Read a checkpoint of the same configuration and data. Raises CheckpointError where it isn't one."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        checkpoint = Checkpoint(Step(**content["step"]), content["rows"], content["identity"])
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(f"{path}: is no checkpoint of this version: {reason}") from error
    if checkpoint.identity != identity:
        theirs, ours = _values(checkpoint.identity), _values(identity)
        changed = next(key for key in theirs | ours if theirs.get(key) != ours.get(key))
        raise CheckpointError(
            f"{path}: belongs to another configuration or other data: "
            f"{changed} was {theirs.get(changed, 'absent')}, is {ours.get(changed, 'absent')}"
        )
    return checkpoint


def _values(identity: str) -> dict[str, str]:
    parts = (line.partition(" = ") for line in identity.splitlines())
    return {key: value for key, _, value in parts}
