"""A measured stack is checked against the acquisition and brought to the model's unit: flattened and scaled."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Real

from recon.recording.background import background_surface, known_levels, noise_level
from recon.recording.empty_field import EmptyField
from recon.recording.masks import LeftOut, median_of_known, nearest_counted
from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack

_TOLERANCE = 0.01  # a larger relative difference between the file's sizes and the configuration's is warned of

_SATURATED = 0.01  # a larger fraction of saturated pixels is warned of

_EXTINCT = 1e-3  # where the empty field should be darker than this, stray light and dark counts are brighter than it

_BRIGHT = 1.5  # an extinct prism's background brighter than this many empty bright fields is warned of

# A float stack's background that differs from the model's by a larger part of it is warned of. A bias that is 10° off
# changes the background at bias π/2 by 17 %.
_LEVEL = 0.25

_NOTHING = 0.01  # a background below this part of the model's can't be scaled by


@dataclass(frozen=True)
class ExpectedStack:
    """What a stack must hold to belong to an acquisition.

    biases: one per prism, rad; None is bright field.
    focus: one per plane, µm.
    pixel_size: (y, x) in µm, used in place of the file's; None uses the file's.
    pixels: (y, x), the number of pixels; None accepts any.
    field: (y, x) in µm, of the volume that a camera sees with pixels of its own; None where pixels are voxels.
    empty: one per prism, the intensity of the empty field, relative to the empty bright field; None is what ideal
        polarisers give, sin²(bias/2), and 1 in bright field.
    """

    biases: tuple[float | None, ...]
    focus: tuple[float, ...]
    pixel_size: tuple[float, float] | None = None
    pixels: tuple[int, int] | None = None
    empty: tuple[float, ...] | None = None
    field: tuple[float, float] | None = None

    @property
    def empty_levels(self) -> tuple[float, ...]:
        """The intensity of the empty field of each prism, relative to the empty bright field."""
        return tuple(map(_ideal_empty_field, self.biases)) if self.empty is None else self.empty


@dataclass(frozen=True)
class Normalisation:
    """How the file's pixel values become intensities relative to the empty bright field.

    flatten: whether to divide by the slow background of each prism. The background of an extinct prism (an expected
        empty field below 1e-3) is stray light; it is subtracted and the expected empty field put in its place. None
        flattens integers and leaves floats as they are.
    scale: the pixel value, offset removed, of an empty bright field of which the objective stops no light; or
        "background", which takes it from the background and the expected empty field; an extinct prism then has the
        scale of the others. None is "background" for integers and 1 for floats, which are relative to the empty bright
        field already.
    offset: the camera's dark counts, in the file's unit, which are subtracted first.
    order: total degree of the polynomial that describes the background.
    """

    flatten: bool | None = None
    scale: float | str | None = None
    offset: float = 0.0
    order: int = 2

    def flattens(self, stack: Stack) -> bool:
        """Whether this stack is flattened."""
        return stack.is_integer if self.flatten is None else self.flatten

    def scale_of(self, stack: Stack) -> float | Literal["background"]:
        """The scale of this stack. Raises StackError for a scale that is neither above 0 nor "background"."""
        if self.scale is None:
            return "background" if stack.is_integer else 1.0
        if self.scale == "background":
            return "background"
        if isinstance(self.scale, str):
            raise StackError(f"{stack.source}: scale {self.scale!r} must be a number above 0 or 'background'")
        if not (math.isfinite(self.scale) and self.scale > 0):
            raise StackError(f"{stack.source}: scale {self.scale} must be above 0")
        return float(self.scale)


@dataclass(frozen=True)
class PrismReport:
    """What was found in the images of one prism, and how they were changed.

    bias: rad; None for bright field.
    background: mean of the background in the file's unit, offset removed.
    scale: the file's unit per empty bright field; the images were divided by it.
    flicker: standard deviation of the images' medians over their mean; None where that isn't above 0.
    unevenness: of the background that was flattened, peak to peak, relative to its mean; 0 where none was flattened.
    noise: standard deviation of the noise, relative to the empty bright field; None for images of less than 3 × 3
        pixels, which are too small to tell.
    """

    bias: float | None
    background: float
    scale: float
    flicker: float | None
    unevenness: float
    noise: float | None


@dataclass(frozen=True)
class Measured:
    """A measured stack in the model's unit.

    data: (prism, focus, y, x), float32, relative to the empty bright field.
    focus: one per plane, µm.
    pixel_size: (y, x) in µm.
    prisms: one report per prism.
    left_out: the pixels that don't count, and why. In the data they have the value of the nearest one that does.
    """

    data: Float[np.ndarray, "prism focus y x"]
    focus: tuple[float, ...]
    pixel_size: tuple[float, float]
    prisms: tuple[PrismReport, ...]
    left_out: LeftOut = field(default_factory=LeftOut)

    @property
    def noise(self) -> list[float] | None:
        """Standard deviation of each prism's noise; None where it isn't known of all."""
        return known_levels(report.noise for report in self.prisms)


def prepare(
    stack: Stack,
    expected: ExpectedStack,
    normalisation: Normalisation | None = None,
    left_out: LeftOut | None = None,
    empty_field: EmptyField | None = None,
) -> Measured:
    """Check a stack against the acquisition and bring it to the model's unit, the empty bright field.

    stack: as read from its file.
    expected: what the acquisition says that the stack holds.
    normalisation: how pixel values become intensities; None is `Normalisation()`, which flattens and scales integers
        by their background and leaves floats as they are.
    left_out: the pixels that don't count; nothing that is found in the images depends on them. None is none.
    empty_field: by which the images are divided, and whose level is that of the empty background; None fits a
        background to the images where the normalisation flattens.

    Raises StackError where the number of prisms, planes or pixels is not the expected one, no pixel size is known, the
    scale should come from backgrounds that are all extinct, or a background that divides the images is not above 0.
    Warns StackWarning where the file's sizes differ from the expected ones by more than 1 %, more than 1 % of the
    pixels are saturated, an extinct prism has the others' scale, the background of floats isn't the expected one, or
    the empty field was recorded with another exposure.
    """
    normalisation = normalisation or Normalisation()
    _check_normalisation(stack, normalisation)
    check_counts(stack, expected)
    key = "volume.spacing or pixel_size" if expected.field is None else "microscope.camera.pixel_size"
    pixel_size = _agreed_pixel_size(stack, expected.pixel_size, key)
    _compare_focus(stack, expected.focus)
    _check_saturation(stack)
    levels, left_out = expected.empty_levels, left_out or LeftOut()
    if empty_field is not None:
        scale = "background" if normalisation.scale is None else normalisation.scale
        normalisation = replace(normalisation, flatten=True, scale=scale)
    found: dict[int, tuple[np.ndarray, PrismReport]] = {}
    for prism in sorted(range(len(levels)), key=lambda prism: levels[prism] < _EXTINCT):  # which come last
        dark, known = levels[prism] < _EXTINCT, [report.scale for _, report in found.values()]
        how = _scaled_as(known, stack, prism, normalisation) if dark else normalisation
        empty = expected.biases[prism], levels[prism]
        found[prism] = _in_model_unit(stack, prism, empty, how, left_out.counted, empty_field)
    prepared = [found[prism] for prism in range(len(levels))]
    reports = tuple(report for _, report in prepared)
    if not stack.is_integer and empty_field is None:
        _check_brightness(stack, reports, levels)
    return Measured(np.stack([images for images, _ in prepared]), expected.focus, pixel_size, reports, left_out)


def _in_model_unit(
    stack: Stack,
    prism: int,
    empty: tuple[float | None, float],
    normalisation: Normalisation,
    counted: Bool[np.ndarray, "prism focus y x"] | None,
    by: EmptyField | None,
) -> tuple[Float[np.ndarray, "focus y x"], PrismReport]:
    """One prism's images relative to the empty bright field, float32. empty: its bias, and the empty field's intensity.

    counted: the pixels that count; None is all. by: the empty field by which they are divided, if any.
    """
    images, label, (bias, expected) = stack.data[prism], f"{stack.source}: prism {prism + 1}", empty
    known = images if counted is None else np.where(counted[prism], images, np.nan)
    flatten, scale, offset = normalisation.flattens(stack), normalisation.scale_of(stack), normalisation.offset
    is_extinct = expected < _EXTINCT
    if scale == "background" and is_extinct:
        named = "bright field" if bias is None else f"bias {bias:g} rad"
        raise StackError(
            f"{label} has {named}: its empty background {expected:.2g} is below {_EXTINCT:g}, "
            "too dark to scale by; give scale, the counts per empty bright field"
        )
    # the lamp does not change while the specimen moves through focus: one surface serves all planes
    typical, noise = median_of_known(known) - offset, noise_level(known)
    if by is None:
        surface, more = background_surface(typical, normalisation.order if flatten else 0), 0.0
    else:
        surface, more = by.quiet(prism, None if noise is None else noise / abs(float(np.nanmedian(typical))))
        surface = surface if is_extinct else _of_exposure(surface, typical, label, by.source)
    level = float(surface.mean())
    lowest = float(surface.min())
    if lowest <= 0 and (scale == "background" or (flatten and not is_extinct)):
        raise StackError(
            f"{label}'s background minus the offset {offset:g} falls to {lowest:.4g}; "
            "a background that divides the images must stay above 0"
        )
    unit = level / expected if scale == "background" else scale
    scaled = np.empty(images.shape, np.float32)
    for plane, image in enumerate(images):
        sound = image if counted is None else nearest_counted(image, counted[prism, plane])
        light = sound.astype(np.float64) - offset
        if flatten:
            light = light - surface + expected * unit if is_extinct else light * (level / surface)
        scaled[plane] = light / unit
    report = PrismReport(
        bias=bias,
        background=level,
        scale=unit,
        flicker=_flicker(known, offset),
        unevenness=float(np.ptp(surface)) / abs(level) if flatten and level else 0.0,
        noise=None if noise is None else math.hypot(noise, more) / unit,
    )
    return scaled, report


def _scaled_as(scales: Sequence[float], stack: Stack, prism: int, normalisation: Normalisation) -> Normalisation:
    """How an extinct prism is scaled where the background should tell: as the other prisms, whose scales are known."""
    if not scales or normalisation.scale_of(stack) != "background":
        return normalisation
    scale = float(np.median(scales))
    warnings.warn(
        f"{stack.source}: prism {prism + 1}'s empty field is dark and tells no scale: it is scaled as the other "
        f"prisms, {scale:.4g} per empty bright field, which is right for one lamp and one exposure",
        StackWarning,
        stacklevel=3,
    )
    return replace(normalisation, scale=scale)


def _of_exposure(
    surface: Float[np.ndarray, "y x"], typical: Float[np.ndarray, "y x"], label: str, source: str
) -> Float[np.ndarray, "y x"]:
    """An empty field as bright as the stack's own background where the two were recorded with another exposure.

    A specimen that fills the field moves the background, but not by that much.
    """
    ratio = float(background_surface(typical / surface, 0).mean())
    if abs(ratio - 1) <= _LEVEL:
        return surface
    if ratio <= 0:
        raise StackError(
            f"{label}'s background is {ratio:.4g} of the empty field's ({source}): with the offset removed it must be "
            "above 0"
        )
    level = float(surface.mean())
    warnings.warn(
        f"{label}'s background is {ratio * level:.4g}, the empty field's {level:.4g} ({source}), with the offset "
        "removed: another exposure, lamp or bias; the empty field gives the shape alone, the stack its level",
        StackWarning,
        stacklevel=4,
    )
    return ratio * surface


def _flicker(images: Real[np.ndarray, "focus y x"], offset: float) -> float | None:
    """How much the images' brightness differs from one to the next, relative to their mean."""
    medians = [np.nanmedian(image) - offset for image in images if np.isfinite(image).any()]
    mean = float(np.mean(medians))
    return float(np.std(medians)) / mean if mean > 0 else None


def _ideal_empty_field(bias: float | None) -> float:
    """The intensity of an empty image between ideal polarisers, relative to the empty bright field."""
    return 1.0 if bias is None else math.sin(bias / 2) ** 2


def _check_normalisation(stack: Stack, normalisation: Normalisation) -> None:
    """Raise StackError for values that mean nothing."""
    normalisation.scale_of(stack)
    if not math.isfinite(normalisation.offset):
        raise StackError(f"{stack.source}: offset {normalisation.offset} must be finite")
    if normalisation.order < 0:
        raise StackError(f"{stack.source}: background order {normalisation.order} must be at least 0")


def check_counts(stack: Stack, expected: ExpectedStack) -> None:
    """Raise StackError where the prisms, planes or pixels are not as many as expected."""
    held, prisms, planes = stack.data.shape, len(expected.biases), len(expected.focus)
    if held[:2] != (prisms, planes):
        raise StackError(
            f"{stack.source} holds {_counted(held[0], 'prism')} × {_counted(held[1], 'plane')}, "
            f"acquisition.prisms and acquisition.focus say {prisms} × {planes}"
        )
    pixels = expected.pixels
    if pixels is not None and held[2:] != tuple(pixels):
        volume, (ny, nx) = "the volume", pixels
        if expected.field is not None and expected.pixel_size is not None:
            height, width = expected.field
            side = expected.pixel_size[0]
            volume = f"the volume of {height:.4g} × {width:.4g} µm in whole pixels of the camera, of {side:.4g} µm,"
        raise StackError(
            f"{stack.source} has {held[2]} × {held[3]} pixels (y × x), {volume} {ny} × {nx}; {_to_fit(stack, expected)}"
        )


def _to_fit(stack: Stack, expected: ExpectedStack) -> str:
    """What to change in a configuration so that its volume has the stack's pixels."""
    ny, nx = stack.data.shape[2:]
    if expected.field is None or expected.pixel_size is None:
        return (
            f"let volume.shape end in {ny}, {nx}, or, where voxels aren't to be pixels, give "
            "microscope.camera.pixel_size and a volume as wide as the images"
        )
    height, width = expected.field
    dy, dx = expected.pixel_size
    wider = f"volume.shape × volume.spacing must be {ny * dy:.4g} × {nx * dx:.4g} µm (y × x)"
    fitting = height / ny, width / nx
    if _differ(*fitting):
        return wider
    return f"{wider}, or microscope.camera.pixel_size {fitting[0]:.4g} in the specimen"


def _agreed_pixel_size(stack: Stack, wanted: tuple[float, float] | None, key: str) -> tuple[float, float]:
    """The wanted pixel size (y, x) in µm, or the file's where none is wanted. Warns where the two differ.

    key: of a configuration, that says the wanted one.
    """
    found = stack.pixel_size
    if wanted is None:
        if found is None:
            raise StackError(f"{stack.source}: neither the file nor the config gives a pixel size")
        return found
    if found is not None and any(_differ(a, b) for a, b in zip(found, wanted, strict=True)):
        warnings.warn(
            f"{stack.source}: its pixels are {found[0]:.4g} × {found[1]:.4g} µm (y × x), the config's "
            f"{wanted[0]:.4g} × {wanted[1]:.4g} µm; the config's are used; correct {key} if the file is right",
            StackWarning,
            stacklevel=3,
        )
    return float(wanted[0]), float(wanted[1])


def _compare_focus(stack: Stack, focus: tuple[float, ...]) -> None:
    """Warn where the file's focus step differs from a step between planes."""
    found = stack.focus_step
    steps = [abs(b - a) for a, b in pairwise(focus)]
    if found is None or not any(_differ(found, step) for step in steps):
        return
    low, high = min(steps), max(steps)
    said = f"{low:.4g} to {high:.4g}" if _differ(low, high) else f"{low:.4g}"
    warnings.warn(
        f"{stack.source}: its focus step is {found:.4g} µm, the config's {said} µm; the config's is used",
        StackWarning,
        stacklevel=3,
    )


def _check_saturation(stack: Stack) -> None:
    """Warn where too many pixels are saturated."""
    limit = stack.saturation
    if limit is None:
        return
    count = int((stack.data >= limit).sum())
    if count > _SATURATED * stack.data.size:
        warnings.warn(
            f"{stack.source}: {count} of {stack.data.size} pixels ({count / stack.data.size:.1%}) are "
            f"saturated at {limit:g}; their intensity is unknown",
            StackWarning,
            stacklevel=3,
        )


def _check_brightness(stack: Stack, reports: Sequence[PrismReport], levels: Sequence[float]) -> None:
    """Warn where a background isn't the model's: floats may have been scaled, or their background subtracted."""
    for prism, (report, expected) in enumerate(zip(reports, levels, strict=True)):
        found = report.background / report.scale
        # an extinct field is as bright as its stray light, of which the model knows nothing
        if found <= _BRIGHT if expected < _EXTINCT else abs(found - expected) <= _LEVEL * expected:
            continue
        if found > _NOTHING * expected:
            advice = "data.scale = 'background' scales by it"
        else:
            advice = (
                "it seems to have been subtracted: data.offset = -(its level) puts it back, after which "
                "data.scale = 'background' scales by it"
            )
        warnings.warn(
            f"{stack.source}: prism {prism + 1}'s background is {found:.4g}, not {expected:.4g} as the model's: float "
            f"pixels count as relative to the empty bright field unless a scale is given; {advice}",
            StackWarning,
            stacklevel=3,
        )


def _differ(found: float, wanted: float) -> bool:
    return abs(found - wanted) > _TOLERANCE * abs(wanted)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
