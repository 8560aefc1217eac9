"""What torchrun tells the processes that it starts, and what they tell it. Nothing here imports torch."""

import json
import os
import sys
import time
from typing import NamedTuple

# Only torchrun sets the first; RANK and its like other launchers set too.
MARK, REPORT = "TORCHELASTIC_RUN_ID", "TORCHELASTIC_ERROR_FILE"


class ProcessPlace(NamedTuple):
    """Numbers of a process among those of a run (rank of ranks), and among those on its machine (local of here)."""

    rank: int
    ranks: int
    local: int
    here: int


def place() -> ProcessPlace | None:
    """The place of this process; None where it is the only one, or torchrun hasn't started it."""
    if MARK not in os.environ:
        return None
    found = ProcessPlace(*(int(os.environ[name]) for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")))
    return found if found.ranks > 1 else None


def fail(message: str) -> None:
    """Print why the command fails, in one line."""
    line = f"torchdic: error: {message}"
    print(line, file=sys.stderr)
    report(line)


def report(message: str) -> None:
    """Let torchrun's own report, which ends what it prints, say why this process has failed."""
    path = os.environ.get(REPORT)
    if path is None or MARK not in os.environ:
        return
    told = {"message": message, "extraInfo": {"py_callstack": message, "timestamp": str(int(time.time()))}}
    with open(path, "w", encoding="utf-8") as file:
        json.dump({"message": told}, file)
