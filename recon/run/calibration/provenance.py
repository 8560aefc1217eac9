"""Where each value of a calibrated configuration comes from, as the comment behind it."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence

from recon.calibration.optics import axes_of
from recon.calibration.trials.orders import Orders
from recon.config.schema import Config
from recon.run.calibration.found import FoundQuantity
from torchdic import Acquisition, Prism
from torchdic.scalar import number

# How `torchdic new` says of a prism where its parts come from.
_PARTS = re.compile(r"(?P<setting>.*?)length (?P<length>.*); angle (?P<angle>.*); bias (?P<bias>.*)")

# Angles that differ by less, in degrees, are the same.
SAME = 1e-6

_PRISMS, _FOCUS = "acquisition.prisms", "acquisition.focus"


def provenance(
    told: Config, now: Config, orders: Orders | None, found: Sequence[FoundQuantity], comments: Mapping[str, str]
) -> dict[str, str]:
    """The new comments, by the keys of the values that were found.

    told, now: the configuration before and after. comments: of the configuration's file, by their keys.
    """
    by_name = {quantity.name: quantity for quantity in found if quantity.told}
    declared = told.acquisition if orders is None else orders.chosen.acquisition
    made: dict[str, str] = {}
    turned = _by_orders(told.acquisition, orders)
    for place, parts in enumerate(_of_prisms(declared, by_name)):
        key = f"{_PRISMS}[{place}]"
        before = turned[place]
        if parts := before | {part: _then_also(before.get(part), words) for part, words in parts.items()}:
            made[key] = _with_parts(comments.get(key, ""), parts)
    if orders is not None and "signs and orders" in by_name:
        made |= _of_orders(told, orders, comments)
    key, condenser = "microscope.condenser", now.microscope.condenser
    if (quantity := by_name.get("condenser na")) is not None and condenser is not None:
        sure = f"± {quantity.uncertainty:.2g}"
        if number(condenser.na) != quantity.before:
            made[key] = f"calibrated: {sure}, told {quantity.before:g}"
        else:
            said = comments.get(key, comments.get(f"{key}.na", ""))
            agrees = f"calibrated: {quantity.value:.4g} {sure} agrees with it"
            made[key] = f"{said}; {agrees}" if said else agrees
    if "aberrations" in by_name:
        made["microscope.objective"] = _then(comments, "microscope.objective", "aberrations calibrated: by the bead")
    if now.reconstruction.learn != told.reconstruction.learn:
        made["reconstruction.learn"] = "calibrated: a drift shows"
    return made


def _by_orders(told: Acquisition, orders: Orders | None) -> list[dict[str, str]]:
    """Of each prism the parts that signs and orders have changed: what was measured of the told ones isn't of these."""
    changed: list[dict[str, str]] = [{} for _ in told.prisms]
    if orders is None:
        return changed
    for parts, before, prism in zip(changed, told.prisms, orders.chosen.acquisition.prisms, strict=True):
        if before is None or prism is None:
            continue
        (_, angle, bias), (_, turned, other) = _polar(before), _polar(prism)
        if abs((turned - angle + 180) % 360 - 180) > SAME:
            parts["angle"] = f"calibrated: {orders.chosen.what}, told {angle % 360:.4g}°"
        if abs(other - bias) > SAME:
            parts["bias"] = f"calibrated: {orders.chosen.what}, told {bias:.4g}°"
    return changed


def _of_prisms(declared: Acquisition, found: Mapping[str, FoundQuantity]) -> Iterator[dict[str, str]]:
    """Of each prism where its length, its angle and its bias come from, as far as they were found."""
    axes, sheared = axes_of(declared), 0
    for axis, prism in zip(axes, declared.prisms, strict=True):
        if prism is None:
            yield {}
            continue
        length, angle, bias = _polar(prism)
        parts = {}
        if (quantity := found.get("shear's length")) is not None:
            parts["length"] = _calibrated(quantity.uncertainty[axis], length, " µm")
        if (quantity := found.get("shear's angle")) is not None:
            parts["angle"] = _calibrated(math.degrees(quantity.uncertainty[axis]), angle % 360, "°")
        if (quantity := found.get("bias")) is not None:
            parts["bias"] = _calibrated(math.degrees(quantity.uncertainty[sheared]), bias, "°")
        elif (quantity := found.get("compensator's zero")) is not None:
            zero, sure = math.degrees(quantity.value), math.degrees(quantity.uncertainty)
            parts["bias"] = f"calibrated: the zero, {zero:.4g}° ± {sure:.2g}°, is added to the told {bias:.4g}°"
        sheared += 1
        yield parts


def _polar(prism: Prism) -> tuple[float, float, float]:
    """Length of the shear in µm, its angle and the bias in degrees."""
    y, x = map(number, prism.shear)
    return math.hypot(y, x), math.degrees(math.atan2(y, x)), math.degrees(number(prism.bias))


def _calibrated(sure: float, told: float, unit: str) -> str:
    return f"calibrated: ± {sure:.2g}{unit}, told {told:.4g}{unit}"


def _then_also(before: str | None, words: str) -> str:
    return words if before is None else f"{before}, then {words}"


def _with_parts(comment: str, parts: Mapping[str, str]) -> str:
    """A prism's comment, in which some parts are replaced; where it says none, they stand behind it."""
    known = _PARTS.fullmatch(comment)
    if known is None:
        words = "; ".join(f"{part} {words}" for part, words in parts.items())
        return f"{comment}; {words}" if comment else words
    said = {part: parts.get(part, known[part]) for part in ("length", "angle", "bias")}
    return known["setting"] + "; ".join(f"{part} {words}" for part, words in said.items())


def _of_orders(told: Config, orders: Orders, comments: Mapping[str, str]) -> dict[str, str]:
    """What signs and orders change in the comments of the prisms and the planes."""
    made = {}
    if orders.chosen.mistakes:
        made[_PRISMS] = _then(comments, _PRISMS, f"calibrated: {orders.chosen.what}")
    if len(told.acquisition.focus) > 1:
        turned = list(map(number, orders.chosen.acquisition.focus)) != list(map(number, told.acquisition.focus))
        order = f"calibrated: the planes' order, {'which was told reversed' if turned else 'as told'}"
        others = [part for part in comments.get(_FOCUS, "").split("; ") if part]
        kept = [part for part in others if not part.startswith("assumed: ")]
        # the depth of the sharpest plane has another sign then
        made[_FOCUS] = "; ".join([*(p for p in kept if not (turned and p.startswith("measured: "))), order])
    return made


def _then(comments: Mapping[str, str], key: str, words: str) -> str:
    return f"{comments[key]}; {words}" if key in comments else words
