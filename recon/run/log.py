"""log.csv: a row for every step of a descent, written as the steps are taken."""

import csv
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from recon.fit.step import Row
from recon.run.checkpoint import UnsavedWarning
from torchdic.files.whole import WriteError


class Log:
    """The rows of a descent's steps, each written to a file as soon as it is added.

    file: open for writing. rows: of the steps before, which are written first. Where the file cannot be written,
    UnsavedWarning says so, and the rows are kept in memory alone.
    """

    def __init__(self, file: TextIO, rows: Sequence[Row]) -> None:
        self.rows = list(rows)
        self._file = file
        self._is_written = True
        self._write([("step", "misfit", "loss", "seconds"), *rows])

    def add(self, row: Row) -> None:
        """Keep a step's row and write it; a row that has been added already is left out."""
        if self.rows and self.rows[-1][0] == row[0]:
            return
        self.rows.append(row)
        self._write([row])

    def close(self) -> None:
        """Close the file."""
        try:
            self._file.close()
        except OSError as error:  # what could not be written is tried again
            self._warn(error)

    def _write(self, rows: Sequence[Sequence[object]]) -> None:
        if not self._is_written:
            return
        try:
            csv.writer(self._file).writerows(rows)
            self._file.flush()
        except OSError as error:
            self._warn(error)

    def _warn(self, error: OSError) -> None:
        if self._is_written:
            known = WriteError.of(Path(self._file.name), error)
            warnings.warn(f"{known}; the run goes on without its log", UnsavedWarning, stacklevel=4)
        self._is_written = False


@contextmanager
def open_log(path: Path, rows: Sequence[Row]) -> Iterator[Log]:
    """A log in a file that begins with the rows of earlier steps; every line reaches the file at once."""
    log = Log(path.open("w", newline="", encoding="utf-8", buffering=1), rows)
    try:
        yield log
    finally:
        log.close()
