"""The command line: torchdic demo | simulate | plan | reconstruct | work-precision."""

import argparse
import math
import os
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

# Before torch, so that its idle threads (of GNU's OpenMP) spin for microseconds and then sleep. Spinning on, the
# default, they wait for each other by the time slice wherever another program wants a core too; asleep at once, they
# are woken at each operation, which takes longer than many of these (benchmarks/threads.py).
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import torch
from tqdm import tqdm

from data_synthetic import (
    Bead,
    CellPhantom,
    EtchedGlassGrating,
    EtchedGlassStep,
    GaussianBall,
    GradedIndexRod,
    LayeredMedium,
)
from recon.config.conversion import dump
from recon.config.reading import load, structure
from recon.config.schema import Config, ConfigError
from recon.fit.planned import announce
from recon.fit.problem import Recipe
from recon.report import figures
from recon.report.comparison import compare, table
from recon.report.fronts import as_dict, as_table, draw_fronts, write_csv
from recon.run.checkpoint import CheckpointError
from recon.run.exact_images import exact_images
from recon.run.interruption import InterruptedRunError
from recon.run.reconstruct import RECOMMENDED, prepare_folder, reconstruct
from torchdic import (
    STANDARD,
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    SamplingWarning,
    ShortOfMemoryError,
    ToleranceWarning,
    Volume,
    image,
    plan,
)
from torchdic.errors import SidewaysError, StackError, TurnedRaysError, UnstableError
from torchdic.fidelity import Propagation
from torchdic.files.stack import write_stack
from torchdic.files.whole import write_json, write_text
from torchdic.forward.foresee import allotted
from torchdic.memory.free import check_volume
from torchdic.planning.ladders import reaches_a_side
from torchdic.planning.work_precision import converged_fidelities, ladder, trials

SPECIMENS: dict[str, type] = {
    "bead": Bead,
    "cell": CellPhantom,
    "etched_glass": EtchedGlassStep,
    "etched_grating": EtchedGlassGrating,
    "gaussian_ball": GaussianBall,
    "graded_index_rod": GradedIndexRod,
    "layered_medium": LayeredMedium,
}
# Of a plan whose configuration names none.
USUAL_TOLERANCE = 0.01
BAD_INPUT, FAILED, INTERRUPTED = 2, 1, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 2 for bad input, 1 for a fit that diverges, 130 for an interruption."""
    options = _parser().parse_args(arguments)
    warnings.showwarning = _show_each_once()
    for kind in (SamplingWarning, ToleranceWarning):
        warnings.simplefilter("always", kind)
    try:
        options.command(options)
    except (ConfigError, StackError, CheckpointError) as error:
        return _fail(str(error), BAD_INPUT)
    except TurnedRaysError as error:
        return _fail(f"{options.config}: {error}; the wave may cross it", BAD_INPUT)
    except (UnstableError, SidewaysError, ShortOfMemoryError) as error:
        return _fail(f"{options.config}: {error}", BAD_INPUT)
    except FloatingPointError as error:
        return _fail(f"{error}; a smaller learning_rate or more tv may help", FAILED)
    except (InterruptedRunError, KeyboardInterrupt) as error:
        return _fail(str(error) or "interrupted", INTERRUPTED)
    return 0


def _demo(options: argparse.Namespace) -> None:
    prepare_folder(options.out)
    bead = Bead(radius=2.5, contrast=0.03, background=1.56)
    grid = Grid((20, 64, 64), (0.4, 0.17, 0.17))
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.7))
    prisms = [Prism(shear, bias) for shear in ((0.0, 0.24), (0.24, 0.0)) for bias in (math.pi / 2, -math.pi / 2)]
    acquisition = Acquisition(prisms, [float(z) for z in range(-4, 5)])
    print("A 5 µm bead of index 1.59 in cement of 1.56: DIC stack from its exact field …", flush=True)
    data = exact_images(bead, grid, microscope, acquisition, Fidelity(sources=150)).float()
    write_stack(options.out / "stack.ome.tif", data, grid.spacing[1:], 1.0)
    figures.save(figures.draw_stack(data, prisms, acquisition.focus, grid.spacing[1:]), options.out / "stack.png")
    truth = bead.delta(grid, dtype=torch.float32)
    contenders = [
        (Fidelity("projection"), Recipe(steps=60)),
        (Fidelity("rays", sources=16, steps=10), Recipe(steps=40)),
        (RECOMMENDED, Recipe()),
    ]
    trials = compare(
        data,
        truth,
        truth > 0.99 * bead.contrast,
        grid,
        bead.background,
        microscope,
        acquisition,
        contenders,
        options.out,
    )
    print("\n" + table(trials, bead.contrast))
    print(f"\nmean Δn: over the voxels wholly inside the bead. Pictures and volumes are in {options.out}/")


def _simulate(options: argparse.Namespace) -> None:
    config = load(options.config)
    specimen = _specimen(config, str(options.config))
    grid, microscope, acquisition = config.volume.grid, config.microscope, config.acquisition
    fidelity = config.fidelity or STANDARD
    if config.simulation.exact and config.tolerance is not None:
        raise ConfigError(f"{options.config}: tolerance: simulation.exact leaves nothing to plan")
    if config.simulation.exact and not hasattr(specimen, "field"):
        raise ConfigError(f"{options.config}: simulation.exact: the exact field of this specimen isn't known")
    if config.simulation.exact:
        prepare_folder(options.out)
        images = exact_images(specimen, grid, microscope, acquisition, fidelity)
    else:
        with torch.no_grad():
            volume = _volume(specimen, grid, options.device)
            if config.tolerance is None:  # else a fidelity has yet to be planned
                allotted(volume, microscope, acquisition, fidelity)
            prepare_folder(options.out)
            if config.tolerance is not None:
                planned = plan(volume, microscope, acquisition, config.tolerance)
                print(f"{announce(planned)}, predicted {planned.seconds:.2g} s", flush=True)
                fidelity = planned.fidelity
                write_json(options.out / "plan.json", planned.as_dict())
                resolved = replace(config, fidelity=fidelity, tolerance=None)
                write_text(options.out / "config.resolved.toml", f"# {announce(planned)}\n{dump(resolved)}")
            images = image(volume, microscope, acquisition, fidelity).cpu()
    pixel = grid.spacing[1:]
    if microscope.camera is not None:
        pixel = microscope.camera.pixel_spacing(pixel)
        images = microscope.camera.record(images, torch.Generator().manual_seed(config.simulation.seed))
    focus = [float(f) for f in acquisition.focus]
    # counts keep their integer dtype, by which a reader knows them
    data = images.float() if images.is_floating_point() else images
    write_stack(options.out / "stack.ome.tif", data, pixel, _equal_step(focus))
    figures.save(figures.draw_stack(images.float(), acquisition.prisms, focus, pixel), options.out / "stack.png")
    print(f"{options.out / 'stack.ome.tif'}: {_counts(images.shape)}")


def _plan(options: argparse.Namespace) -> None:
    config = load(options.config)
    specimen = _specimen(config, str(options.config))
    tolerance = USUAL_TOLERANCE if config.tolerance is None else config.tolerance
    volume = _volume(specimen, config.volume.grid, options.device)
    if options.out is not None:
        prepare_folder(options.out)
    planned = plan(volume, config.microscope, config.acquisition, tolerance)
    print(planned.table())
    if options.out is not None:
        write_json(options.out / "plan.json", planned.as_dict())


def _reconstruct(options: argparse.Namespace) -> None:
    signal.signal(signal.SIGTERM, _interrupt)
    config = load(options.config)
    if config.data is None:
        raise ConfigError(f"{options.config}: missing key data.path: a reconstruction needs a stack")
    result = reconstruct(config, options.out, options.device, resume=options.resume, restart=options.restart)
    delta: Any = result.metrics["delta"]
    print(
        f"{options.out / 'volume.ome.tif'}: Δn {delta['min']:.4g} … {delta['max']:.4g}, "
        f"misfit {result.metrics['misfit']:.4g} after {result.metrics['steps']} steps"
    )


def _work_precision(options: argparse.Namespace) -> None:
    config = load(options.config)
    specimen = _specimen(config, str(options.config))
    grid, microscope, acquisition = config.volume.grid, config.microscope, config.acquisition
    if config.simulation.exact and not hasattr(specimen, "field"):
        raise ConfigError(f"{options.config}: simulation.exact: the exact field of this specimen isn't known")
    volume = _volume(specimen, grid, options.device)
    candidates = config.candidates or ladder(grid, padded=not reaches_a_side(volume))
    reference: dict[Propagation, Fidelity] = converged_fidelities(candidates, grid)
    if (given := config.work_precision.reference) is not None:
        reference = {propagation: replace(given, propagation=propagation) for propagation in reference}
    prepare_folder(options.out)
    exact = None
    if hasattr(specimen, "field"):
        exact = exact_images(specimen, grid, microscope, acquisition, reference["wave"]).to(options.device)
    steps = trials(
        volume, microscope, acquisition, candidates, reference, exact=exact, repeats=config.work_precision.repeats
    )
    found = list(tqdm(steps, desc="work-precision", total=len(candidates), unit="candidate"))
    write_csv(options.out / "work_precision.csv", found)
    write_json(options.out / "work_precision.json", as_dict(found, reference))
    figures.save(draw_fronts({str((config.specimen or {})["kind"]): found}), options.out / "work_precision.png")
    print(as_table(found))
    print(f"\n{options.out / 'work_precision.csv'}, .json and .png: {len(found)} candidates")


def _volume(specimen: Any, grid: Grid, device: torch.device) -> Volume:
    """A specimen's voxels, float32. Raises ShortOfMemoryError where they would have no room."""
    check_volume(grid, 2, device)  # beside the index, what it is made of
    return Volume(grid, specimen.delta(grid, dtype=torch.float32, device=device), specimen.background)


def _specimen(config: Config, source: str) -> Any:
    if config.specimen is None:
        raise ConfigError(f"{source}: missing key specimen: a simulation or plan needs one")
    values = dict(config.specimen)
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in SPECIMENS:
        raise ConfigError(f"{source}: specimen.kind: {kind!r} must be one of {', '.join(map(repr, SPECIMENS))}")
    values.setdefault("background", config.volume.background)
    specimen = structure(values, SPECIMENS[kind], source, "specimen")
    if specimen.background != config.volume.background:
        raise ConfigError(
            f"{source}: specimen.background {specimen.background} differs from volume.background "
            f"{config.volume.background}"
        )
    return specimen


def _equal_step(focus: Sequence[float]) -> float | None:
    """The distance between focus planes, None where they are not equally spaced upwards."""
    steps = [b - a for a, b in pairwise(focus)]
    if not steps or steps[0] <= 0 or max(steps) - min(steps) > 1e-6 * steps[0]:
        return None
    return steps[0]


def _counts(shape: Sequence[int]) -> str:
    return f"{shape[0]} prism settings × {shape[1]} focus planes × {shape[2]} × {shape[3]} pixels"


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, as all others are."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")


class _Version(argparse.Action):
    """Looks the version up only if it is asked for: a checkout may not be installed."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> NoReturn:
        print(f"{parser.prog} {version('torchdic')}")
        parser.exit()


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="torchdic",
        description="Simulate DIC images, and reconstruct the refractive-index volume behind them.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    out = _Parser(add_help=False)
    out.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    device = _Parser(add_help=False)
    device.add_argument(
        "--device", type=_device, default="auto", help="cpu, cuda, … (default: a GPU where there is one)"
    )
    config = _Parser(add_help=False)
    config.add_argument("config", type=Path, metavar="CONFIG.toml")

    demo = commands.add_parser("demo", parents=[out], help="a bead: truth beside three reconstructions")
    demo.set_defaults(command=_demo)
    simulate = commands.add_parser("simulate", parents=[config, out, device], help="DIC stack of a specimen")
    simulate.set_defaults(command=_simulate)
    planner = commands.add_parser(
        "plan", parents=[config, device], help="which effects a scene calls for, and the cheapest fidelity"
    )
    planner.add_argument("--out", type=Path, metavar="DIR", help="folder for plan.json")
    planner.set_defaults(command=_plan)
    fit = commands.add_parser("reconstruct", parents=[config, out, device], help="index volume behind a DIC stack")
    again = fit.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="go on with an interrupted run in DIR, if there is one")
    again.add_argument("--restart", action="store_true", help="begin anew in spite of an interrupted run in DIR")
    fit.set_defaults(command=_reconstruct)
    cost = commands.add_parser(
        "work-precision", parents=[config, out, device], help="what accuracy costs: error against seconds and bytes"
    )
    cost.set_defaults(command=_work_precision)
    return parser


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        tensor = torch.zeros(1, device=name)
        tensor.item()  # a meta tensor holds nothing
    except (RuntimeError, AssertionError) as error:
        raise argparse.ArgumentTypeError(f"{name!r} is no device here: {str(error).splitlines()[0]}") from error
    return tensor.device


def _interrupt(_number: int, _frame: object) -> NoReturn:
    raise KeyboardInterrupt


def _show_each_once() -> Callable[..., None]:
    """A way of showing warnings: Python's own "once" is once for each calling module."""
    shown: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            tqdm.write(f"torchdic: warning: {message}", file=sys.stderr)  # on a line of its own, above the bar

    return show


def _fail(message: str, code: int) -> int:
    print(f"torchdic: error: {message}", file=sys.stderr)
    return code
