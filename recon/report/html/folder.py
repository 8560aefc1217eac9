"""What a folder of results holds, read for its report: a missing or damaged file costs only what it would show."""

import csv
import json
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from jaxtyping import Float
from torch import Tensor

from torchdic import Grid
from torchdic.files.format import Stack
from torchdic.files.stack import read_stack, read_volume

T = TypeVar("T")


@dataclass(frozen=True)
class Folder:
    """A folder of results.

    path: of it. damaged: a line for each file that can't be read, filled as they are asked for.
    """

    path: Path
    damaged: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Its name, also where the path is ".."; a link's own."""
        return os.path.basename(os.path.abspath(self.path))

    def has(self, name: str) -> bool:
        """Whether there is such a file."""
        return (self.path / name).is_file()

    def table(self, name: str) -> dict[str, Any]:
        """A file of JSON or TOML that holds a table; an empty one where it can't be read."""
        found = self._read(name, _parsed)
        if isinstance(found, dict):
            return found
        if found is not None:
            self.damaged.append(f"{name}: holds no table")
        return {}

    def records(self, name: str) -> list[dict[str, Any]]:
        """A file of JSON that holds a list of tables; an empty one where it can't be read."""
        found = self._read(name, _parsed)
        if found is not None and not isinstance(found, list):
            self.damaged.append(f"{name}: holds no list")
        return [one for one in found if isinstance(one, dict)] if isinstance(found, list) else []

    def text(self, name: str) -> str | None:
        """A text file."""
        return self._read(name, lambda path: path.read_text(encoding="utf-8"))

    def rows(self, name: str) -> list[list[float]]:
        """The numbers of a file of comma-separated values, below its head."""
        return self._read(name, _numbers) or []

    def volume(self, name: str) -> tuple[Float[Tensor, "z y x"], Grid] | None:
        """A volume and its grid."""
        return self._read(name, read_volume)

    def stack(self, name: str) -> Stack | None:
        """A stack of images."""
        return self._read(name, read_stack)

    def picture(self, name: str) -> bytes | None:
        """A picture, as its file's bytes."""
        return self._read(name, Path.read_bytes)

    def is_older(self, name: str, other: str) -> bool:
        """Whether a file was written before another one; False where one of them is missing."""
        one, two = self.path / name, self.path / other
        return one.exists() and two.exists() and one.stat().st_mtime < two.stat().st_mtime

    def _read(self, name: str, read: Callable[[Path], T]) -> T | None:
        if not self.has(name):
            return None
        try:
            return read(self.path / name)
        # what isn't text, JSON, TOML or a stack raises a ValueError; one that is nested too deeply a RecursionError
        except (OSError, ValueError, MemoryError, RecursionError, csv.Error) as error:
            line = (str(error).splitlines() or [type(error).__name__])[0]
            self.damaged.append(f"{name}: {line.removeprefix(f'{self.path / name}: ')}")
            return None


def table_in(values: Mapping[str, Any], key: str) -> dict[str, Any]:
    """A table within a table; an empty one where there is none."""
    found = values.get(key)
    return found if isinstance(found, dict) else {}


def list_in(values: Mapping[str, Any], key: str) -> list[Any]:
    """A list within a table; an empty one where there is none."""
    found = values.get(key)
    return found if isinstance(found, list) else []


def tables_in(values: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    """The tables of a list within a table."""
    return [one for one in list_in(values, key) if isinstance(one, dict)]


def _parsed(path: Path) -> Any:
    text = path.read_text(encoding="utf-8")
    return tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)


def _numbers(path: Path) -> list[list[float]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = [[float(value) for value in row] for row in list(csv.reader(file))[1:] if row]
    if any(len(row) != len(rows[0]) or len(row) < 2 for row in rows):
        raise ValueError("its rows aren't all as long, of two numbers or more")
    return rows
