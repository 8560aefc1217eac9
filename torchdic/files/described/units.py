"""Lengths as headers write them, in any unit and spelling, become µm."""

import html
import math
import re
import unicodedata
import warnings
from pathlib import Path

from torchdic.errors import StackWarning

# SI prefixes from OME's schema 2016-06, and the words for those that name a length under a microscope
_SMALLER = {"f": 1e-15, "p": 1e-12, "n": 1e-9, "µ": 1e-6, "u": 1e-6, "m": 1e-3, "c": 1e-2, "d": 1e-1, "": 1.0}
_LARGER = {"da": 1e1, "h": 1e2, "k": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "P": 1e15}
_WORDS = {"femto": 1e-15, "pico": 1e-12, "nano": 1e-9, "micro": 1e-6, "milli": 1e-3, "centi": 1e-2, "deci": 1e-1}

_INCH = 2.54e4

_MICROMETRES = {
    **{f"{prefix}m": factor * 1e6 for prefix, factor in {**_SMALLER, **_LARGER}.items()},
    **{
        f"{word}{metre}{plural}": factor * 1e6
        for word, factor in {**_WORDS, "": 1.0}.items()
        for metre in ("metre", "meter")
        for plural in ("", "s")
    },
    **dict.fromkeys(("micron", "microns"), 1.0),
    **dict.fromkeys(("Å", "A", "angstrom", "angstroms", "ångström", "ångströms"), 1e-4),
    **dict.fromkeys(("in", "inch", "inches", '"'), _INCH),
    **dict.fromkeys(("thou", "thous", "mil", "mils"), _INCH / 1e3),
    "li": _INCH / 12,
    "pt": _INCH / 72,
    **dict.fromkeys(("ft", "foot", "feet"), 12 * _INCH),
    **dict.fromkeys(("yd", "yard", "yards"), 36 * _INCH),
}

_UNCALIBRATED = ("", "pixel", "pixels", "px", "voxel", "voxels", "reference frame")  # a size in these is no length

_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")


def micrometres(value: object, unit: str, name: str, path: Path) -> float | None:
    """A length in µm; None where it has no unit of length or is none. Warns StackWarning of what is no length.

    value: a number, or a text that should be one. A decimal comma is read as one, with a warning; NaN is no value.
    unit: as the header spells it.
    name: of the length in the header, for messages.
    """
    if value is None or (isinstance(value, float) and math.isnan(value)) or _plain(unit).lower() in _UNCALIBRATED:
        return None
    length = _number(value, name, path)
    if length is None:
        return None
    factor = _factor(unit)
    if factor is None:
        _warn(f"{path}: its {name} of {length:g} {unit!r} is in no known unit of length; ignored")
        return None
    if not (math.isfinite(length) and length > 0):
        _warn(f"{path}: its {name} of {length:g} {unit} is not above 0; ignored")
        return None
    return length * factor


def _number(value: object, name: str, path: Path) -> float | None:
    text = str(value).strip()
    try:
        return float(text)
    except ValueError:
        pass
    if _DECIMAL_COMMA.fullmatch(text):
        number = float(text.replace(",", "."))
        _warn(f"{path}: its {name} is {text!r}; the comma is read as a decimal point: {number:g}")
        return number
    _warn(f"{path}: its {name} is {text!r}, which is no number; ignored")
    return None


def _factor(unit: str) -> float | None:
    """How many µm the unit is; None for no unit of length. Capitals count where both are units (mm and Mm)."""
    spelled = _plain(unit)
    return _MICROMETRES.get(spelled, _MICROMETRES.get(spelled.lower()))


def _plain(unit: str) -> str:
    """A unit in one spelling: without escapes, and with one of the two characters that look like µ, and like Å."""
    text = re.sub(r"\\u([0-9a-fA-F]{4})", lambda found: chr(int(found[1], 16)), html.unescape(unit))
    text = text.replace("\u00c2\u00b5", "\u00b5")  # UTF-8 that was read as Latin-1
    return unicodedata.normalize("NFKC", text).replace("\u03bc", "\u00b5").strip().rstrip(".")


def _warn(message: str) -> None:
    warnings.warn(message, StackWarning, stacklevel=4)
