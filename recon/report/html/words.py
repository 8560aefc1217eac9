"""Numbers as the page says them."""

import math
from collections.abc import Sequence
from typing import TypeGuard

from recon.config.spelling import BRIGHT_FIELD

# What stands for a number that isn't known.
NONE = "–"


def short(value: object, digits: int = 3) -> str:
    """A number of a few significant digits with a true minus sign; a dash for what is none."""
    if not is_number(value):
        return NONE
    value += 0  # a −0 is 0
    if value and (abs(value) < 1e-4 or abs(value) >= 1e6):
        mantissa, power = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa} × 10{_raised(int(power))}".replace("-", "−")
    written = f"{value:.{digits}g}"
    if abs(float(written)) >= 10**digits:  # "g" would write 1e+03
        written = f"{value:.0f}"
    return written.replace("-", "−")


def sure(value: object, error: object) -> str:
    """A number and its standard deviation, with as many digits as that has."""
    if not is_number(value) or not is_number(error) or error <= 0:
        return short(value, 5)
    decimals = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{decimals}f} ± {error:.{decimals}f}".replace("-", "−")


def percent(share: object, decimals: int = 0) -> str:
    """A share of 1 in percent."""
    return f"{100 * share:.{decimals}f} %".replace("-", "−") if is_number(share) else NONE


def times(values: Sequence[object], digits: int = 3) -> str:
    """Sizes along several axes: 20 × 64 × 64."""
    return " × ".join(short(value, digits) for value in values)


def duration(seconds: object) -> str:
    """A time as one says it: 0.8 s, 42 s, 3 min 20 s, 2 h 5 min."""
    if not is_number(seconds):
        return NONE
    if seconds < 59.5:
        return f"{short(seconds, 2)} s" if seconds < 10 else f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def size(number: object) -> str:
    """A number of bytes: 340 kB, 12 MB, 1.3 GB."""
    if not is_number(number):
        return NONE
    for unit, power in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if number >= power:
            return f"{short(number / power)} {unit}"
    return f"{number:.0f} bytes"


def prism_words(prism: object) -> str:
    """A prism setting of a configuration: its shear's length and direction, and its bias; bright field for none."""
    if not isinstance(prism, dict):
        return "bright field" if prism == BRIGHT_FIELD else ""
    shear, bias = prism.get("shear"), prism.get("bias")
    if not (isinstance(shear, list) and len(shear) == 2 and isinstance(bias, int | float)):
        return ""
    y, x = shear
    angle = math.degrees(math.atan2(y, x))
    parts = f"shear {short(math.hypot(y, x))} µm towards {short(angle)}°", f"bias {short(math.degrees(bias))}°"
    return ", ".join(parts)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _raised(power: int) -> str:
    return str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
