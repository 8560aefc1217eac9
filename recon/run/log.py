"""log.csv: a row for every step of a descent, written as the steps are taken."""

import csv
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from recon.fit.step import Row
from recon.run.checkpoint import UnsavedWarning
from recon.run.folder.lock import FolderInUseError
from torchdic.files.whole import WriteError


class Log:
    """The rows of a descent's steps, each written to a file as soon as it is added.

    path: of the file. rows: of the steps before, which are written first. Where the file cannot be written,
    UnsavedWarning says so, and the rows are kept in memory until the log is closed.
    """

    def __init__(self, path: Path, rows: Sequence[Row]) -> None:
        self.rows = list(rows)
        self._path = path
        self._file: TextIO | None = None
        self._is_told = False
        self._begin()

    def add(self, row: Row) -> None:
        """Keep a step's row and write it; a row that has been added already is left out."""
        if self.rows and self.rows[-1][0] == row[0]:
            return
        self.rows.append(row)
        self._write([row])

    def close(self, *, whole: bool = True) -> None:
        """Close the file. whole: write all rows once more where some are missing from it, or it was removed."""
        self._end()
        if whole and (self._file is None or not self._path.exists()):
            self._begin()
            self._end()

    def _begin(self) -> None:
        """Open the file and write all rows so far."""
        try:
            self._file = self._path.open(
                "w", newline="", encoding="utf-8", buffering=1
            )  # every line reaches it at once
        except OSError as error:
            self._give_up(error)
        self._write([("step", "misfit", "loss", "seconds"), *self.rows])

    def _write(self, rows: Sequence[Sequence[object]]) -> None:
        if self._file is None:
            return
        try:
            csv.writer(self._file).writerows(rows)
            self._file.flush()
        except OSError as error:
            self._give_up(error)

    def _end(self) -> None:
        if self._file is None:
            return
        try:
            self._file.close()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        """Write no more rows, and warn of it once."""
        if self._file is not None:
            with suppress(OSError):  # it tries to write what it holds once more
                self._file.close()
        self._file = None
        if not self._is_told:
            known = WriteError.of(self._path, error)
            told = f"{known}; the run goes on, and tries again at its end"
            warnings.warn(told, UnsavedWarning, stacklevel=5)
        self._is_told = True


@contextmanager
def open_log(path: Path, rows: Sequence[Row]) -> Iterator[Log]:
    """A log in a file that begins with the rows of earlier steps."""
    log, ours = Log(path, rows), True
    try:
        yield log
    except FolderInUseError:
        ours = False
        raise
    finally:
        log.close(whole=ours)
