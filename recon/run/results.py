"""What a finished reconstruction leaves in its folder: the volume, metrics, configuration and figures."""

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.config.resolved import RESOLVED, leave_resolved
from recon.config.schema import Config
from recon.fit.planned import announce_record
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference, with_values
from recon.recording.preparation import Measured
from recon.report import figures
from recon.report.metrics import residual_rms
from recon.report.verdict import PoorFitWarning, Verdict, judged
from recon.run.checkpoint import Checkpoint, UnsavedWarning
from recon.run.evidence.kept_refits import ERROR_BARS
from recon.run.evidence.seen import coverage_of, what_lacks
from torchdic import Grid
from torchdic.errors import StackError
from torchdic.files.stack import equal_step, write_stack, write_volume
from torchdic.files.whole import WriteError, write_json
from torchdic.memory.shortage import as_shortage, is_shortage

VOLUME, METRICS = "volume.ome.tif", "metrics.json"
# Every plane of every prism: as it was measured, brought to the model's unit, and as the model has it.
IMAGES = "images.ome.tif"
# The volume of a descent that was interrupted, beside the results of one that wasn't.
INTERRUPTED = "volume.interrupted.ome.tif"
# All volumes, images and pictures that a reconstruction leaves.
LEFT = (VOLUME, IMAGES, INTERRUPTED, "opl.ome.tif", "images.png", "sections.png", "misfit.png")

# What ends a message about results that can't be written, where a run can go on.
GO_ON = "; make room and go on with --resume"


class ResultsError(ValueError):
    """Results cannot be written: one line with the files and the reason."""


@dataclass(frozen=True, eq=False)
class Tiled:
    """A field that was fitted tile by tile.

    ended: the first tile's last step, with the whole field's Δn and the seconds of all tiles, and its log. images: the
    model's, of the whole field. first: the first tile's problem. record: of the tiles, for metrics.json.
    """

    ended: Checkpoint
    images: Float[Tensor, "prism focus y x"]
    first: Problem
    record: dict[str, Any]


@dataclass(frozen=True)
class Result:
    """What a reconstruction leaves: Δn (z, y, x) and its metrics, as in metrics.json."""

    delta: Float[Tensor, "z y x"]
    metrics: dict[str, object]


@torch.no_grad()
def model_images(problem: Problem, last: Step) -> Float[Tensor, "prism focus y x"]:
    """The images of a descent's last step, computed with its last fidelity."""
    values = {name: value.to(problem.misfit.data.device) for name, value in last.values.items()}
    return with_values(problem.unknowns, values, problem.setup).images(problem.fidelity.last(last.plans))


def metrics(
    problem: Problem,
    last: Step,
    images: Float[Tensor, "prism focus y x"],
    measured: Measured,
    method: str,
    tiled: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The numbers of metrics.json.

    images: the model's, of the last step. measured: what the preparation found in the stack, such as the standard
    deviation of each prism's noise. method: that found the step. tiled: the record of a fit by tiles.
    """
    out = measured.left_out
    delta = problem.setup.within_field(last.delta)
    found: dict[str, Any] = {
        "method": method,
        "propagation": problem.fidelity.last(last.plans).propagation,
        "misfit": float(problem.misfit(images)),
        "noise_misfit": problem.misfit.of_noise(measured.noise),
        "residual_rms": residual_rms(images, problem.misfit.data, problem.misfit.mask),
        "steps": last.number,
        "seconds": round(last.seconds, 3),
        "delta": summary(delta),
        "learned": {name: value.tolist() for name, value in last.values.items() if name != IndexDifference.name},
        "prisms": [asdict(report) for report in measured.prisms],
        "left_out": {"stuck": out.stuck, "saturated": out.saturated, "masked": out.masked, "share": out.share},
    }
    if last.weights:
        found["tv"] = last.weights[-1]["tv"]
        found["weights"] = [{k: _known(v) for k, v in record.items()} for record in last.weights]
    if tiled is not None:
        found["tiles"] = tiled
    if problem.setup.margin > 0:
        found["margin"] = problem.setup.margin
    if problem.support is not None:
        found["support"] = {"share": float(problem.support.float().mean())}
    if last.plans:
        found["plans"] = list(last.plans)
    return found


def summary(delta: Float[Tensor, "z y x"]) -> dict[str, float]:
    """The range and the mean of Δn; a −0 is 0."""
    return {name: float(of(delta)) + 0.0 for name, of in (("min", torch.min), ("max", torch.max), ("mean", torch.mean))}


def _known(value: Any) -> Any:
    """A value as JSON can hold it: no number is null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def tell(verdict: Verdict) -> None:
    """Print the verdict, or warn PoorFitWarning of it where the volume doesn't explain the stack."""
    if verdict.alarming:
        warnings.warn(verdict.words, PoorFitWarning, stacklevel=3)
    else:
        print(verdict.words)


def tell_seen(config: Config, measured: Measured, delta: Float[Tensor, "z y x"]) -> dict[str, Any]:
    """Print what the images can't say of the specimen, if anything; returns it with the share that they see."""
    seen = coverage_of(config, measured.noise, delta, roughly=True)
    lacks = what_lacks(config, seen)
    if lacks is not None:
        print(lacks)
    return {"share": None if seen is None else seen.share, "lacks": lacks}


def _tell_of_earlier(out: Path) -> None:
    """Print where a folder has error bars of an earlier volume."""
    if (out / ERROR_BARS).exists():
        again = f"torchdic error-bars {quote(str(out))} --restart"
        print(f"{out / ERROR_BARS}: those of an earlier volume; find new ones with {again}")


def write_results(
    out: Path,
    config: Config,
    measured: Measured,
    problem: Problem,
    ended: Checkpoint,
    sections: Float[Tensor, "focus y x"] | None = None,
    tiled: Tiled | None = None,
) -> Result:
    """Write a finished descent's volume, metrics, resolved configuration and figures into a folder.

    sections: optical path lengths in µm, where the method gives them. tiled: the fit where it was one of tiles.
    Raises ResultsError where some of them cannot be written; the others are.
    """
    last, grid = ended.step, problem.setup.field
    data = problem.misfit.data.cpu()
    images = model_images(problem, last) if tiled is None else tiled.images.to(problem.misfit.data.device)
    delta = problem.setup.within_field(last.delta).cpu()
    method = config.reconstruction.method
    found = metrics(problem, last, images, measured, method, None if tiled is None else tiled.record)
    part = None if tiled is None else tiled.first
    verdict = judged(problem, images, measured.noise, method, ended.rows, config.assumed, part).with_volume(delta)
    found["verdict"] = verdict.as_json()
    tell(verdict)
    found["seen"] = tell_seen(config, measured, delta)
    notes = [*filter(None, [str(measured.left_out)]), *map(announce_record, last.plans)]
    prisms = config.acquisition.prisms

    def write_sections() -> None:
        if sections is not None:
            step, name = equal_step(measured.focus), "optical path length in µm"
            write_stack(out / "opl.ome.tif", sections[None].cpu(), grid.spacing[1:], step, names=[name])

    def draw_images() -> None:
        figure = figures.draw_images(data, images.cpu(), prisms, measured.focus, problem.setup.pixels)
        figures.save(figures.headed(figure, verdict.words), out / "images.png")

    def draw_misfit() -> None:
        if ended.rows:
            figures.save(figures.draw_misfit(ended.rows), out / "misfit.png")

    writers = {
        VOLUME: lambda: _write_volume(out / VOLUME, delta, grid),
        METRICS: lambda: write_json(out / METRICS, found),
        RESOLVED: lambda: leave_resolved(config, out, *notes),
        "opl.ome.tif": write_sections,
        IMAGES: lambda: _write_images(out / IMAGES, data, images.cpu(), measured),
        "images.png": draw_images,
        "sections.png": lambda: figures.save(figures.draw_sections({"": delta}, grid), out / "sections.png"),
        "misfit.png": draw_misfit,
    }
    _write_each(out, writers)
    (out / INTERRUPTED).unlink(missing_ok=True)
    _tell_of_earlier(out)
    return Result(delta, found)


def leave_configuration(config: Config, out: Path, command: str, *notes: str) -> None:
    """Leave what a command other than a reconstruction has run with. Raises WriteError.

    Where the folder holds a volume, config.resolved.toml is what that was fitted with, and stays: the file is then
    named after the command. notes: lines that stand above it as comments.
    """
    name = f"{command}.resolved.toml" if (out / VOLUME).exists() else RESOLVED
    leave_resolved(config, out, *notes, name=name)


def leave_interrupted(out: Path, delta: Float[Tensor, "z y x"], field: Grid, told: str) -> Path:
    """Write the volume of an interrupted descent, to be looked at; returns its file.

    It is the usual one, unless the folder has the results of a finished descent. told: the name of its channel.
    Raises StackError.
    """
    path = out / (INTERRUPTED if (out / METRICS).exists() else VOLUME)
    _write_volume(path, delta, field, told)
    return path


def _write_images(
    path: Path,
    data: Float[Tensor, "prism focus y x"],
    images: Float[Tensor, "prism focus y x"],
    measured: Measured,
) -> None:
    """Write the measured images beside the model's, two channels for each prism. Raises StackError."""
    names = [f"{kind}, prism {prism}" for prism in range(1, len(data) + 1) for kind in ("measured", "modelled")]
    pairs = torch.stack([data, images], 1).flatten(0, 1)
    write_stack(path, pairs, measured.pixel_size, equal_step(measured.focus), names=names)


def _write_volume(path: Path, delta: Float[Tensor, "z y x"], grid: Grid, name: str = "delta n") -> None:
    """Write a volume as it is, or compressed where there is no room for that. Raises StackError, warns UnsavedWarning.

    name: of the file's one channel.
    """
    try:
        write_volume(path, delta, grid, name=name)
    except StackError as error:
        if not isinstance(error.__cause__, WriteError):
            raise
        write_volume(path, delta, grid, name=name, compression="zlib")
        warnings.warn(f"{error}; it is written compressed instead", UnsavedWarning, stacklevel=2)


def _write_each(out: Path, writers: Mapping[str, Callable[[], None]]) -> None:
    """Write each result by its name, although another one cannot be written; raise ResultsError of those at the end."""
    failed: list[str] = []
    for name, write in writers.items():
        try:
            write()
        except (WriteError, StackError) as error:
            failed.append(str(error))
        except (MemoryError, RuntimeError) as error:
            if not is_shortage(error):
                raise
            failed.append(f"{out / name}: cannot be written: {as_shortage(error)}")
    if failed:
        more = len(failed) - 1
        others = f"; nor can {more} other result{'s' if more > 1 else ''}" if more else ""
        raise ResultsError(f"{failed[0]}{others}")
