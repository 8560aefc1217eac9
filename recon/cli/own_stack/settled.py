"""What a configuration says of a stack: what the user gave, else what the file says or its images show, or a guess."""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from recon.config.commented import Sourced
from recon.config.schema import ConfigError
from recon.recording.survey.dark_counts import DarkCounts
from recon.recording.survey.survey import SettingSurvey, Survey
from torchdic.files.format import Stack
from torchdic.files.gathered import Gathered

# Values that nobody has said: green light, a dry objective of high aperture, a watery medium, a quarter wave of bias.
WAVELENGTH, NA, BACKGROUND, _BIAS_DEGREES, _ANGLE_DEGREES = 0.55, 0.9, 1.335, 90.0, 45.0

ANGLE = "shear's angle"

# Slices are no thicker than this many µm: light bends within them.
_THICKEST = 1.0

# Level of a setting's background relative to the brightest one's, below which it has no bias.
_DARK = 0.2

# Correlation of two settings' images, below which they aren't the same setting.
_UNLIKE = 0.5

# Of two settings' directions of shear, in degrees: below this apart they lie along one axis.
_ONE_AXIS = 45.0


@dataclass(frozen=True)
class Settled:
    """All values of a configuration, each with its origin.

    prisms: (length, angle in degrees, bias in degrees) of each setting. slices: of the volume, (number, spacing in µm).
    first: depth of the first plane in µm. offset: counts in the dark; None where the images are no counts.
    lower: whether the specimen's index is below its medium's.
    """

    pixel_size: Sourced
    step: Sourced
    wavelength: Sourced
    na: Sourced
    condenser_na: Sourced
    background: Sourced
    prisms: tuple[tuple[Sourced, Sourced, Sourced], ...]
    slices: tuple[int, float]
    first: float
    offset: Sourced | None
    lower: bool

    @property
    def assumed(self) -> list[str]:
        """The names of the values that are assumed, those first that change the volume most."""
        angles = [angle for _, angle, _ in self.prisms]
        lengths, biases = [length for length, _, _ in self.prisms], [bias for _, _, bias in self.prisms]
        all_of_them = (*lengths, *angles, *biases, self.na, self.condenser_na, self.background, self.wavelength)
        steps, offsets = [self.step] if self.first else [], [] if self.offset is None else [self.offset]
        named = [one.name for one in (*all_of_them, *offsets, self.pixel_size, *steps) if one.origin == "assumed"]
        others = [*(["order of the planes"] if self.first else []), *([] if self.lower else ["sign of Δn"])]
        return list(dict.fromkeys([*named, *others]))


def settle(gathered: Gathered, found: Survey, given: Mapping[str, Any]) -> Settled:
    """Choose each value.

    given: by the user, under the names of the command's options; None or missing is not given.
    """
    stack, said = gathered.stack, gathered.setup
    wavelength = _chosen(given.get("wavelength"), said.wavelength, WAVELENGTH, "wavelength", "green light")
    na = _chosen(given.get("na"), said.na, NA, "objective's NA", "it stands on the objective")
    background = _chosen(given.get("background"), None, BACKGROUND, "medium's index", "water; oil 1.515, glycerol 1.47")
    reach = min(na.value, background.value)
    usual = round(min(0.8 * na.value, 0.9), 2)
    condenser = _chosen(given.get("condenser_na"), None, usual, "condenser's NA", "read it at the aperture ring")
    sampled = round(wavelength.value / (4 * reach), 3)
    pixel = _chosen(
        given.get("pixel_size"),
        stack.pixel_size[1] if stack.pixel_size else None,
        sampled,
        "pixel size",
        "λ/(4·NA), which just samples the light; camera's pixel over magnification",
    )
    depth = wavelength.value * background.value / reach**2
    planes = stack.data.shape[1]
    step = _chosen(given.get("z_step"), stack.focus_step, round(depth / 2, 2), "focus step", "half the depth of field")
    return Settled(
        pixel_size=pixel,
        step=step,
        wavelength=wavelength,
        na=na,
        condenser_na=condenser,
        background=background,
        prisms=_prisms(found, given, round(wavelength.value / (2 * reach), 2)),
        slices=slices_of(planes, step.value, depth, pixel.value),
        first=round(-(planes - 1) / 2 * step.value, 6),
        offset=_offset(stack, found.camera, given.get("offset")),
        lower=bool(given.get("lower")),
    )


def slices_of(planes: int, step: float, depth: float, pixel: float) -> tuple[int, float]:
    """Number and thickness in µm of the volume's slices.

    planes, step: of the focus; depth: of field, λn/NA²; pixel: all in µm.

    A slice is half the depth of field, which axial detail needs, or the focus step where that is between a quarter and
    half of it; no thinner than a pixel and no thicker than 1 µm. The slices fill what the planes span and a depth of
    field. One plane has one slice.
    """
    if planes == 1:
        return 1, round(min(depth, _THICKEST), 3)
    thickness = depth / 2
    if thickness / 2 <= step <= thickness:
        thickness = step
    thickness = max(min(thickness, _THICKEST), pixel)
    if thickness != step:
        thickness = round(thickness, 3)
    return max(math.ceil(((planes - 1) * step + depth) / thickness - 1e-9), 1), thickness


def _chosen(given: float | None, said: float | None, guess: float, name: str, why: str) -> Sourced:
    if given is not None:
        return Sourced(float(given), "given", name=name)
    if said is not None:
        return Sourced(float(f"{said:.6g}"), "file", name=name)
    return Sourced(guess, "assumed", why, name)


def _offset(stack: Stack, camera: DarkCounts | None, given: float | None) -> Sourced | None:
    """The counts of a dark image."""
    name = "camera's offset"
    if given is not None:
        return Sourced(float(given), "given", "counts in the dark", name)
    if not stack.is_integer:
        return None
    if camera is not None and camera.offset_is_seen:
        why = f"± {camera.offset_error:.0f}, from how noise grows with light; counts in the dark"
        return Sourced(float(round(camera.offset)), "measured", why, name)
    return Sourced(0.0, "assumed", "the counts of a dark image, which these images don't show", name)


def _prisms(found: Survey, given: Mapping[str, Any], usual: float) -> tuple[tuple[Sourced, Sourced, Sourced], ...]:
    """Length, angle and bias of each setting's shear; the first bias along an axis is taken as above 0.

    A setting much darker than the brightest has bias 0, and the axis of the one before it: its images don't show any.
    """
    length = _chosen(given.get("shear"), None, usual, "shear's length", "λ/(2·NA), as is usual; the maker knows it")
    size = _chosen(given.get("bias"), None, _BIAS_DEGREES, "bias", "a quarter wave; the compensator shows it")
    axes: list[_Axis] = []
    places: list[tuple[int, float]] = []
    brightest = max(setting.level for setting in found.settings)
    for setting in found.settings:
        if setting.level < _DARK * brightest:
            places.append((places[-1][0] if places else 0, 0.0))
        else:
            places.append(_place(setting, axes, places))
    shown = [_angle(axis, lower=bool(given.get("lower"))) for axis in axes]
    told = _told_angles(given.get("shear_angle") or (), places, len(axes))
    angles = [shown[axis] if angle is None else angle for (axis, _), angle in zip(places, told, strict=True)]
    places = _as_told(places, told)
    dark = replace(size, value=0.0, origin="measured", why="its empty field is dark beside another setting's")
    biases = [replace(size, value=sign * size.value) if sign else dark for _, sign in places]
    return tuple((length, angle, bias) for angle, bias in zip(angles, biases, strict=True))


def _told_angles(told: Sequence[float], places: Sequence[tuple[int, float]], axes: int) -> list[Sourced | None]:
    """The angle of each setting as far as the user gave it: one for each axis, or one for each setting.

    A single one is of the first axis. places: number of the axis, and sign of the bias, of each setting. axes: how many
    there are. Raises ConfigError for another number of angles.
    """
    if len(told) == axes or len(told) <= 1:
        given = [told[axis] if axis < len(told) else None for axis, _ in places]
    elif len(told) == len(places):
        given = list(told)
    else:
        counts = f"{axes} axes of shear" if axes > 1 else "one axis of shear"
        raise ConfigError(
            f"--shear-angle {' '.join(f'{angle:g}' for angle in told)}: {len(told)} angles, and the images show "
            f"{counts} in {len(places)} prism settings: give one for each axis, or one for each setting"
        )
    return [None if angle is None else Sourced(float(angle), "given", name=ANGLE) for angle in given]


def _as_told(places: Sequence[tuple[int, float]], told: Sequence[Sourced | None]) -> list[tuple[int, float]]:
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


def _place(setting: SettingSurvey, axes: list[_Axis], places: Sequence[tuple[int, float]]) -> tuple[int, float]:
    """The number of a setting's axis of shear, and the sign of its bias; adds what it shows of the axis, or a new axis.

    places: of the settings before it. A setting whose direction has no sign has the bias that its likeness to those
    shows, and one without a direction the axis too.
    """
    direction, (near, likely) = setting.direction, _likely(setting, places)
    if direction is None:
        if not axes:
            axes.append(_Axis())
        return near, likely
    shown = cmath.rect(1 / direction.uncertainty**2, direction.angle)
    for number, axis in enumerate(axes):
        along = likely if not axis.shown else math.copysign(1.0, (shown / sum(axis.shown)).real)
        apart = 0.0 if not axis.shown else abs(math.degrees(cmath.phase(along * shown / sum(axis.shown))))
        if apart < _ONE_AXIS:
            axis.shown.append(along * shown)
            sign = along if direction.signed and (axis.signed or len(axis.shown) == 1) else likely
            axis.signed |= direction.signed
            return number, sign
    axes.append(_Axis([shown], direction.signed))
    return len(axes) - 1, 1.0


def _likely(setting: SettingSurvey, places: Sequence[tuple[int, float]]) -> tuple[int, float]:
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


def _angle(axis: _Axis, *, lower: bool) -> Sourced:
    """The angle of an axis in degrees, from what its settings show together.

    Its uncertainty is that of their weighted mean, or half of how far they are apart where that is more.
    """
    if not axis.shown:
        return Sourced(_ANGLE_DEGREES, "assumed", "the images show none; from dark edge to bright", ANGLE)
    mean = sum(axis.shown)
    beside = max(abs(math.degrees(cmath.phase(one / mean))) for one in axis.shown)
    sure = max(math.degrees(1 / math.sqrt(sum(map(abs, axis.shown)))), beside / 2)
    degrees = math.degrees(cmath.phase(mean)) + (180 if lower and axis.signed else 0)
    if axis.signed:
        why = f"± {sure:.0f}°, if Δn is {'below' if lower else 'above'} 0 and the bias between 0° and 180°"
    else:
        why = f"± {sure:.0f}°, or the opposite: the images don't show which"
    return Sourced(round(degrees % 360, 1), "measured", why, ANGLE)
