"""A measured stack in the model's unit: checked against the acquisition, flattened and scaled."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Real

from recon.recording.background import background_surface, noise_level
from torchdic.errors import StackError, StackWarning
from torchdic.files.stack import Stack

_TOLERANCE = 0.01  # relative difference between the file's sizes and the config's that passes without a word

_SATURATED = 0.01  # fraction of saturated pixels that passes without a word

_EXTINCT = 1e-3  # an emptier background than this is darkness: stray light and dark counts outweigh it

_BRIGHT = 1.5  # no empty background exceeds 1, the empty bright field, by so much


@dataclass(frozen=True)
class PrismReport:
    """What was found in the images of one prism, and done to them.

    bias: rad, None for bright field. background: mean level of the empty field in the file's unit,
    offset removed. scale: the file's unit per empty bright field, by which the images were divided.
    unevenness: peak to peak of the background that was flattened, relative to its mean (0 where nothing
    was). noise: its standard deviation in units of the empty bright field, None for images too small to
    tell.
    """

    bias: float | None
    background: float
    scale: float
    unevenness: float
    noise: float | None


@dataclass(frozen=True)
class Measured:
    """A measured stack in the model's unit.

    data: (prism, focus, y, x), float32, relative to the empty bright field. focus: µm.
    pixel_size: (y, x) in µm. prisms: one report each.
    """

    data: Float[np.ndarray, "prism focus y x"]
    focus: tuple[float, ...]
    pixel_size: tuple[float, float]
    prisms: tuple[PrismReport, ...]


def prepare(
    stack: Stack,
    biases: Sequence[float | None],
    focus: Sequence[float],
    pixel_size: tuple[float, float] | None = None,
    *,
    pixels: tuple[int, int] | None = None,
    flatten: bool | None = None,
    scale: float | str | None = None,
    offset: float = 0.0,
    order: int = 2,
    empty: Sequence[float] | None = None,
) -> Measured:
    """Check a stack against the acquisition and bring it to the model's unit, the empty bright field.

    biases: one per prism, rad; None is bright field. focus: one per plane, µm. pixel_size: (y, x) in µm,
    which wins over the file's; None takes the file's. pixels: (y, x) of the model, checked where given.
    flatten: divide by the slow background, a polynomial surface of total degree `order`, one per prism; an
    extinct prism's background (`empty` below 1e-3) is stray light and is replaced by `empty` instead.
    scale: the file's unit per empty bright field of which the objective stops nothing, or "background" for
    what takes the empty field to `empty`. offset: the camera's dark counts in the file's unit, subtracted
    first. empty: the empty field's intensity behind each prism; None is that of ideal polarisers,
    sin²(bias/2), and in bright field 1.
    By default integers are flattened and scaled by their background; floats count as relative to the empty
    bright field and are left alone.
    Raises StackError where prisms, planes or pixels are not as many as said, no pixel size is known, an
    extinct background should set the scale, or the background to divide by is not above 0.
    Warns StackWarning where the file's sizes differ by more than 1 %, more than 1 % of the pixels are
    saturated, or floats look like counts.
    """
    focus = tuple(float(z) for z in focus)
    _check_options(stack, scale, offset, order)
    _check_counts(stack, len(biases), len(focus), pixels)
    pixel_size = _agreed_pixel_size(stack, pixel_size)
    _compare_focus(stack, focus)
    _check_saturation(stack)
    if flatten is None:
        flatten = stack.is_integer
    if scale is None:
        scale = "background" if stack.is_integer else 1.0
    levels = [_ideal_empty_field(bias) for bias in biases] if empty is None else empty
    prepared = [
        _in_model_unit(images, bias, level, flatten, scale, offset, order, f"{stack.source}: prism {prism}")
        for prism, (images, bias, level) in enumerate(zip(stack.data, biases, levels, strict=True))
    ]
    reports = tuple(report for _, report in prepared)
    if not stack.is_integer:
        _check_brightness(stack, reports, levels)
    return Measured(np.stack([images for images, _ in prepared]), focus, pixel_size, reports)


def _in_model_unit(
    images: Real[np.ndarray, "focus y x"],
    bias: float | None,
    expected: float,
    flatten: bool,
    scale: float | str,
    offset: float,
    order: int,
    label: str,
) -> tuple[Float[np.ndarray, "focus y x"], PrismReport]:
    """One prism's images relative to the empty bright field, float32."""
    extinct = expected < _EXTINCT
    if scale == "background" and extinct:
        named = "bright field" if bias is None else f"bias {bias:g} rad"
        raise StackError(
            f"{label} has {named}: its empty background {expected:.2g} is below {_EXTINCT:g}, "
            "too dark to scale by; give scale, the counts per empty bright field"
        )
    # the lamp is steady while the specimen moves through focus: one surface serves all planes
    surface = background_surface(np.median(images, axis=0) - offset, order if flatten else 0)
    level, lowest = float(surface.mean()), float(surface.min())
    if lowest <= 0 and (scale == "background" or (flatten and not extinct)):
        raise StackError(
            f"{label}'s background less the offset {offset:g} falls to {lowest:.4g}; it must stay above 0 to divide by"
        )
    unit = level / expected if scale == "background" else float(scale)
    scaled = np.empty(images.shape, np.float32)
    for plane, image in enumerate(images):
        light = image.astype(np.float64) - offset
        if flatten:
            light = light - surface + expected * unit if extinct else light * (level / surface)
        scaled[plane] = light / unit
    noise = noise_level(images)
    report = PrismReport(
        bias=bias,
        background=level,
        scale=unit,
        unevenness=float(np.ptp(surface)) / abs(level) if flatten and level else 0.0,
        noise=None if noise is None else noise / unit,
    )
    return scaled, report


def _ideal_empty_field(bias: float | None) -> float:
    """The intensity of an empty image, relative to the empty bright field, between ideal polarisers."""
    return 1.0 if bias is None else math.sin(bias / 2) ** 2


def _check_options(stack: Stack, scale: float | str | None, offset: float, order: int) -> None:
    if isinstance(scale, str) and scale != "background":
        raise StackError(f"{stack.source}: scale {scale!r} must be a number above 0 or 'background'")
    if scale is not None and not isinstance(scale, str) and not (math.isfinite(scale) and scale > 0):
        raise StackError(f"{stack.source}: scale {scale} must be above 0")
    if not math.isfinite(offset):
        raise StackError(f"{stack.source}: offset {offset} must be finite")
    if order < 0:
        raise StackError(f"{stack.source}: background order {order} must be at least 0")


def _check_counts(stack: Stack, prisms: int, planes: int, pixels: tuple[int, int] | None) -> None:
    held = stack.data.shape
    if held[:2] != (prisms, planes):
        raise StackError(
            f"{stack.source} holds {_counted(held[0], 'prism')} × {_counted(held[1], 'plane')}, "
            f"the acquisition says {prisms} × {planes}"
        )
    if pixels is not None and held[2:] != tuple(pixels):
        raise StackError(
            f"{stack.source} has {held[2]} × {held[3]} pixels (y × x), the volume {pixels[0]} × {pixels[1]}"
        )


def _agreed_pixel_size(stack: Stack, wanted: tuple[float, float] | None) -> tuple[float, float]:
    found = stack.pixel_size
    if wanted is None:
        if found is None:
            raise StackError(f"{stack.source}: neither the file nor the config gives a pixel size")
        return found
    if found is not None and any(_differ(a, b) for a, b in zip(found, wanted, strict=True)):
        warnings.warn(
            f"{stack.source}: its pixels are {found[0]:.4g} × {found[1]:.4g} µm (y × x), the config's "
            f"{wanted[0]:.4g} × {wanted[1]:.4g} µm; the config's are used",
            StackWarning,
            stacklevel=3,
        )
    return float(wanted[0]), float(wanted[1])


def _compare_focus(stack: Stack, focus: tuple[float, ...]) -> None:
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
    limit = stack.saturation
    if limit is None:
        return
    count = int((stack.data >= limit).sum())
    if count > _SATURATED * stack.data.size:
        warnings.warn(
            f"{stack.source}: {count} of {stack.data.size} pixels ({count / stack.data.size:.1%}) are "
            f"saturated at {limit}; their intensity is unknown",
            StackWarning,
            stacklevel=3,
        )


def _check_brightness(stack: Stack, reports: Sequence[PrismReport], levels: Sequence[float]) -> None:
    for prism, (report, expected) in enumerate(zip(reports, levels, strict=True)):
        found = report.background / report.scale
        if found > _BRIGHT:
            warnings.warn(
                f"{stack.source}: prism {prism}'s background is {found:.4g}, not {expected:.4g}: "
                "float pixels count as relative to the empty bright field unless a scale is given",
                StackWarning,
                stacklevel=3,
            )


def _differ(found: float, wanted: float) -> bool:
    return abs(found - wanted) > _TOLERANCE * abs(wanted)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
