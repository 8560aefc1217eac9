"""torchdic phase: the phase behind one image whose optics are unknown."""

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon.cli.arguments import decimal
from recon.cli.own_stack.phase_figure import draw_phase
from recon.config.schema import ConfigError
from recon.earlier.one_image import phase_of_image
from recon.recording.background import noise_level
from recon.recording.masks import counted_pixels
from recon.recording.stuck_pixels import stuck_pixels
from recon.recording.survey.direction import ShearDirection, shear_direction
from recon.recording.survey.focus import sharpest_plane
from recon.recording.survey.survey import flattened_planes
from recon.report import figures
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.results import check_inputs_stay, check_no_results
from torchdic.errors import StackError
from torchdic.files.gathered import gather
from torchdic.files.stack import write_stack
from torchdic.files.whole import write_json

PHASE, FIGURE, FACTS = "phase.ome.tif", "phase.png", "phase.json"

# How far a stuck pixel stands out of its neighbours, relative to these: optics that would tell are not known.
_OUT = 5.0

# What one image of unknown optics can't tell, in words.
UNKNOWN = (
    "the phase's scale: shear, bias and aperture are not known",
    "the phase's sign: shear and bias reversed together give the same image",
    "slow changes of the phase across the shear: one image has no signal there",
)


def arguments(parser: argparse.ArgumentParser) -> None:
    """The image, and what may be known of it."""
    parser.add_argument("image", type=Path, nargs="+", metavar="IMAGE", help="an image, or a stack or folder of planes")
    parser.add_argument("--series", type=int, metavar="N", help="which of several stacks in the file, counted from 0")
    parser.add_argument("--setting", type=int, default=1, metavar="N", help="prism setting, counted from 1")
    parser.add_argument("--plane", type=int, metavar="N", help="focus plane, counted from 1; the sharpest without it")
    parser.add_argument("--shear-angle", type=decimal, metavar="X", help="degrees, from right towards down")


def run(options: argparse.Namespace) -> None:
    """Find the phase and leave it in the folder as phase.ome.tif, phase.png and phase.json."""
    check_no_results(options.out, (FACTS,), restart=options.restart)
    check_inputs_stay(options.out, options.image, (PHASE, FIGURE))
    stack = gather(options.image, options.series).stack
    settings, planes, ny, nx = stack.data.shape
    _check_number("--setting", options.setting, settings)
    _check_number("--plane", options.plane, planes)
    counted = counted_pixels(stack, None, stuck_pixels(stack.data, _OUT, counted_pixels(stack)))
    setting = options.setting - 1
    flat = flattened_planes(stack.data[setting], None if counted is None else counted[setting])
    plane = sharpest_plane(flat[None]) if options.plane is None else options.plane - 1
    aspect = 1.0 if stack.pixel_size is None else stack.pixel_size[0] / stack.pixel_size[1]
    direction = _direction(flat, plane, options.shear_angle, aspect, stack.source)
    phase = phase_of_image(torch.from_numpy(flat[plane]), direction.vector, noise_level(flat[plane]), aspect).numpy()
    phase = phase if phase.mean() >= 0 else -phase  # either sign explains the image
    prepare_folder(options.out)
    write_stack(options.out / PHASE, phase.astype(np.float32), stack.pixel_size, names=["phase, on an arbitrary scale"])
    facts = _facts(stack.source, (options.setting, plane + 1, planes), direction, options.shear_angle)
    write_json(options.out / FACTS, {**facts, "pixels": [ny, nx], "pixel_size": stack.pixel_size})
    image = stack.data[setting, plane]
    figures.save(draw_phase(image, flat[plane], phase, direction, stack.pixel_size), options.out / FIGURE)
    print(_words(facts, planes))
    print(f"{options.out / FIGURE}: the phase, on an arbitrary scale. Not known: {'; '.join(UNKNOWN)}")


def _check_number(option: str, number: int | None, held: int) -> None:
    if number is not None and not 1 <= number <= held:
        raise ConfigError(f"{option} {number} must be from 1 to {held}: so many the stack holds")


def _direction(planes: np.ndarray, plane: int, told: float | None, aspect: float, source: str) -> ShearDirection:
    """The direction that is told, else the more certain of the plane's own and that of all planes.

    aspect: a pixel's side along y over that along x.
    """
    if told is not None:
        if not math.isfinite(told):
            raise ConfigError(f"--shear-angle {told} must be a finite angle in degrees")
        return ShearDirection(math.radians(told) % (2 * math.pi), 0.0, signed=False, specimens=0)
    found = [shear_direction(planes[plane : plane + 1], (aspect, 1.0))]
    if len(planes) > 1:
        found.append(shear_direction(planes, (aspect, 1.0)))
    known = [direction for direction in found if direction is not None]
    if not known:
        raise StackError(
            f"{source}: shows no direction of shear: no specimen stands alone with a bright and a dark side, "
            "and its spectrum has no axis; give it by --shear-angle"
        )
    return min(known, key=lambda direction: (not direction.signed, direction.uncertainty))


def _facts(source: str, place: tuple[int, int, int], direction: ShearDirection, told: float | None) -> dict[str, Any]:
    """What phase.json says."""
    setting, plane, _ = place
    degrees = math.degrees(direction.angle)
    return {
        "source": source,
        "setting": setting,
        "plane": plane,
        "shear_axis_degrees": round(degrees % 180, 2),
        "uncertainty_degrees": None if told is not None else round(math.degrees(direction.uncertainty), 2),
        "how": "given" if told is not None else _how(direction),
        "unknown": list(UNKNOWN),
    }


def _how(direction: ShearDirection) -> str:
    if direction.signed:
        number = direction.specimens
        return f"from {number} specimen{'' if number == 1 else 's'} that stand{'s' if number == 1 else ''} alone"
    return "from the spectrum of a crowded field, which specimens that lie alike would turn"


def _words(facts: dict[str, Any], planes: int) -> str:
    sure = "" if facts["uncertainty_degrees"] is None else f" ± {facts['uncertainty_degrees']:.0f}°"
    which = f"plane {facts['plane']} of {planes}; " if planes > 1 else ""
    return f"{which}shear axis {facts['shear_axis_degrees']:.1f}°{sure} from right towards down, {facts['how']}"
