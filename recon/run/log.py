"""log.csv: a row for every step of a descent, written as the steps are taken."""

import csv
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from recon.fit.step import Row


class Log:
    """The rows of a descent's steps, each written to a file as soon as it is added.

    file: open for writing. rows: of the steps before, which are written first.
    """

    def __init__(self, file: TextIO, rows: Sequence[Row]) -> None:
        self.rows = list(rows)
        self._writer = csv.writer(file)
        self._writer.writerow(("step", "misfit", "loss", "seconds"))
        self._writer.writerows(rows)

    def add(self, row: Row) -> None:
        """Keep a step's row and write it; a row that has been added already is left out."""
        if self.rows and self.rows[-1][0] == row[0]:
            return
        self.rows.append(row)
        self._writer.writerow(row)


@contextmanager
def open_log(path: Path, rows: Sequence[Row]) -> Iterator[Log]:
    """A log in a file that begins with the rows of earlier steps; every line reaches the file at once."""
    with path.open("w", newline="", encoding="utf-8", buffering=1) as file:
        yield Log(file, rows)
