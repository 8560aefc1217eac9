"""A stack that lies in several files: a folder of planes, a file for each plane, or a file for each prism setting."""

import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from torchdic.errors import StackError, StackWarning
from torchdic.files.described.setup import StatedSetup, setup_in_words, setup_of_all
from torchdic.files.format import Stack
from torchdic.files.joined import check_alike
from torchdic.files.stack import FORMATS, format_of, read_stack

# Micro-Manager's file beside the planes of a folder.
_METADATA = "metadata.txt"

# As many files are named one by one.
_FEW = 3

# What a file's name is made of: numbers and words.
_PART = r"\d+|[^\W\d_]+"
# A number with a sign or decimals, which counts no planes.
_SIGNED = r"[-+−]\d|\d[.,]\d"

# Letters before a number in a file's name, by which it counts planes or prism settings.
_OF_PLANES = ("z", "plane", "planes", "slice", "focus", "depth", "t", "time")
_OF_PRISMS = ("c", "ch", "channel", "w", "setting", "prism", "bias", "shear", "frame")


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

    Files of one plane each are the planes, in the order of the one number in their names that changes. Where two do,
    such as c1 and z03, or a word does, one counts the prism settings. Files of several planes are a prism setting each.
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
        prisms, planes = _layout(files, typed=folder is None)
        order = np.array(sorted(range(len(files)), key=lambda i: (prisms[i], planes[i])))
        data = np.stack([stacks[i].data[0, 0] for i in order])
        data = data.reshape(len(set(prisms)), -1, *data.shape[1:])
        names = [_span([files[i] for i in part]) for part in np.split(order, len(data))]
    else:
        order, data = np.arange(len(files)), np.concatenate([stack.data for stack in stacks])
        names = [
            name for file, stack in zip(files, stacks, strict=True) for name in _settings_of(file, len(stack.data))
        ]
    joined = replace(stacks[0], data=data, names=tuple(names), source=_source(files, folder))
    return Gathered(_with_sizes(joined, said), tuple(files[i] for i in order), said)


def natural(name: str) -> list[tuple[int, int, str]]:
    """The key by which plane2 comes before plane10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part]


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


def _layout(files: Sequence[Path], *, typed: bool) -> tuple[list[int], list[int]]:
    """Which prism setting and which plane each file is, by what changes in their names.

    typed: whether the settings are in the order of the files, not in the natural order of their names.
    """
    parts = [_parts(file) for file in files]
    if len({tuple(part.isdigit() for part in name) for name in parts}) > 1:
        raise StackError(f"{files[0].parent}: the names differ in more than numbers and words: {_two(files)}")
    changing = [i for i in range(len(parts[0])) if len({name[i] for name in parts}) > 1]
    prism = next((i for i in changing if _counts(parts[0], i, _OF_PRISMS)), None)
    if prism is None and len(changing) == 1 and not parts[0][changing[0]].isdigit():
        prism = changing[0]  # a word alone, such as plus and minus
    if prism is None and len(changing) == 2:
        words = [i for i in changing if not parts[0][i].isdigit()]
        of_planes = [i for i in changing if _counts(parts[0], i, _OF_PLANES)]
        prism = next(iter([*words, *(i for i in changing if of_planes and i not in of_planes)]), None)
    planes = [i for i in changing if i != prism]
    if len(planes) > 1:
        raise StackError(
            f"{files[0].parent}: {len(changing)} parts of the names change ({_two(files)}): name prism settings "
            "channel1, channel2, … and planes z1, z2, …"
        )
    of_prisms, of_planes = (
        [natural(name[i[0]]) if i else [] for name in parts] for i in ([] if prism is None else [prism], planes)
    )
    settings, depths = list(dict.fromkeys(tuple(v) for v in of_prisms)), sorted({tuple(v) for v in of_planes})
    settings = settings if typed else sorted(settings)
    places = [(settings.index(tuple(v)), depths.index(tuple(d))) for v, d in zip(of_prisms, of_planes, strict=True)]
    if len(settings) * len(depths) != len(files):
        raise StackError(
            f"{files[0].parent}: {len(files)} files are not {len(settings)} settings × {len(depths)} planes: "
            f"{_lacking(files, places, prism)}"
        )
    if planes:
        _warn_of_a_gap(files, planes[0])
    return [setting for setting, _ in places], [depth for _, depth in places]


def _lacking(files: Sequence[Path], places: Sequence[tuple[int, int]], prism: int | None) -> str:
    """The names of the files that a rectangle of settings and planes lacks, or of two files at one place of it.

    places: (setting, plane) of each file. prism: which part of the names tells the settings; None is none, of one.
    """
    at: dict[tuple[int, int], Path] = {}
    for file, place in zip(files, places, strict=True):
        if place in at:
            signed = re.search(_SIGNED, file.stem) is not None
            hint = ": signs and decimals aren't read, so name planes z1, z2, …" if signed else ""
            return f"{at[place].name} and {file.name} are of one setting and plane{hint}"
        at[place] = file
    settings, depths = ({place[i]: file for place, file in at.items()} for i in (0, 1))
    names = [
        _renamed(depths[depth], prism, _parts(settings[setting])[prism])
        for setting in sorted(settings)
        for depth in sorted(depths)
        if prism is not None and (setting, depth) not in at
    ]
    many = " and others" if len(names) > 3 else ""
    return f"{', '.join(names[:3])}{many} {'is' if len(names) == 1 else 'are'} missing"


def _warn_of_a_gap(files: Sequence[Path], index: int) -> None:
    """Warn StackWarning where the numbers that count planes leave one out. index: of the part of the names."""
    numbered = {int(part): file for file in files if (part := _parts(file)[index]).isdigit()}
    numbers = sorted(numbered)
    steps = [b - a for a, b in pairwise(numbers)]
    wide = next((i for i, step in enumerate(steps) if step > min(steps)), None)
    if wide is None:
        return
    before, after = numbered[numbers[wide]], numbered[numbers[wide + 1]]
    lacking = numbers[wide] + min(steps)
    name = _renamed(before, index, str(lacking).zfill(len(_parts(before)[index])))
    warnings.warn(
        f"{files[0].parent}: {name} is missing between {before.name} and {after.name}; the planes are taken as equally "
        "spaced without it",
        StackWarning,
        stacklevel=4,
    )


def _parts(file: Path) -> list[str]:
    """The numbers and the words of a file's name."""
    return re.findall(_PART, file.stem)


def _renamed(file: Path, index: int, part: str) -> str:
    """The name of a file with another part in a place."""
    place = list(re.finditer(_PART, file.stem))[index]
    return f"{file.stem[: place.start()]}{part}{file.stem[place.end() :]}{file.suffix}"


def _counts(name: Sequence[str], index: int, words: Sequence[str]) -> bool:
    """Whether the number at this place follows one of the words."""
    return name[index].isdigit() and index > 0 and name[index - 1].lower() in words


def _two(files: Sequence[Path]) -> str:
    return f"{files[0].name}, {files[-1].name}"
