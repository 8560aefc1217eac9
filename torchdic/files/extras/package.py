"""The packages of extras, loaded where a file asks for one."""

import importlib
from pathlib import Path
from types import ModuleType

from torchdic.errors import StackError


def package(name: str, path: Path, extra: str = "bio") -> ModuleType:
    """A package that reads this file. Raises StackError where it isn't installed; the line says how to get it.

    extra: of torchdic, by which it is installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise StackError(
            f"{path}: {path.suffix.lower()[1:].upper()} files are read by the package {name}, which is missing: "
            f"pip install 'torchdic[{extra}]', or save the stack as OME-TIFF"
        ) from error
