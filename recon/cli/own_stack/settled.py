"""What a configuration says of a stack: what the user gave, else what the file says or its images show, or a guess."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from recon.config.commented import Sourced
from recon.recording.survey.survey import SettingSurvey, Survey
from torchdic.files.gathered import Gathered

# Values that nobody has said: green light, a dry objective of high aperture, a watery medium, a quarter wave of bias.
WAVELENGTH, NA, BACKGROUND, _BIAS_DEGREES, _ANGLE_DEGREES = 0.55, 0.9, 1.335, 90.0, 45.0

# Slices are no thicker than this many µm: light bends within them.
_THICKEST = 1.0

# Correlation of a setting's images with the first one's, below which its bias is the opposite.
_REVERSED = -0.2

# Of two settings' directions of shear, in degrees: below this apart they lie along one axis.
_ONE_AXIS = 45.0


@dataclass(frozen=True)
class Settled:
    """All values of a configuration, each with its origin.

    prisms: (length, angle in degrees, bias in degrees) of each setting. slices: of the volume, (number, spacing in µm).
    first: depth of the first plane in µm. lower: whether the specimen's index is below its medium's.
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
    lower: bool

    @property
    def assumed(self) -> list[str]:
        """The names of the values that are assumed, those first that change the volume most."""
        angles = [angle for _, angle, _ in self.prisms]
        lengths, biases = [length for length, _, _ in self.prisms], [bias for _, _, bias in self.prisms]
        all_of_them = (*lengths, *angles, *biases, self.na, self.condenser_na, self.background, self.wavelength)
        steps = [self.step] if self.first else []
        named = [one.name for one in (*all_of_them, self.pixel_size, *steps) if one.origin == "assumed"]
        others = [*(["order of the planes"] if self.first else []), *([] if self.lower else ["sign of Δn"])]
        return list(dict.fromkeys([*named, *others]))


def settle(gathered: Gathered, found: Survey, given: Mapping[str, float | None]) -> Settled:
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


def _prisms(
    found: Survey, given: Mapping[str, float | None], usual: float
) -> tuple[tuple[Sourced, Sourced, Sourced], ...]:
    """Length, angle and bias of each setting's shear; the first one's bias is taken as above 0."""
    length = _chosen(given.get("shear"), None, usual, "shear's length", "λ/(2·NA), as is usual; the maker knows it")
    size = _chosen(given.get("bias"), None, _BIAS_DEGREES, "bias", "a quarter wave; the compensator shows it")
    settings: list[tuple[Sourced, Sourced, Sourced]] = []
    for setting in found.settings:
        angle, sign = _angle(setting, settings, given)
        settings.append((length, angle, replace(size, value=sign * size.value)))
    return tuple(settings)


def _angle(
    setting: SettingSurvey,
    before: Sequence[tuple[Sourced, Sourced, Sourced]],
    given: Mapping[str, float | None],
) -> tuple[Sourced, float]:
    """The angle of a setting's shear in degrees, and the sign of its bias.

    before: the settings before it. A setting sheared against one before it has that one's shear and the opposite bias.
    One whose images show no direction has the first one's shear, and the opposite bias where they are its negative.
    given: the angle is the first axis's.
    """
    told, name, direction = given.get("shear_angle"), "shear's angle", setting.direction
    if direction is None and before:
        return before[0][1], -1.0 if setting.likeness < _REVERSED else 1.0
    degrees = 0.0
    if direction is not None:
        degrees = math.degrees(direction.angle) + (180.0 if direction.signed and given.get("lower") else 0.0)
        for _, earlier, bias in before:
            apart = abs((degrees - earlier.value + 180) % 360 - 180)
            if direction.signed and min(apart, 180 - apart) < _ONE_AXIS:
                return earlier, math.copysign(1.0, bias.value) * (1.0 if apart < 90 else -1.0)
    if told is not None and not before:
        return Sourced(float(told), "given", name=name), 1.0
    if direction is None:
        return Sourced(_ANGLE_DEGREES, "assumed", "the images show none; from dark edge to bright", name), 1.0
    sure = f"± {math.degrees(direction.uncertainty):.0f}°"
    if direction.signed:
        why = f"{sure}, if Δn is {'below' if given.get('lower') else 'above'} 0 and the bias between 0° and 180°"
    else:
        why = f"{sure}, or the opposite: the images don't show which"
    return Sourced(round(degrees % 360, 1), "measured", why, name), 1.0
