"""Results of an earlier run, which are replaced only where the user says so."""

from collections.abc import Sequence
from pathlib import Path


class FinishedError(ValueError):
    """A folder holds results that would be replaced unasked: one line with the file and the ways out."""


def check_no_results(out: Path, names: Sequence[str], *, restart: bool) -> None:
    """Raise FinishedError where a folder holds one of the files of a finished run, unless it is to begin anew."""
    found = next((out / name for name in names if (out / name).exists()), None)
    if found is not None and not restart:
        raise FinishedError(f"{found}: the folder has results; name another one, or replace them with --restart")
