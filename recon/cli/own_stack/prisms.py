"""Shear and bias of each setting of `torchdic new`: what the user gave, else what the images show, or a guess."""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from recon.config.commented import Sourced, chosen
from recon.config.schema import ConfigError
from recon.recording.survey.survey import SettingSurvey, Survey

# Values that nobody has said: a quarter wave of bias, and an angle that is as good as any.
_BIAS_DEGREES, _ANGLE_DEGREES = 90.0, 45.0

ANGLE = "shear's angle"

# Level of a setting's background relative to the brightest one's, below which it has no bias.
_DARK = 0.2

# Correlation of two settings' images, below which they aren't the same setting.
_UNLIKE = 0.5

# Of two settings' directions of shear, in degrees: below this apart they lie along one axis. All are below the second.
_ONE_AXIS, _ANY = 45.0, 91.0

# Length, angle in degrees and bias in degrees of a setting.
SettledPrism = tuple[Sourced, Sourced, Sourced]

# Of each setting the number of its axis of shear and the sign of its bias, which is 0 where its field is dark.
Places = Sequence[tuple[int, float]]


def settle_prisms(
    found: Survey, given: Mapping[str, Any], usual: float
) -> tuple[tuple[SettledPrism, ...], tuple[str, ...]]:
    """Length, angle and bias of each setting's shear, and a line where what was given isn't what the images show.

    given: under the names of the command's options; "shear_angle" and "bias" are sequences. usual: the length in µm
    that is taken where none is given.

    The first bias along an axis is taken as above 0, where not each is given. A setting much darker than the brightest
    has bias 0 where none is given, and the axis of the one before it: its images don't show any.
    Raises ConfigError for angles or biases that don't divide the settings.
    """
    length = chosen(given.get("shear"), None, usual, "shear's length", "λ/(2·NA), as is usual; the maker knows it")
    angles_told, biases_told = given.get("shear_angle") or (), given.get("bias") or ()
    axes, places = _placed(found.settings)
    remarks: list[str] = []
    groups = len(angles_told)
    if 1 < groups < len(places) and groups != len(axes) and len(places) % groups == 0:
        remarks.append(_remark_on_axes(angles_told, len(axes), len(places)))
        axes, places = _in_groups(found.settings, groups)
    told = _told_angles(angles_told, places, len(axes))
    seen, places = places, _as_told(places, told)
    biases = _biases(biases_told, places)
    for number, ((_, sign), bias) in enumerate(zip(places, biases, strict=True)):
        if len(biases_told) == 1 and not sign and bias.value:
            each = " ".join(f"{other.value if place[1] else 0:g}" for place, other in zip(places, biases, strict=True))
            remarks.append(
                f"warning: setting {number + 1}'s empty field is dark beside another's, as with bias 0; --bias "
                f"{bias.value:g} is kept: to give one for each setting: --bias {each}"
            )
    shown = [
        _angle(axis, lower=bool(given.get("lower")), turned=bool(biases_told) and _turned(seen, number, biases))
        for number, axis in enumerate(axes)
    ]
    angles = [shown[axis] if angle is None else angle for (axis, _), angle in zip(places, told, strict=True)]
    return tuple((length, angle, bias) for angle, bias in zip(angles, biases, strict=True)), tuple(remarks)


def _placed(settings: Sequence[SettingSurvey], within: float = _ONE_AXIS) -> tuple[list["_Axis"], Places]:
    """The axes of shear that settings show, and the places of these. within: degrees that settings of one axis keep."""
    axes: list[_Axis] = []
    places: list[tuple[int, float]] = []
    brightest = max(setting.level for setting in settings)
    for setting in settings:
        if setting.level < _DARK * brightest:
            places.append((places[-1][0] if places else 0, 0.0))
        else:
            places.append(_place(setting, axes, places, within))
    return axes or [_Axis()], places


def _in_groups(settings: Sequence[SettingSurvey], groups: int) -> tuple[list["_Axis"], Places]:
    """As many axes as the user says, each of as many settings, one after the other."""
    size = len(settings) // groups
    axes: list[_Axis] = []
    places: list[tuple[int, float]] = []
    for first in range(0, len(settings), size):
        part = [replace(one, likeness=one.likeness[first:]) for one in settings[first : first + size]]
        found, inside = _placed(part, _ANY)
        places += [(len(axes), sign) for _, sign in inside]
        axes.append(found[0])
    return axes, places


def _remark_on_axes(told: Sequence[float], axes: int, settings: int) -> str:
    size = settings // len(told)
    shared = ", ".join(
        f"{angle:g}° to settings {i * size + 1} {'and' if size == 2 else 'to'} {(i + 1) * size}"
        for i, angle in enumerate(told)
    )
    return (
        f"warning: the images show {_axes_in_words(axes)}, {len(told)} angles are given: {shared}; give one angle for "
        "each setting for another order"
    )


def _axes_in_words(axes: int) -> str:
    return f"{axes} axes of shear" if axes > 1 else "one axis of shear"


def _biases(told: Sequence[float], places: Places) -> list[Sourced]:
    """The bias of each setting: each as it was given, or one size for all with the signs that the images show."""
    name = "bias"
    if len(told) > 1:
        if len(told) != len(places):
            raise ConfigError(
                f"--bias {' '.join(f'{bias:g}' for bias in told)}: {len(told)} biases for {len(places)} prism "
                "settings: give one, or one for each setting"
            )
        return [Sourced(float(bias), "given", name=name) for bias in told]
    given = told[0] if told else None
    size = chosen(given, None, _BIAS_DEGREES, name, "a quarter wave; the compensator shows it")
    biases, begun = [], set()
    for axis, sign in places:
        if not sign:
            dark = "its empty field is dark beside another setting's"
            biases.append(size if told else Sourced(0.0, "measured", dark, name))
        elif told and axis in begun and size.value:  # 0 has no sign
            biases.append(Sourced(sign * size.value, "measured", "its sign; its size is given", name))
        else:
            biases.append(replace(size, value=sign * size.value or 0.0))
        begun |= {axis} if sign else set()
    return biases


def _turned(places: Places, axis: int, biases: Sequence[Sourced]) -> bool:
    """Whether the biases along an axis have the other signs than its settings were placed with."""
    signs = [
        sign * (1 if bias.value % 360 < 180 else -1)
        for (place, sign), bias in zip(places, biases, strict=True)
        if place == axis and bias.value % 180  # half a turn has no sign
    ]
    return sum(signs) < 0


def _told_angles(told: Sequence[float], places: Places, axes: int) -> list[Sourced | None]:
    """The angle of each setting as far as the user gave it: one for each axis, or one for each setting.

    A single one is of the first axis. places: number of the axis, and sign of the bias, of each setting. axes: how many
    there are. Raises ConfigError for another number of angles.
    """
    if len(told) == axes or len(told) <= 1:
        given = [told[axis] if axis < len(told) else None for axis, _ in places]
    elif len(told) == len(places):
        given = list(told)
    else:
        raise ConfigError(
            f"--shear-angle {' '.join(f'{angle:g}' for angle in told)}: {len(told)} angles, and the images show "
            f"{_axes_in_words(axes)} in {len(places)} prism settings: give one for each axis, or one for each setting"
        )
    return [None if angle is None else Sourced(float(angle), "given", name=ANGLE) for angle in given]


def _as_told(places: Places, told: Sequence[Sourced | None]) -> Places:
    """The settings' axes and signs of bias; of those on one axis whose angles are given reversed the signs are, too."""
    first: dict[int, float] = {}
    turned = []
    for (axis, sign), angle in zip(places, told, strict=True):
        if angle is not None:
            apart = math.radians(angle.value - first.setdefault(axis, angle.value))
            sign = sign if math.cos(apart) >= 0 else -sign
        turned.append((axis, sign))
    return turned


@dataclass
class _Axis:
    """What settings show of one axis of shear.

    shown: their directions as e^(iθ)/σ², turned round where the bias is below 0. signed: whether any knows which way.
    """

    shown: list[complex] = field(default_factory=list)
    signed: bool = False


def _place(setting: SettingSurvey, axes: list[_Axis], places: Places, within: float) -> tuple[int, float]:
    """The number of a setting's axis of shear, and the sign of its bias; adds what it shows of the axis, or a new axis.

    places: of the settings before it. within: degrees that settings of one axis keep. A setting whose direction has no
    sign has the bias that its likeness to those shows, and one without a direction the axis too.
    """
    direction, (near, likely) = setting.direction, _likely(setting, places)
    if direction is None:
        if not axes:
            axes.append(_Axis())
        return near, likely
    shown = cmath.rect(1 / direction.uncertainty**2, direction.angle)
    for number, axis in enumerate(axes):
        mean = sum(axis.shown)
        along = math.copysign(1.0, (shown / mean).real) if mean else likely
        apart = abs(math.degrees(cmath.phase(along * shown / mean))) if mean else 0.0
        if apart < within:
            if direction.signed and any(
                place == (number, along) and like < _UNLIKE
                for like, place in zip(setting.likeness, places, strict=True)
            ):
                along = -along  # images so unlike have another bias; what all settings see out of focus hides it
            sign = along if direction.signed and (axis.signed or not axis.shown) else likely
            axis.shown.append(along * shown)
            axis.signed |= direction.signed
            return number, sign
    axes.append(_Axis([shown], direction.signed))
    return len(axes) - 1, 1.0


def _likely(setting: SettingSurvey, places: Places) -> tuple[int, float]:
    """The axis and the sign of the bias of a setting whose images show neither, by their likeness to others'.

    What all settings have in common, as out of focus, makes them alike; opposite biases on one axis are the least so.
    """
    others = [(like, *place) for like, place in zip(setting.likeness, places, strict=True) if place[1]]
    if not others:
        return 0, 1.0
    like, axis, sign = min(others)
    if like < _UNLIKE:
        return axis, -sign
    return max(others)[1:]


def _angle(axis: _Axis, *, lower: bool, turned: bool) -> Sourced:
    """The angle of an axis in degrees, from what its settings show together.

    turned: whether the biases are given, and reversed. Its uncertainty is that of their weighted mean, or half of how
    far they are apart where that is more.
    """
    if not axis.shown:
        return Sourced(_ANGLE_DEGREES, "assumed", "the images show none; from dark edge to bright", ANGLE)
    mean = sum(axis.shown)
    beside = max(abs(math.degrees(cmath.phase(one / mean))) for one in axis.shown)
    sure = max(math.degrees(1 / math.sqrt(sum(map(abs, axis.shown)))), beside / 2)
    degrees = math.degrees(cmath.phase(mean)) + (180 if lower != turned and axis.signed else 0)
    if axis.signed:
        bias = "as given" if turned else "between 0° and 180°"
        why = f"± {sure:.0f}°, if Δn is {'below' if lower else 'above'} 0 and the bias {bias}"
    else:
        why = f"± {sure:.0f}°, or the opposite: the images don't show which"
    return Sourced(round(degrees % 360, 1), "measured", why, ANGLE)
