"""Which prism setting and which plane each of several files is, by what changes in their names."""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from torchdic.errors import StackError, StackWarning

# What a file's name is made of: numbers and words.
_PART = r"\d+|[^\W\d_]+"
# A number with a sign or decimals, which are read only after the words below.
_SIGNED = r"[-+−]\d|\d[.,]\d"

# Letters before a number in a file's name, by which it counts planes or prism settings.
_OF_DEPTHS = ("z", "planes", "plane", "slice", "focus", "depth")
_OF_PLANES = (*_OF_DEPTHS, "t", "time")
_OF_PRISMS = ("channel", "ch", "c", "w", "setting", "prism", "bias", "shear", "frame")

# Units of depths, in µm.
_UNITS = {"um": 1.0, "µm": 1.0, "μm": 1.0, "micron": 1.0, "microns": 1.0, "nm": 1e-3}


def _value_after(words: Sequence[str]) -> re.Pattern[str]:
    """What finds a number after one of the words, with its sign, its decimals, and the word after it, as of a unit."""
    return re.compile(
        rf"(?<![^\W\d_])(?:{'|'.join(words)})[ _=]?(?P<value>(?P<sign>[-+−]?)\d+(?:[.,](?P<decimals>\d+))?)"
        r"(?P<unit>\s?[^\W\d_]+)?",
        re.IGNORECASE,
    )


_DEPTH, _SETTING = _value_after(_OF_DEPTHS), _value_after(_OF_PRISMS)

# Depths are unequally spaced where two are this much further apart than those that are nearest: names are rounded.
_WIDE = 1.5


@dataclass(frozen=True)
class Places:
    """settings, planes: of each file, counted from 0. step: of the focus, in µm, where the names say it."""

    settings: list[int]
    planes: list[int]
    step: float | None


def natural(name: str) -> list[tuple[int, float, str]]:
    """The key by which plane2 comes before plane10."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part
    ]


def places_by_name(files: Sequence[Path], *, typed: bool) -> Places:
    """Which prism setting and which plane each file is.

    typed: whether the settings are in the order of the files, not in the natural order of their names.
    Raises StackError where no order follows from the names, or a file is missing. Warns with StackWarning where planes
    are left out.
    """
    names = _Names.of(files)
    parts = names.parts
    if len({tuple(map(_is_number, name)) for name in parts}) > 1:
        raise StackError(f"{files[0].parent}: the names differ in more than numbers and words: {_two(files)}")
    changing = [i for i in range(len(parts[0])) if len({name[i] for name in parts}) > 1]
    prism = _of_settings(parts[0], changing)
    planes = [i for i in changing if i != prism]
    if len(planes) > 1:
        raise StackError(
            f"{files[0].parent}: {len(changing)} parts of the names change ({_two(files)}): name prism settings "
            "channel1, channel2, … and planes z1, z2, …"
        )
    of_prisms, of_planes = (
        [tuple(_key(name[i[0]])) if i else () for name in parts] for i in ([] if prism is None else [prism], planes)
    )
    settings, depths = list(dict.fromkeys(of_prisms)), sorted(set(of_planes))
    settings = settings if typed else sorted(settings)
    places = [(settings.index(v), depths.index(d)) for v, d in zip(of_prisms, of_planes, strict=True)]
    if len(settings) * len(depths) != len(files):
        raise StackError(
            f"{files[0].parent}: {len(files)} files are not {len(settings)} settings × {len(depths)} planes: "
            f"{_lacking(names, places, prism)}"
        )
    if planes:
        _warn_of_a_gap(names, planes[0])
    step = names.step(planes[0]) if planes else None
    return Places([setting for setting, _ in places], [depth for _, depth in places], step)


@dataclass(frozen=True)
class _Names:
    """files. spans: where the parts of each one's name are. signed: whether depths have signs or decimals."""

    files: Sequence[Path]
    spans: list[list[tuple[int, int]]]
    signed: bool

    @classmethod
    def of(cls, files: Sequence[Path]) -> "_Names":
        """The parts of files' names. Raises StackError for minuses that may be hyphens."""
        depths, settings = (_signed(files, value) for value in (_DEPTH, _SETTING))
        if depths and {depth["sign"] for depth in depths} <= {"-", "−"}:
            raise StackError(
                f"{files[0].parent}: a minus or a hyphen stands before the depths of all names ({_two(files)}): name "
                "planes z1, z2, …"
            )
        spans = []
        for file, *values in zip(files, *filter(None, (depths, settings)), strict=True):
            found = [part.span() for part in re.finditer(_PART, file.stem)]
            for start, stop in (value.span("value") for value in values):
                found = sorted([*(span for span in found if span[1] <= start or span[0] >= stop), (start, stop)])
            spans.append(found)
        return cls(files, spans, bool(depths))

    @property
    def parts(self) -> list[list[str]]:
        """The numbers and the words of each name."""
        return [[file.stem[a:b] for a, b in spans] for file, spans in zip(self.files, self.spans, strict=True)]

    def renamed(self, file: Path, index: int, part: str) -> str:
        """The name of a file with another part in a place."""
        start, stop = self.spans[list(self.files).index(file)][index]
        return f"{file.stem[:start]}{part}{file.stem[stop:]}{file.suffix}"

    def step(self, index: int) -> float | None:
        """The focus step in µm that the numbers in a place of the names have with the unit after them; None is none."""
        units = {name[index + 1].lower() if index + 1 < len(name) else "" for name in self.parts}
        values = sorted({_number(name[index]) for name in self.parts if _is_number(name[index])})
        unit = _UNITS.get(units.pop()) if len(units) == 1 else None
        return None if unit is None or len(values) < 2 else unit * (values[-1] - values[0]) / (len(values) - 1)


def _signed(files: Sequence[Path], after: re.Pattern[str]) -> list[re.Match[str]]:
    """The numbers after words in the names of all files, where they have signs or decimals; else none.

    z-1, z-2 have hyphens; z-1, z0 haven't. z1.9, z1.10 are no decimals, unless a unit of length follows.
    """
    found = [value for file in files if (value := after.search(file.stem)) is not None]
    signs = {value["sign"].replace("−", "-") for value in found}
    lengths = {len(value["decimals"]) for value in found if value["decimals"]}
    units = all((value["unit"] or "").strip().lower() in _UNITS for value in found)
    signed = "+" in signs or len(signs) > 1 or len(lengths) == 1 or (bool(lengths) and units)
    return found if signed and len(found) == len(files) else []


def _of_settings(name: Sequence[str], changing: Sequence[int]) -> int | None:
    """Which of the changing parts of the names tells prism settings; None is none. name: the first."""
    prism = next((i for i in changing if _counts(name, i, _OF_PRISMS)), None)
    if prism is None and len(changing) == 1 and not _is_number(name[changing[0]]):
        return changing[0]  # a word alone, such as plus and minus
    if prism is None and len(changing) == 2:
        words = [i for i in changing if not _is_number(name[i])]
        of_planes = [i for i in changing if _counts(name, i, _OF_PLANES)]
        return next(iter([*words, *(i for i in changing if of_planes and i not in of_planes)]), None)
    return prism


def _lacking(names: _Names, places: Sequence[tuple[int, int]], prism: int | None) -> str:
    """The names of the files that a rectangle of settings and planes lacks, or of two files at one place of it.

    places: (setting, plane) of each file. prism: which part of the names tells the settings; None is none, of one.
    """
    at: dict[tuple[int, int], Path] = {}
    for file, place in zip(names.files, places, strict=True):
        if place in at:
            signed = not names.signed and re.search(_SIGNED, file.stem) is not None
            hint = ": signs and decimals are read only after z, plane or focus, so name planes z1, z2, …"
            return f"{at[place].name} and {file.name} are of one setting and plane{hint if signed else ''}"
        at[place] = file
    settings, depths = ({place[i]: file for place, file in at.items()} for i in (0, 1))
    parts = dict(zip(names.files, names.parts, strict=True))
    missing = [
        names.renamed(depths[depth], prism, parts[settings[setting]][prism])
        for setting in sorted(settings)
        for depth in sorted(depths)
        if prism is not None and (setting, depth) not in at
    ]
    many = " and others" if len(missing) > 3 else ""
    return f"{', '.join(missing[:3])}{many} {'is' if len(missing) == 1 else 'are'} missing"


def _warn_of_a_gap(names: _Names, index: int) -> None:
    """Warn StackWarning where the numbers that count planes leave one out. index: of the part of the names."""
    pairs = zip(names.files, names.parts, strict=True)
    numbered = {_number(name[index]): file for file, name in pairs if _is_number(name[index])}
    numbers = sorted(numbered)
    steps = [b - a for a, b in pairwise(numbers)]
    most = min(steps, default=0.0) * (_WIDE if names.signed else 1.0)
    wide = next((i for i, step in enumerate(steps) if step > most), None)
    if wide is None:
        return
    before, after = numbered[numbers[wide]], numbered[numbers[wide + 1]]
    if names.signed:
        said = f"{before.name} and {after.name} are further apart than other planes; all are taken as equally spaced"
    else:
        part = names.parts[list(names.files).index(before)][index]
        name = names.renamed(before, index, str(int(numbers[wide] + min(steps))).zfill(len(part)))
        between = f"{before.name} and {after.name}"
        said = f"{name} is missing between {between}; the planes are taken as equally spaced without it"
    warnings.warn(f"{names.files[0].parent}: {said}", StackWarning, stacklevel=5)


def _counts(name: Sequence[str], index: int, words: Sequence[str]) -> bool:
    """Whether the number at this place follows one of the words."""
    return _is_number(name[index]) and index > 0 and name[index - 1].lower() in words


def _is_number(part: str) -> bool:
    return part[-1].isdecimal()


def _key(part: str) -> list[tuple[int, float, str]]:
    """The key by which parts of names are sorted: numbers by their value."""
    return [(0, _number(part), "")] if _is_number(part) else natural(part)


def _number(part: str) -> float:
    """The value of a number: a whole one is exact, however many digits a time has."""
    return int(part) if part.isdecimal() else float(part.replace("−", "-").replace(",", "."))


def _two(files: Sequence[Path]) -> str:
    return f"{files[0].name}, {files[-1].name}"
