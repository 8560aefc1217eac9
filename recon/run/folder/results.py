"""Results of an earlier run, which are replaced only where the user says so."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from recon.config.schema import ConfigError


class FinishedError(ValueError):
    """A folder holds results that would be replaced unasked: one line with the file and the ways out."""


def check_no_results(out: Path, names: Sequence[str], *, restart: bool) -> None:
    """Raise FinishedError where a folder holds one of the files of a finished run, unless it is to begin anew."""
    found = next((out / name for name in names if (out / name).exists()), None)
    if found is not None and not restart:
        raise FinishedError(f"{found}: the folder has results; name another one, or replace them with --restart")


def check_inputs_stay(out: Path, inputs: Iterable[str | Path | None], names: Sequence[str]) -> None:
    """Raise ConfigError where a command would replace a file that it reads, even where it is to begin anew.

    inputs: the files that it reads; None is none. names: of the files that it leaves in the folder.
    """
    there = [out / name for name in names if (out / name).exists()]
    for path in filter(os.path.exists, filter(None, inputs)):
        if any(os.path.samefile(path, result) for result in there):
            raise ConfigError(f"{path}: is read, and a result of that name would replace it; name another folder")
