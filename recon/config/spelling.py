"""The keys that people think in, brought to those of the configuration's dataclasses.

A file may give degrees for radians, a length and an angle for a vector, a first plane and a step for a list of planes,
and the side of a pixel for that of a voxel. `canonical` replaces them by the keys that everything else knows, so that
the resolved configuration holds one spelling of each value.
"""

import difflib
import math
from collections.abc import Iterable, Mapping
from typing import Any

from recon.config.media import index_of

# Keys of a prism that are angles in rad, each of which may be given in degrees.
ANGLES = ("bias", "polariser", "axis", "wedge")

# What is appended to an angle's key where it is in degrees.
DEGREES = "_degrees"

# How closely angles are known, in rad, each of which may be given in degrees.
WITHIN = ("bias_within", "angle_within")

# The keys of a layer that name its media, and what each stands for.
_OF_LAYERS = {"depth": "thickness", "medium": "index", "design": "design_index"}

# Further keys of a table, beside the fields of its dataclass, by the dataclass's name.
_OF_PRISMS = (*(f"{angle}{DEGREES}" for angle in ANGLES), "file", "channel")
FURTHER: dict[str, tuple[str, ...]] = {
    "Config": ("include",),
    "VolumeSection": ("pixel_size", "slice_thickness"),
    "Prism": _OF_PRISMS,
    "CompensatorSection": _OF_PRISMS,
    "WedgeSection": _OF_PRISMS,
    "Layer": tuple(_OF_LAYERS),
    "CalibrationSection": tuple(f"{angle}{DEGREES}" for angle in WITHIN),
}

# Sets of keys that exclude each other because they say the same, by the key of their table.
ALTERNATIVES: dict[str, tuple[tuple[tuple[str, ...], ...], ...]] = {
    "": ((("tolerance",), ("fidelity",)),),
    "volume": ((("spacing",), ("pixel_size", "slice_thickness")),),
    "data": ((("path",), ("paths",)),),
    "microscope.objective.layer": tuple(((old,), (new,)) for new, old in _OF_LAYERS.items()),
}

# The name by which a list of prisms holds bright field, which has none.
BRIGHT_FIELD = "brightfield"

Table = dict[str, Any]


def canonical(values: Mapping[str, Any]) -> Table:
    """A configuration's values under the keys of its dataclasses.

    values: of a configuration file, as TOML holds them; they are left as they are. What is of a wrong type where no
    other spelling is possible is passed on. Raises ValueError, with the key and the law in one line, where two
    spellings of one value are given or one of them lacks a part, and TypeError where a part is no number.
    """
    known = dict(values)
    for table in ("volume", "specimen"):
        if isinstance(known.get(table), dict) and isinstance(known[table].get("background"), str):
            known[table] = {**known[table], "background": index_of(known[table]["background"], f"{table}.background")}
    if isinstance(known.get("volume"), dict):
        known["volume"] = _volume(known["volume"])
    known = _with_layer(known)
    if isinstance(known.get("calibration"), dict):
        known["calibration"] = _in_rad(known["calibration"], "calibration", WITHIN)
    if isinstance(known.get("acquisition"), dict):
        known["acquisition"] = _acquisition(known["acquisition"])
        if isinstance(known["acquisition"].get("prisms"), list):
            known = _recordings(known, known["acquisition"]["prisms"])
    return known


def direction(length: float, degrees: float) -> tuple[float, float]:
    """The vector (y, x) of a length at an angle, counted from +x (right) toward +y (downward on a screen: rows grow).

    So 0° is (0, length), 90° is (length, 0), and 40° points right and downward.
    """
    angle = math.radians(degrees)
    # a right angle's cosine is 0, not 6e-17
    y, x = (0.0 if abs(part) < 1e-15 else length * part for part in (math.sin(angle), math.cos(angle)))
    return y, x


def unknown_key(name: str, known: Iterable[str]) -> str:
    """What to say of an unknown key: the known one that it resembles, or all of them."""
    choices = list(known)
    close = difflib.get_close_matches(name, choices, n=1) or [key for key in choices if key.startswith(name)]
    return f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(choices)}"


def _volume(section: Table) -> Table:
    """The side of a pixel and the thickness of a slice as the spacing (z, y, x)."""
    named = [key for key in FURTHER["VolumeSection"] if key in section]
    if not named:
        return section
    if "spacing" in section:
        raise ValueError(f"volume.spacing and volume.{named[0]} say the same: leave one out")
    if len(named) < 2:
        missing = next(key for key in FURTHER["VolumeSection"] if key not in section)
        if not set(section) <= {"shape", "background", *named}:
            return section  # a misspelt key is told before a missing one
        raise ValueError(f"missing key volume.{missing}, which goes with {named[0]}")
    others = {key: value for key, value in section.items() if key not in named}
    size, thickness = section["pixel_size"], section["slice_thickness"]
    sides = size if isinstance(size, list) else [size, size]
    if len(sides) != 2:
        raise ValueError(f"volume.pixel_size: {size!r} must be a number, or a pair (y, x)")
    given = (("slice_thickness", thickness), *(("pixel_size", side) for side in sides))
    return {**others, "spacing": [_number(value, f"volume.{key}") for key, value in given]}


def _with_layer(values: Table) -> Table:
    """The values with the layer of the objective by thickness and indices, if there is one."""
    microscope = values.get("microscope")
    objective = microscope.get("objective") if isinstance(microscope, dict) else None
    layer = objective.get("layer") if isinstance(objective, dict) else None
    if not isinstance(microscope, dict) or not isinstance(objective, dict) or not isinstance(layer, dict):
        return values
    changed, key = dict(layer), "microscope.objective.layer"
    for new, old in _OF_LAYERS.items():
        if new not in layer:
            continue
        if old in layer:
            raise ValueError(f"{key}.{old} and {key}.{new} say the same: leave one out")
        read = _number if new == "depth" else index_of
        changed[old] = read(changed.pop(new), f"{key}.{new}")
    return {**values, "microscope": {**microscope, "objective": {**objective, "layer": changed}}}


def _acquisition(section: Table) -> Table:
    """The focus as a list of planes, and each prism by its shear (y, x) and its angles in rad."""
    changed = dict(section)
    if isinstance(section.get("focus"), dict):
        changed["focus"] = _planes(section["focus"])
    if isinstance(section.get("prisms"), list):
        changed["prisms"] = [
            _prism(prism, f"acquisition.prisms[{index}]") if isinstance(prism, dict) else prism
            for index, prism in enumerate(section["prisms"])
        ]
    return changed


def _planes(table: Table) -> list[float]:
    """The planes that a table of the first one, the step and their count names."""
    key = "acquisition.focus"
    first, step, count = _parts(table, key, ("first", "step", "count"))
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"{key}.count: {count!r} must be a whole number of at least 1")
    start, width = _number(first, f"{key}.first"), _number(step, f"{key}.step")
    if width == 0 and count > 1:
        raise ValueError(f"{key}.step: 0 makes {count} planes one; it is the distance between two planes in µm")
    # thirteen digits: sums of tenths are tenths again
    return [float(f"{start + number * width:.13g}") for number in range(count)]


def _prism(table: Table, key: str) -> Table | str:
    """A prism with its shear as (y, x) and its angles in rad; bright field by its name."""
    if table == {BRIGHT_FIELD: True}:
        return BRIGHT_FIELD
    changed = _in_rad(table, key, ANGLES)
    if isinstance(table.get("shear"), dict):
        parts = _parts(table["shear"], f"{key}.shear", ("length", "angle_degrees"))
        length, degrees = (
            _number(value, f"{key}.shear.{name}")
            for name, value in zip(("length", "angle_degrees"), parts, strict=True)
        )
        changed["shear"] = list(direction(length, degrees))
    return changed


def _in_rad(table: Table, key: str, angles: Iterable[str]) -> Table:
    """A table with those of its angles that are given in degrees in rad. key: of the table."""
    changed = dict(table)
    for angle in angles:
        named = f"{angle}{DEGREES}"
        if named not in table:
            continue
        if angle in table:
            raise ValueError(f"{key}.{angle} and {key}.{named} say the same: leave one out")
        changed[angle] = math.radians(_number(changed.pop(named), f"{key}.{named}"))
    return changed


def _recordings(values: Table, prisms: list[Any]) -> Table:
    """The file and the channel of each prism's images as [data] lists them.

    A table that says nothing but that it is bright field, and where its images are, becomes the name of bright field.
    """
    files, channels = (_of_each(prisms, key) for key in ("file", "channel"))
    if files is None and channels is None:
        return values
    data = values.get("data", {})
    if not isinstance(data, dict):
        return values
    for each, given, others in (("file", files, ("path", "paths")), ("channel", channels, ("channels",))):
        for other in others:
            if given is not None and other in data:
                raise ValueError(f"data.{other} and acquisition.prisms[0].{each} say the same: leave one out")
    bare = [_without_recording(prism) if isinstance(prism, dict) else prism for prism in prisms]
    listed = {key: given for key, given in (("paths", files), ("channels", channels)) if given is not None}
    return {**values, "acquisition": {**values["acquisition"], "prisms": bare}, "data": {**data, **listed}}


def _of_each(prisms: list[Any], key: str) -> list[Any] | None:
    """A key's value of each prism; None where no prism has it. Raises ValueError where some have it."""
    having = [isinstance(prism, dict) and key in prism for prism in prisms]
    if not any(having):
        return None
    if not all(having):
        index = having.index(False)
        hint = "" if isinstance(prisms[index], dict) else f", as in {{ brightfield = true, {key} = … }}"
        raise ValueError(f"missing key acquisition.prisms[{index}].{key}: every prism has one, or none does{hint}")
    return [prism[key] for prism in prisms]


def _without_recording(prism: Table) -> Any:
    bare = {key: value for key, value in prism.items() if key not in ("file", "channel")}
    return BRIGHT_FIELD if bare == {BRIGHT_FIELD: True} else bare


def _parts(table: Table, key: str, names: tuple[str, ...]) -> list[Any]:
    """The values of a table that must have these keys and no others."""
    for name in table:
        if name not in names:
            raise ValueError(f"unknown key {key}.{name}; {unknown_key(name, names)}")
    for name in names:
        if name not in table:
            raise ValueError(f"missing key {key}.{name}; it goes with {', '.join(table) or 'no other'}")
    return [table[name] for name in names]


def _number(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{key}: {value!r} must be a number")
    return float(value)
