"""A configuration as people write one: the keys of `torchdic new`, files from its folder, and the comments kept."""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from recon.config.commented import Line, commented, comments_of
from recon.config.conversion import NONE, plain
from recon.config.encoding import decoded
from recon.config.including import relative_to, values_of
from recon.config.schema import Config
from recon.config.spelling import BRIGHT_FIELD, DEGREES, WITHIN, canonical
from torchdic import Prism
from torchdic.scalar import number

Table = dict[str, Any]

# Digits of an angle and a length that were computed of others: their rounding is gone, and nothing else.
_DIGITS = 12


@dataclass(frozen=True)
class Source:
    """What a configuration's file says: its values as TOML holds them, and the comments behind them by their keys."""

    values: Table = field(default_factory=dict)
    comments: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path) -> "Source":
        """Of a file that can be loaded, with those that it includes."""
        values, included = values_of(path)
        comments: dict[str, str] = {}
        for file in (*included, path):
            comments |= comments_of(decoded(file.read_bytes()))
        return cls(values, comments)


def rewritten(
    config: Config, folder: Path, source: Source, comments: Mapping[str, str], head: Sequence[str] = ()
) -> str:
    """A configuration as TOML: what its file says, and what differs from the defaults.

    folder: in which it will be, from which files are named. source: whose comments stay, where `comments` has no other.
    head: lines of comment at the beginning.
    """
    values = _spelled(config, source.values)
    # prisms that name their files and channels say them in their own lines
    said = source.values.get("acquisition", {}).get("prisms", ())
    for key, listed in (("file", "paths"), ("channel", "channels")):
        if any(isinstance(prism, dict) and key in prism for prism in said):
            values["data"].pop(listed, None)
    return _text(relative_to(values, folder), source, comments, head)


def rewritten_microscope(config: Config, source: Source, comments: Mapping[str, str], head: Sequence[str] = ()) -> str:
    """The microscope, the prisms and how closely they are known, to be included by the configurations of other stacks.

    config, source, comments, head: as of `rewritten`.
    """
    values = _spelled(config, source.values)
    prisms = [_prism(prism) for prism in config.acquisition.prisms]
    kept = {"microscope": values["microscope"], "acquisition": {"prisms": prisms}}
    known = config.calibration
    within = {name: getattr(known, name) for name in ("length_within", *WITHIN)}
    kept["calibration"] = _in_degrees(within, ())
    # what was said of how closely prisms were known before isn't true any more
    others = {key: comment for key, comment in source.comments.items() if not key.startswith("calibration.")}
    return _text(kept, replace(source, comments=others), comments, head)


def _text(values: Table, source: Source, comments: Mapping[str, str], head: Sequence[str]) -> str:
    known = {**source.comments, **comments}
    top, tables = [], {}
    for name, value in _ordered(values, source.values).items():
        if isinstance(value, dict):
            below = _ordered(value, source.values.get(name, {}))
            tables[name] = [_line(f"{name}.{key}", key, each, known) for key, each in below.items()]
        else:
            top.append(_line(name, name, value, known))
    return commented(head, top, tables)


def _line(place: str, key: str, value: Any, known: Mapping[str, str]) -> Line:
    """A value with its comment, or with those of its parts, which had lines of their own."""
    below = [comment for other, comment in known.items() if other.startswith(f"{place}.")]
    comment = known.get(place) or "; ".join(below)
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        elements = (Line("", each, known.get(f"{place}[{i}]", "")) for i, each in enumerate(value))
        return Line(key, tuple(elements), comment)
    return Line(key, value, comment)


def _ordered(values: Table, said: Any) -> Table:
    """The values in the order in which a table of the file says them, and the others behind them."""
    first = [key for key in said if key in values] if isinstance(said, dict) else []
    return {key: values[key] for key in (*first, *values)}


def _spelled(config: Config, said: Table) -> Table:
    """The values of a configuration in the keys of `torchdic new`, or of its file where that has other ones."""
    values = {name: value for name, value in _told(config, said).items() if value not in ({}, [])}
    volume, acquisition = said.get("volume", {}), said.get("acquisition", {})
    if "spacing" not in volume:
        thickness, *sides = values["volume"].pop("spacing")
        values["volume"]["pixel_size"] = sides[0] if sides[0] == sides[1] else sides
        values["volume"]["slice_thickness"] = thickness
    if "prisms" in values["acquisition"]:
        named = acquisition.get("prisms", [{}] * len(config.acquisition.prisms))
        values["acquisition"]["prisms"] = [
            _prism(prism, was) for prism, was in zip(config.acquisition.prisms, named, strict=True)
        ]
    if "calibration" in values:
        values["calibration"] = _in_degrees(values["calibration"], said.get("calibration", ()))
    if not isinstance(acquisition.get("focus"), list) and "focus" in values["acquisition"]:
        values["acquisition"]["focus"] = _focus(values["acquisition"]["focus"])
    return values


def _told(value: Any, said: Any) -> Any:
    """A section as TOML can hold it, without what is absent by default and isn't said in the file."""
    if not dataclasses.is_dataclass(value):
        return plain(value)
    found: Table = {}
    said = said if isinstance(said, dict) else {}
    for each in dataclasses.fields(value):
        below = getattr(value, each.name)
        factory = each.default_factory
        usual = each.default if factory is dataclasses.MISSING else factory()
        if each.name not in said and usual is not dataclasses.MISSING and plain(below) == plain(usual):
            continue
        found[each.name] = NONE if below is None else _told(below, said.get(each.name))
    return found


def _prism(prism: Prism | None, was: Any = None) -> Any:
    """A prism by its shear's length and angle and its bias in degrees, with the file or channel of its images."""
    where = {key: was[key] for key in ("file", "channel") if isinstance(was, dict) and key in was}
    if prism is None:
        return {BRIGHT_FIELD: True, **where} if where else BRIGHT_FIELD
    y, x = map(number, prism.shear)
    angle = math.degrees(math.atan2(y, x))
    told: Table = {"shear": {"length": _round(math.hypot(y, x)), "angle_degrees": _round(angle % 360)}}
    told["bias_degrees"] = _round(math.degrees(number(prism.bias)))
    if prism.axis is not None:
        told["axis_degrees"] = _round(math.degrees(number(prism.axis)))
    return told | where


def _in_degrees(calibration: Table, said: Collection[str]) -> Table:
    """How a calibration works, its angles in degrees but for those that the file says in rad."""
    in_rad = {key: value for key, value in calibration.items() if key in WITHIN and key not in said}
    kept = {key: value for key, value in calibration.items() if key not in in_rad}
    return kept | {f"{key}{DEGREES}": _round(math.degrees(value)) for key, value in in_rad.items()}


def _focus(planes: list[float]) -> Any:
    """Planes as the first, the step and their count where they are exactly these, or one by one."""
    if len(planes) < 2:
        return planes
    first, step = planes[0], _round(planes[1] - planes[0])
    table = {"first": first, "step": step, "count": len(planes)}
    try:
        again = canonical({"acquisition": {"focus": table}})["acquisition"]["focus"]
    except ValueError:  # a step of 0
        return planes
    return table if again == planes else planes


def _round(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")
