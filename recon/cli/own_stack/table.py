"""What `torchdic new` prints: a short table of what it found, and what it assumed."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from recon.cli.own_stack.settled import Settled
from recon.cli.own_stack.template import angle_in_words, name_of_setting
from recon.config.commented import Sourced
from recon.recording.survey.odd_images import odd_images
from recon.recording.survey.survey import SMALLEST, Survey, shows_edges
from torchdic.files.gathered import Gathered

Row = tuple[str, str, str]

# Uneven light by more than this part of its mean, and planes whose brightness differs by more, are worth a word.
_UNEVEN, _FLICKER = 0.3, 0.02

# The background at bias 0 is below this part of the brightest edges.
_DARK_FIELD = 0.25

# A part of the pixels of all images that is saturated.
_SATURATED = 1e-3


def summary(path: Path, gathered: Gathered, found: Survey, settled: Settled) -> str:
    """A table of rows: what, its value, and where it comes from."""
    settings, planes, height, width = gathered.stack.data.shape
    head = (
        f"{path}, for {gathered.stack.source}: {_counted(settings, 'prism setting')} × {_counted(planes, 'plane')} × "
        f"{height} × {width} pixels"
    )
    rows = [*_named(gathered), *_said(gathered, settled), *_measured(gathered, found, settled)]
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    lines = [f"  {what:<{widths[0]}}  {value:<{widths[1]}}  {origin}" for what, value, origin in rows]
    return "\n".join([head, "", *lines])


def warnings_of(gathered: Gathered, found: Survey, settled: Settled) -> list[str]:
    """What the user should know before a reconstruction, a line each; the first is of what is assumed."""
    return list(_warned(gathered, found, settled))


def _named(gathered: Gathered) -> Iterator[Row]:
    """Which file, or which of a file's channels, each setting is."""
    settings = len(gathered.stack.data)
    for number in range(settings if settings > 1 else 0):
        if name := name_of_setting(gathered, number):
            yield f"setting {number + 1}", name, "file" if gathered.one_file else "in the order of the files"


def _said(gathered: Gathered, settled: Settled) -> Iterator[Row]:
    def row(what: str, value: Sourced, unit: str = "") -> Row:
        return what, f"{value.value:g}{unit}", value.origin

    height = "" if settled.square else f"{settled.pixel_height:g} × "
    yield "pixel", f"{height}{settled.pixel_size.value:g} µm{' (y × x)' if height else ''}", settled.pixel_size.origin
    if gathered.stack.data.shape[1] > 1:
        yield row("focus step", settled.step, " µm")
    yield row("wavelength", settled.wavelength, " µm")
    yield row("objective's NA", settled.na)
    yield row("condenser's NA", settled.condenser_na)
    yield row("medium's index", settled.background)
    for number, (length, angle, bias) in enumerate(settled.prisms):
        which = f" {number + 1}" if len(settled.prisms) > 1 else ""
        sure = angle.why.split(",")[0] if angle.origin == "measured" else ""
        shown = f"{length.value:g} µm, {angle.value:g}° {sure}".rstrip()
        origins = f"length {length.origin}, angle {angle.origin} (towards {angle_in_words(angle.value)})"
        yield f"shear{which}", shown, origins
        inferred = bias.origin == "measured" and bias.value
        yield f"bias{which}", f"{bias.value:g}°", "size given, sign measured" if inferred else bias.origin


def _measured(gathered: Gathered, found: Survey, settled: Settled) -> Iterator[Row]:
    stack, unit = gathered.stack, " counts" if gathered.stack.is_integer else ""
    if stack.is_integer:
        bits = stack.bits or 8 * stack.data.dtype.itemsize
        yield "camera", f"{bits} bits", "file" if stack.bits else "file (of its pixels)"
    if settled.offset is not None:
        yield "camera's offset", f"{settled.offset.value:g}{unit}", settled.offset.origin
    levels, noises = [s.level for s in found.settings], [s.noise for s in found.settings if s.noise is not None]
    yield "background", f"{_range(levels)}{unit}", "measured"
    uneven = max(setting.unevenness for setting in found.settings)
    y, x = max((setting.tilt for setting in found.settings), key=lambda tilt: abs(tilt[0]) + abs(tilt[1]))
    x, y = (round(tilt, 2) + 0.0 for tilt in (x, y))  # a −0 is 0
    yield "uneven light", f"{uneven:.0%} (tilt {x:+.0%} rightward, {y:+.0%} downward)", "measured, is divided out"
    if noises:
        yield "noise", f"{_range(noises)}{unit}", "measured"
    if found.camera is not None:
        yield "gain", f"{found.camera.gain:.3g} counts per electron", "measured"
    if stack.data.shape[1] > 1:
        yield "planes' brightness", f"± {max(s.flicker for s in found.settings):.1%}", "measured, is fitted"
        sharpest = f"{found.sharpest + 1} of {stack.data.shape[1]}" if shows_edges(found) else "not seen"
        yield "sharpest plane", sharpest, "measured"
    if stack.is_integer:
        shown = f"{int(found.hot.sum())}, {int(found.dead.sum())}, {found.saturated}"
        alone = stack.data.shape[:2] == (1, 1)
        origin = "measured, are left out" + (" (one image can't tell stuck ones from fine detail)" if alone else "")
        yield "hot, dead, saturated pixels", shown, origin
    number, thickness = settled.slices
    yield "volume", f"{_counted(number, 'slice')} of {thickness:g} µm", "chosen"


def _warned(gathered: Gathered, found: Survey, settled: Settled) -> Iterator[str]:
    if settled.assumed:
        yield f"\n  assumed, because nothing tells: {', '.join(settled.assumed)}"
    lens, medium = gathered.setup, settled.background.value
    if lens.immersion is not None and settled.na.value > lens.immersion:
        yield f"warning: the file says NA {settled.na.value:g} in an immersion of {lens.immersion:g}: one is wrong"
    if settled.na.value > medium:
        yield f"NA {settled.na.value:g} is above the medium's index {medium:g}: light beyond the index is dark"
    yield from _too_little(gathered, found)
    yield from (f"warning: {line}" for line in odd_images(gathered.stack, prism="setting"))
    yield from _bright_extinction(gathered, settled)
    uneven, flicker = (max(getattr(s, name) for s in found.settings) for name in ("unevenness", "flicker"))
    if uneven > _UNEVEN:
        yield f"warning: the light is uneven by {uneven:.0%}"
    if flicker > _FLICKER:
        yield f"the planes' brightness differs by {flicker:.1%}; it is fitted"
    if found.saturated > _SATURATED * gathered.stack.data.size:
        yield f"warning: {found.saturated / gathered.stack.data.size:.1%} of the pixels are saturated"
    yield from settled.remarks
    yield from _of_given_angles(found, settled)


def _too_little(gathered: Gathered, found: Survey) -> Iterator[str]:
    """Images that show no edges, or are too small to show them."""
    height, width = gathered.stack.data.shape[2:]
    if min(height, width) < SMALLEST:
        yield (
            f"warning: images of {height} × {width} pixels are too small to tell background, noise and shear: of at "
            f"least {SMALLEST} × {SMALLEST} they can be told"
        )
    elif not shows_edges(found):
        yield (
            "warning: the images show no shear's direction, as of an empty field, of noise or of too faint a specimen; "
            "none of what is measured is of a specimen"
        )


def _bright_extinction(gathered: Gathered, settled: Settled) -> Iterator[str]:
    """Settings whose bias is given as 0, although their background is as bright as their edges."""
    dark = 0.0 if settled.offset is None else settled.offset.value
    for number, (_, _, bias) in enumerate(settled.prisms):
        images = gathered.stack.data[number]
        background, bright = (float(value) - dark for value in np.percentile(images, (50, 99.9)))
        if bias.origin == "given" and bias.value % 360 == 0 and background > _DARK_FIELD * bright:
            yield (
                f"warning: --bias {bias.value:g} makes an empty field dark, but setting {number + 1}'s background is "
                f"{background:.3g} where its edges are {bright:.3g}: give its bias, or --offset if that is the dark"
            )


def _of_given_angles(found: Survey, settled: Settled) -> Iterator[str]:
    """What the images say against the angles that were given, and which settings none was given for."""
    angles = [angle for _, angle, _ in settled.prisms]
    given = {angle.value: None for angle in angles if angle.origin == "given"}
    others = [number for number, angle in enumerate(angles) if angle.origin != "given"]
    if given and others:
        alone, other = next(iter(given)), angles[others[0]]
        yield (
            f"--shear-angle {alone:g} is of the first axis alone; settings {_listed(others)} have another one, "
            f"{other.value:g}° ({other.origin}); to give both: --shear-angle {alone:g} {other.value:g}"
        )
    for (_, told, bias), setting in zip(settled.prisms, found.settings, strict=True):
        seen = setting.direction
        if told.value not in given or bias.value == 0 or seen is None or not seen.signed:
            continue
        del given[told.value]  # one line for settings that share it
        turned = settled.lower != (bias.value < 0)
        degrees = math.degrees(seen.angle) + (180 if turned else 0)
        apart = abs((degrees - told.value + 180) % 360 - 180)
        if apart > 90:
            yield (
                f"warning: the images show the shear towards {degrees % 360:.0f}°, {told.value:g}° is given: reversed, "
                "unless Δn has the other sign"
            )
        elif apart > max(3 * math.degrees(seen.uncertainty), 10):
            yield f"warning: the images show the shear along {degrees % 360:.0f}°, {told.value:g}° is given"


def _listed(numbers: Sequence[int]) -> str:
    """Settings counted from 1."""
    return " and ".join(filter(None, [", ".join(str(n + 1) for n in numbers[:-1]), str(numbers[-1] + 1)]))


def _range(values: list[float]) -> str:
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
