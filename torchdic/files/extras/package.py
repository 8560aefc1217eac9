"""The packages of extras, loaded where a file asks for one."""

import importlib
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from torchdic.errors import StackError
from torchdic.files.format import offer_of_series

T = TypeVar("T")


def package(name: str, path: Path, extra: str = "bio") -> ModuleType:
    """A package that reads this file. Raises StackError where it isn't installed; the line says how to get it.

    extra: of torchdic, by which it is installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        kind = "OME-Zarr" if extra == "zarr" else path.suffix[1:].upper()
        distribution = name.partition(".")[0]
        raise StackError(
            f"{path}: {kind} files are read by the package {distribution}, which is missing: "
            f"pip install 'torchdic[{extra}]', or save the stack as OME-TIFF"
        ) from error


def chosen(held: Sequence[T], number: int | None, path: Path, kind: str) -> T:
    """Which of the stacks that a file holds is read.

    number: of it, counted from 0; None where the file has only one. kind: what the file calls its stacks.
    Raises StackError where there is none of that number, or more than one and none is chosen.
    """
    last = len(held) - 1
    if number is None and last > 0:
        raise StackError(f"{path}: holds {len(held)} {kind}; a stack is one: {offer_of_series(len(held))}")
    if not 0 <= (number or 0) <= last:
        raise StackError(f"{path}: series {number} must be from 0 to {last}: the file holds {len(held)}")
    return held[number or 0]
