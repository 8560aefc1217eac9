"""How well `torchdic calibrate` finds signs, orders and values, on stacks that no model which fits them has made.

    python benchmarks/calibration.py orders [SEED ...]      drawn recordings, told with the wrong sign or order or not
    python benchmarks/calibration.py beads [NAME ...]       beads of known size and index, from their exact fields
    python benchmarks/calibration.py specimens [SEED ...]   drawn recordings of unknown specimens
    python benchmarks/calibration.py drifts [SEED ...]      the same, told right: the drift of their images

The recordings are those of `data_synthetic.recorder`: a finer model, a camera's counts, tilt, flicker, drift and hot
pixels; and a user who is off by up to 10° in bias, 15 % in the shear's length and 10° in its axis, and doesn't know its
sign. A bead's images come from its exact field with 150 condenser directions. "error" is found minus true, over one
stated standard deviation in brackets. Seconds are processor seconds of one thread.
"""

import argparse
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tomli_w
import torch

from data_synthetic import Bead
from data_synthetic.recorder.drawn import Drawn, drawn
from data_synthetic.recorder.told import Mistakes, tell
from recon.calibration.beside_volume import find_images
from recon.cli.calibrate import known_bead
from recon.config import Config, load
from recon.config.schema import BeadSection
from recon.run.calibration.by_bead import by_bead
from recon.run.calibration.by_specimen import PLANES, by_specimen
from recon.run.calibration.calibrate import bounds_of
from recon.run.calibration.found import FoundQuantity
from recon.run.calibration.stack import CalibrationStack
from recon.run.fits.finer import FinerModel
from torchdic import Acquisition, Camera, Condenser, Grid, Microscope, Objective, Prism
from torchdic.files.stack import write_stack

SEEDS = range(10)
CPU = torch.device("cpu")
GRID = Grid((16, 64, 64), (0.5, 0.2, 0.2))


@dataclass(frozen=True)
class BeadScene:
    """A bead, its microscope and what a user tells. bias, turn: in degrees, off by these; length: times this."""

    bead: Bead
    microscope: Microscope
    shears: tuple[tuple[float, float], ...]
    biases: tuple[float, ...]
    grid: Grid = GRID
    photons: float = 10000.0
    bias: float = 8.0
    length: float = 1.12
    turn: float = 7.0
    na: float = 1.0


USUAL = Microscope(0.546, Objective(0.9), Condenser(0.7))
ACROSS = ((0.0, 0.24), (0.24, 0.0))
BEADS = {
    "two axes, ±90°": BeadScene(Bead(2.5, 0.035, 1.56, (0.3, 0.4, -0.6)), USUAL, ACROSS, (90.0, -90.0)),
    "one axis, ±60°": BeadScene(
        Bead(2.5, 0.035, 1.56, (-0.4, 0.2, 0.5)), USUAL, ((0.116, 0.138),), (60.0, -60.0), bias=-9.0, length=0.87
    ),
    "one axis, 70°": BeadScene(Bead(2.0, 0.05, 1.54), USUAL, ((0.14, -0.14),), (70.0,), turn=-9.0),
    "wide aperture": BeadScene(
        Bead(1.5, 0.06, 1.52, (0.0, -0.3, 0.2)),
        Microscope(0.546, Objective(1.3), Condenser(0.9)),
        ((0.0, 0.18),),
        (80.0, -80.0),
        Grid((16, 64, 64), (0.4, 0.13, 0.13)),
        na=0.9,
    ),
    "narrow condenser": BeadScene(
        Bead(2.5, 0.03, 1.56, (0.2, 0.0, 0.3)),
        replace(USUAL, condenser=Condenser(0.4)),
        ((0.2, 0.0),),
        (100.0, -100.0),
        bias=-7.0,
        length=0.9,
        na=1.15,
    ),
}


def told_stack(told: dict[str, Any], data: torch.Tensor, pixel: tuple[float, float]) -> tuple[CalibrationStack, Config]:
    """A stack and its configuration as a user has them: a file of counts, and TOML."""
    with tempfile.TemporaryDirectory() as folder:
        write_stack(Path(folder) / "stack.ome.tif", data, pixel)
        told["data"]["path"] = "stack.ome.tif"
        (Path(folder) / "run.toml").write_text(tomli_w.dumps(told), encoding="utf-8")
        config = load(Path(folder) / "run.toml")
        return CalibrationStack.read(config, CPU), config


def of_drawn(scene: Drawn) -> CalibrationStack:
    """The stack of a drawn recording, with what its user tells."""
    recording = scene.recording
    field = recording.field
    told = scene.told.config("", (field.shape[0], field.spacing[0]), (field.shape[1], field.shape[2]))
    told["data"]["offset"] = float(recording.camera.offset or 0.0)
    return told_stack(told, torch.from_numpy(recording.data), (field.spacing[1], field.spacing[2]))[0]


def orders(options: argparse.Namespace) -> None:
    """Signs and orders of drawn recordings."""
    columns = ("drawn", "specimen", "settings", "told wrongly", "found", "misfit / noise", "next best", "right", "s")
    print("| " + " | ".join(columns) + " |\n" + "|---" * len(columns) + "|")
    for seed in options.names or SEEDS:
        scene = drawn(int(seed))
        stack, mistakes = of_drawn(scene), scene.told.mistakes
        began = time.process_time()
        found = stack.orders(bounds_of(stack.config))
        assert found is not None
        seconds = time.process_time() - began
        wrong = [n for n, is_so in (("sign", mistakes.reversed_shear), ("focus", mistakes.reversed_focus)) if is_so]
        expected = " and ".join(wrong) or "as declared"
        last = [tried for tried in found.tried if tried.rounds == found.tried[0].rounds]
        chosen = next(tried for tried in last if tried.otherwise is found.chosen)
        others = min((tried.misfit for tried in last if tried is not chosen), default=math.nan)
        unit = found.noise or 1.0
        cells = (
            str(seed),
            scene.kind,
            str(len(stack.data)),
            expected,
            found.chosen.name,
            f"{chosen.misfit / unit:.2f}",
            f"{others / unit:.2f}",
            "yes" if found.chosen.name == expected else "NO",
            f"{seconds:.0f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


def bead_stack(scene: BeadScene) -> CalibrationStack:
    """A bead's stack from its exact field, and a configuration with what a user tells of it."""
    depth = scene.grid.extent[0] / 2
    focus = [round(-0.8 * depth + i * 1.6 * depth / 8, 4) for i in range(9)]
    prisms = [Prism(shear, math.radians(bias)) for shear in scene.shears for bias in scene.biases]
    images = FinerModel(sources=150).images(scene.bead, scene.grid, scene.microscope, Acquisition(prisms, focus))
    camera = Camera(photons=scene.photons, read_noise=2.0, gain=2.0, offset=100.0, bits=16)
    data = camera.record(images, torch.Generator().manual_seed(1))
    cosine, sine = (scene.length * part(math.radians(scene.turn)) for part in (math.cos, math.sin))
    assert scene.microscope.objective is not None
    assert scene.microscope.condenser is not None
    told: dict[str, Any] = {
        "volume": {"shape": scene.grid.shape, "spacing": scene.grid.spacing, "background": scene.bead.background},
        "microscope": {
            "wavelength": scene.microscope.wavelength,
            "objective": {"na": scene.microscope.objective.na},
            "condenser": {"na": scene.na * scene.microscope.condenser.na},
        },
        "acquisition": {
            "focus": focus,
            "prisms": [
                {
                    "shear": [cosine * y + sine * x, cosine * x - sine * y],
                    "bias": math.radians(math.copysign(abs(bias) + scene.bias, bias)),
                }
                for y, x in scene.shears
                for bias in scene.biases
            ],
        },
        "data": {"offset": 100.0},
        "calibration": {"bead": {"radius": scene.bead.radius, "index": scene.bead.background + scene.bead.contrast}},
    }
    return told_stack(told, data, (scene.grid.spacing[1], scene.grid.spacing[2]))[0]


def beads(options: argparse.Namespace) -> None:
    """Values from beads."""
    columns = ("bias °", "length %", "angle °", "condenser %", "misfit / noise", "s")
    print("| bead | " + " | ".join(columns) + " |\n" + "|---" * (1 + len(columns)) + "|")
    for name in options.names or BEADS:
        scene = BEADS[name]
        stack = bead_stack(scene)
        section = stack.config.calibration.bead
        assert isinstance(section, BeadSection)
        began = time.process_time()
        _, found = by_bead(stack, known_bead(section, scene.bead.background), section)
        seconds = time.process_time() - began
        named = {quantity.name: quantity for quantity in found}
        biases = [math.radians(bias) for _ in scene.shears for bias in scene.biases]
        lengths = [math.hypot(*shear) for shear in scene.shears]
        angles = [math.atan2(*shear) for shear in scene.shears]
        assert scene.microscope.condenser is not None
        na = scene.microscope.condenser.na
        cells = (
            name,
            errors(named["bias"], biases, 180 / math.pi),
            errors(named["shear's length"], lengths, 100 / lengths[0]),
            errors(named["shear's angle"], angles, 180 / math.pi),
            errors(named["condenser na"], [na], 100 / na),
            named["bias"].how.partition("misfit ")[2].partition(" ×")[0],
            f"{seconds:.0f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


def errors(found: FoundQuantity, true: Sequence[float], factor: float) -> str:
    """The largest error in a unit, and in brackets the largest over its own standard deviation."""
    if not found.told:
        return "left"
    values, sure = (part if isinstance(part, list) else [part] for part in (found.value, found.uncertainty))
    away = [abs(value - right) for value, right in zip(values, true, strict=True)]
    most = max(part / deviation for part, deviation in zip(away, sure, strict=True))
    return f"{factor * max(away):.1f} ({most:.1f} of {factor * max(sure):.1f})"


def specimens(options: argparse.Namespace) -> None:
    """Values from drawn recordings of specimens that aren't known; signs and orders are told right."""
    print("| drawn | specimen | settings | told, angle ° | angle ° | condenser % | s |\n" + "|---" * 7 + "|")
    for seed in options.names or SEEDS:
        scene = drawn(int(seed))
        right = replace(scene.told.mistakes, reversed_shear=False, reversed_focus=False)
        scene = replace(scene, told=tell(scene.recording, right))
        stack, recording = of_drawn(scene), scene.recording
        began = time.process_time()
        _, found = by_specimen(stack, set())
        seconds = time.process_time() - began
        named = {quantity.name: quantity for quantity in found}
        shears = list(dict.fromkeys(tuple(map(float, p.shear)) for p in recording.acquisition.prisms if p is not None))
        assert recording.microscope.condenser is not None
        na = float(recording.microscope.condenser.na)
        cells = (
            str(seed),
            scene.kind,
            str(len(stack.data)),
            f"{math.degrees(right.turn):.1f}",
            errors(named["shear's angle"], [math.atan2(*shear) for shear in shears], 180 / math.pi),
            errors(named["condenser na"], [na], 100 / na),
            f"{seconds:.0f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


def drifts(options: argparse.Namespace) -> None:
    """The drift of drawn recordings that are told right."""
    print("| drawn | specimen | settings | true, µm | error, µm | largest error / deviation |\n" + "|---" * 6 + "|")
    for seed in options.names or SEEDS:
        scene = drawn(int(seed))
        scene = replace(scene, told=tell(scene.recording, Mistakes()))
        beside = of_drawn(scene).beside(PLANES)
        values, deviations = find_images(beside)
        shifts = scene.recording.faults.shifts(len(scene.recording.acquisition.focus))[list(beside.part.planes)]
        true = (shifts - shifts.mean(0)).expand_as(values["drift"])
        error = values["drift"] - true
        cells = (
            str(seed),
            scene.kind,
            str(len(error)),
            *(f"{float(part.square().mean().sqrt()):.3f}" for part in (true, error)),
            f"{float((error / deviations['drift']).abs().max()):.1f}",
        )
        print("| " + " | ".join(cells) + " |", flush=True)


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "orders": orders,
    "beads": beads,
    "specimens": specimens,
    "drifts": drifts,
}


def main() -> int:
    """Print the chosen table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=COMMANDS)
    parser.add_argument("names", nargs="*", help="seeds, or names of beads; all without any")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    COMMANDS[options.what](options)
    return 0


if __name__ == "__main__":
    sys.exit(main())
