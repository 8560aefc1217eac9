"""What a configuration says of a stack: what the user gave, else what the file says or its images show, or a guess."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from recon.cli.own_stack.prisms import SettledPrism, settle_prisms
from recon.config.commented import Sourced, chosen
from recon.recording.survey.dark_counts import DarkCounts
from recon.recording.survey.survey import Survey
from torchdic.files.format import Stack
from torchdic.files.gathered import Gathered

# Values that nobody has said: green light, a dry objective of high aperture, a watery medium.
WAVELENGTH, NA, BACKGROUND = 0.55, 0.9, 1.335

# Slices are no thicker than this many µm: light bends within them.
_THICKEST = 1.0


@dataclass(frozen=True)
class Settled:
    """All values of a configuration, each with its origin.

    pixel_size: along x. pixel_height: along y, in µm; as along x unless the file says otherwise.
    prisms: (length, angle in degrees, bias in degrees) of each setting. slices: of the volume, (number, spacing in µm).
    remarks: on the prisms, a line each, where what was given isn't what the images show.
    first: depth of the first plane in µm. offset: counts in the dark; None where the images are no counts.
    lower: whether the specimen's index is below its medium's.
    """

    pixel_size: Sourced
    pixel_height: float
    step: Sourced
    wavelength: Sourced
    na: Sourced
    condenser_na: Sourced
    background: Sourced
    prisms: tuple[SettledPrism, ...]
    remarks: tuple[str, ...]
    slices: tuple[int, float]
    first: float
    offset: Sourced | None
    lower: bool

    @property
    def square(self) -> bool:
        """Whether a pixel is as high as it is wide, but for rounding."""
        return math.isclose(self.pixel_height, self.pixel_size.value, rel_tol=1e-3)

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
    wavelength = chosen(given.get("wavelength"), said.wavelength, WAVELENGTH, "wavelength", "green light")
    na = chosen(given.get("na"), said.na, NA, "objective's NA", "it stands on the objective")
    background = chosen(given.get("background"), None, BACKGROUND, "medium's index", "water; oil 1.515, glycerol 1.47")
    reach = min(na.value, background.value)
    usual = round(min(0.8 * na.value, 0.9), 2)
    condenser = chosen(given.get("condenser_na"), None, usual, "condenser's NA", "read it at the aperture ring")
    sampled = round(wavelength.value / (4 * reach), 3)
    pixel = chosen(
        given.get("pixel_size"),
        stack.pixel_size[1] if stack.pixel_size else None,
        sampled,
        "pixel size",
        "λ/(4·NA), which just samples the light; camera's pixel over magnification",
    )
    depth = wavelength.value * background.value / reach**2
    planes = stack.data.shape[1]
    step = chosen(given.get("z_step"), stack.focus_step, round(depth / 2, 2), "focus step", "half the depth of field")
    prisms, remarks = settle_prisms(found, given, round(wavelength.value / (2 * reach), 2))
    return Settled(
        pixel_size=pixel,
        pixel_height=stack.pixel_size[0] if pixel.origin == "file" and stack.pixel_size else pixel.value,
        step=step,
        wavelength=wavelength,
        na=na,
        condenser_na=condenser,
        background=background,
        prisms=prisms,
        remarks=remarks,
        slices=slices_of(planes, step.value, depth, pixel.value),
        first=round(-(planes - 1) / 2 * step.value, 6),
        offset=_offset(stack, found.camera, given.get("offset")),
        lower=bool(given.get("lower")),
    )


def slices_of(planes: int, step: float, depth: float, pixel: float) -> tuple[int, float]:
    """Number and thickness in µm of the volume's slices.

    planes, step: of the focus; depth: of field, λn/NA²; pixel: all in µm.

    A slice is half the depth of field, which axial detail needs, or the focus step where that is between a quarter and
    half of it; no thinner than a pixel and no thicker than 1 µm. The slices fill what the planes span, and go on beyond
    it on either side, as fits draw specimens out along z: by two depths of field, but no further than half of what the
    planes span, and by half a depth of field at least. One plane has one slice.
    """
    if planes == 1:
        return 1, round(min(depth, _THICKEST), 3)
    thickness = depth / 2
    if thickness / 2 <= step <= thickness:
        thickness = step
    thickness = max(min(thickness, _THICKEST), pixel)
    if thickness != step:
        thickness = round(thickness, 3)
    span = (planes - 1) * step
    beyond = max(min(2 * depth, span / 2), depth / 2)
    return max(math.ceil((span + 2 * beyond) / thickness - 1e-9), 1), thickness


def _offset(stack: Stack, camera: DarkCounts | None, given: float | None) -> Sourced | None:
    """The counts of a dark image."""
    name = "camera's offset"
    if given is not None:
        why = "counts in the dark" if given >= 0 else "what was subtracted from the images is put back"
        return Sourced(float(given), "given", why, name)
    if not stack.is_integer:
        return None
    if camera is not None and camera.offset_is_seen:
        why = f"± {camera.offset_error:.0f}, from how noise grows with light; counts in the dark"
        return Sourced(float(round(camera.offset)), "measured", why, name)
    return Sourced(0.0, "assumed", "the counts of a dark image, which these images don't show", name)
