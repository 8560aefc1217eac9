"""What a calibration found: each quantity with its value, its uncertainty and how it was found, or why it wasn't."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from recon.calibration.trials.orders import Orders
from recon.config.schema import Config
from recon.config.spelling import direction
from torchdic import Prism
from torchdic.scalar import number

# The quantity that is a direction.
DIRECTION = "shear's angle"

LENGTH = "shear's length"

# A value, or one for each prism, axis, image, …
Value = Any


@dataclass(frozen=True)
class FoundQuantity:
    """One quantity.

    name: of it. unit: in words; empty for a pure number. before: what the configuration says; None where it says
    nothing. value: what was found, or `before` where nothing was. uncertainty: one standard deviation, of the value's
    shape; None where there is none. how: it was found, or why it was left. told: whether it was found.
    """

    name: str
    unit: str
    before: Value
    value: Value
    uncertainty: Value
    how: str
    told: bool = True

    def as_json(self) -> dict[str, Any]:
        """As calibration.json holds it."""
        parts = ("value", "uncertainty", "how", "before", "unit")
        return {part: getattr(self, part) for part in parts} | {"found": self.told}

    @property
    def words(self) -> str:
        """In one line."""
        if not self.told:
            before = "" if self.before is None else f" ({self._short(self.before)}{'°' if self.unit == 'rad' else ''})"
            return f"{self.name}: left as told{before}: {self.how}"
        sure = "" if self.uncertainty is None else f" ± {self._short(self.uncertainty, 2)}"
        unit = {"": "", "rad": "°"}.get(self.unit, f" {self.unit}")
        before = "" if self.before is None else f", told {self._short(self.before)}{unit}"
        return f"{self.name}: {self._short(self.value)}{sure}{unit}{before} ({self.how})"

    def _short(self, value: Value, digits: int = 4) -> str:
        """A value in a line, angles in degrees."""
        if self.unit != "rad":
            return _short(value, digits)
        # of a direction, not of how sure it is, a full turn makes no difference: as `torchdic new` writes it
        turns = self.name == DIRECTION and value is not self.uncertainty
        return _short(_in_degrees(value, 360 if turns else None), digits)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a calibration found. config: with the found values. orders: None where they couldn't be tried."""

    config: Config
    orders: Orders | None
    found: tuple[FoundQuantity, ...]


def left(name: str, unit: str, before: Value, why: str) -> FoundQuantity:
    """A quantity that the images don't tell."""
    return FoundQuantity(name, unit, before, before, None, why, told=False)


def rounded(value: Any, digits: int) -> float:
    """A number, or a tensor of one, of a few significant digits."""
    return float(f"{number(value):.{digits}g}")


def rounded_shear(prism: Prism) -> Prism:
    """A prism whose shear has five significant digits of length and degrees, as its axis; its bias stays as it is."""
    y, x = map(number, prism.shear)
    shear = direction(rounded(math.hypot(y, x), 5), rounded(math.degrees(math.atan2(y, x)), 5))
    return replace(prism, shear=shear, axis=None if prism.axis is None else rounded_angle(prism.axis))


def rounded_angle(angle: Any) -> float:
    """An angle in rad that has five significant digits in degrees, in which configurations hold it."""
    return math.radians(rounded(math.degrees(number(angle)), 5))


def plain(value: torch.Tensor, digits: int = 6) -> Value:
    """A tensor as numbers of a few significant digits, in lists of its shape."""

    def of(values: Any) -> Any:
        return [of(part) for part in values] if isinstance(values, list) else rounded(values, digits)

    return of(value.detach().double().tolist())


def _short(value: Value, digits: int = 4) -> str:
    """A value in a line; of many numbers the least and the greatest."""
    if isinstance(value, dict):
        return ", ".join(f"{name}: {_short(part, digits)}" for name, part in value.items())
    numbers = _numbers(value)
    if numbers is None:
        return str(value)
    if len(numbers) > 4:
        return f"{min(numbers):.{digits}g} … {max(numbers):.{digits}g}"
    return ", ".join(f"{number:.{digits}g}" for number in numbers)


def _in_degrees(value: Value, turn: float | None = None) -> Value:
    """The same in degrees. turn: the values are counted from 0 to it."""
    if isinstance(value, dict):
        return {name: _in_degrees(part, turn) for name, part in value.items()}
    if isinstance(value, list):
        return [_in_degrees(part, turn) for part in value]
    return math.degrees(value) if turn is None else math.degrees(value) % turn


def _numbers(value: Value) -> list[float] | None:
    if isinstance(value, int | float):
        return [float(value)]
    if not isinstance(value, Sequence) or isinstance(value, str):
        return None
    parts = [_numbers(part) for part in value if part is not None]
    if not parts or any(part is None for part in parts):
        return None
    return [number for part in parts for number in part or ()]
