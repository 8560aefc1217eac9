"""A stack that lies in several files: a folder of planes, a file for each plane, or a file for each prism setting."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from torchdic.errors import StackError
from torchdic.files.arrangement.names import natural, places_by_name
from torchdic.files.described.setup import StatedSetup, setup_in_words, setup_of_all
from torchdic.files.format import Stack
from torchdic.files.joined import check_alike
from torchdic.files.stack import FORMATS, format_of, read_stack

# Micro-Manager's file beside the planes of a folder.
_METADATA = "metadata.txt"

# As many files are named one by one.
_FEW = 3


@dataclass(frozen=True)
class Gathered:
    """A stack, the files that it comes from, and what they say of the microscope.

    stack: its source names the one file, or a few, or the folder and the number of files; its names say which files
        each prism setting is of, where several files are.
    files: in the order in which they were read. setup: what they say; sizes that the stack has are not repeated.
    """

    stack: Stack
    files: tuple[Path, ...]
    setup: StatedSetup

    @property
    def one_file(self) -> bool:
        """Whether `read_stack` of that file gives the stack."""
        return len(self.files) == 1


def gather(paths: Sequence[Path], series: int | None = None) -> Gathered:
    """The stack in one file, in several, or in a folder of them.

    paths: prism settings are in this order; those of a folder in the natural order of the files' names.
    series: as for `read_stack`; of each file.

    Files of one plane each are the planes, in the order of the one number in their names that changes, such as z-0.5um.
    Where two do, such as c1 and z03, or a word does, one counts the prism settings. Files of several planes are a prism
    setting each.
    Raises StackError for no file, one that is named twice, a folder without images, files of different shapes or
    dtypes, and names from which no order follows, and as `read_stack` does.
    """
    files, folder = _listed(paths)
    stacks = [read_stack(file, series) for file in files]
    said = setup_of_all(_setup(file) for file in files[:1])
    beside = (folder or files[0].parent) / _METADATA
    if beside.is_file():
        said = said.completed(setup_in_words(beside.read_text(encoding="utf-8", errors="replace")))
    if len(stacks) == 1:
        return Gathered(_with_sizes(stacks[0], said), files, said)
    check_alike(stacks, settings=True)
    if stacks[0].data.shape[:2] == (1, 1):
        places = places_by_name(files, typed=folder is None)
        order = np.lexsort((places.planes, places.settings))
        data = np.stack([stacks[i].data[0, 0] for i in order])
        data = data.reshape(len(set(places.settings)), -1, *data.shape[1:])
        said = said.completed(StatedSetup(focus_step=places.step))
        names = [_span([files[i] for i in part]) for part in np.split(order, len(data))]
    else:
        order, data = np.arange(len(files)), np.concatenate([stack.data for stack in stacks])
        names = [
            name for file, stack in zip(files, stacks, strict=True) for name in _settings_of(file, len(stack.data))
        ]
    joined = replace(stacks[0], data=data, names=tuple(names), source=_source(files, folder))
    return Gathered(_with_sizes(joined, said), tuple(files[i] for i in order), said)


def _source(files: Sequence[Path], folder: Path | None) -> str:
    """The files in words: a few by their names."""
    if folder is None and len(files) <= _FEW:
        return ", ".join(map(str, files[:-1])) + f" and {files[-1]}"
    return f"{len(files)} files in {(folder or files[0].parent).resolve()}"


def _span(files: Sequence[Path]) -> str:
    return files[0].name if len(files) == 1 else f"{files[0].name} to {files[-1].name}"


def _settings_of(file: Path, number: int) -> list[str]:
    """The names of a file's prism settings, counted from 1 where it holds several."""
    return [file.name] if number == 1 else [f"{file.name}, its setting {i + 1}" for i in range(number)]


def _listed(paths: Sequence[Path]) -> tuple[tuple[Path, ...], Path | None]:
    """The files as typed, or those of a folder in natural order, and the folder if one was named."""
    if not paths:
        raise StackError("no stack is named: give a file, several, or a folder of planes")
    folders = [path for path in paths if path.is_dir() and not format_of(path).folder]
    if not folders:
        known: set[str] = set()
        for path in paths:
            whole = os.path.realpath(path)
            if whole in known:
                raise StackError(f"{path}: is named twice; each file is a prism setting, or a plane, of its own")
            known.add(whole)
        return tuple(paths), None
    if len(paths) > 1:
        raise StackError(f"{folders[0]}: is a folder; give one folder, or files")
    suffixes = tuple(suffix for known in FORMATS for suffix in known.suffixes)
    found = [file for file in folders[0].iterdir() if _holds_images(file, suffixes) and not file.name.startswith(".")]
    if not found:
        others = sorted(file for file in folders[0].iterdir() if not file.name.startswith("."))
        for file in others:
            if file.suffix.lower() in (".jpg", ".jpeg"):
                read_stack(file)  # says why it is no stack
        more = " and others" if len(others) > 1 else ""
        holds = f"holds {others[0].name}{more}, but no images" if others else "is empty"
        raise StackError(f"{folders[0]}: {holds}; a folder of planes has files that end in {', '.join(suffixes)}")
    return tuple(sorted(found, key=lambda path: natural(path.name))), folders[0]


def _holds_images(file: Path, suffixes: tuple[str, ...]) -> bool:
    """Whether a file, or a folder of files, is in a format of images, by its name or as Zarr's."""
    return format_of(file).folder if file.is_dir() else file.name.lower().endswith(suffixes) and file.is_file()


def _setup(file: Path) -> StatedSetup:
    setup = format_of(file).setup
    return StatedSetup() if setup is None else setup(file)


def _with_sizes(stack: Stack, said: StatedSetup) -> Stack:
    """The stack with the sizes and bits that are said elsewhere than in its own header."""
    pixel = stack.pixel_size
    if pixel is None and said.pixel_size is not None:
        pixel = (said.pixel_size, said.pixel_size)
    fits = said.bits is not None and stack.data.dtype.kind in "iu" and int(stack.data.max()) < 2**said.bits
    return replace(
        stack,
        pixel_size=pixel,
        focus_step=stack.focus_step or (said.focus_step if stack.data.shape[1] > 1 else None),
        bits=stack.bits or (said.bits if fits else None),
    )
