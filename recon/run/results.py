"""What a finished reconstruction leaves in its folder: the volume, metrics, configuration and figures."""

import math
import warnings
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.config.conversion import dump
from recon.config.schema import Config
from recon.fit.planned import announce_record
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference, with_values
from recon.recording.preparation import Measured
from recon.report import figures
from recon.report.metrics import residual_rms
from recon.run.checkpoint import Checkpoint
from torchdic.files.stack import write_stack, write_volume
from torchdic.files.whole import write_json, write_text


class PoorFitWarning(UserWarning):
    """The volume that a descent found explains its data less well than empty medium does."""


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
) -> dict[str, Any]:
    """The numbers of metrics.json.

    images: the model's, of the last step. measured: what the preparation found in the stack, such as the standard
    deviation of each prism's noise. method: that found the step.
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
        "delta": {"min": float(delta.min()), "max": float(delta.max()), "mean": float(delta.mean())},
        "learned": {name: value.tolist() for name, value in last.values.items() if name != IndexDifference.name},
        "prisms": [asdict(report) for report in measured.prisms],
        "left_out": {"stuck": out.stuck, "saturated": out.saturated, "masked": out.masked, "share": out.share},
    }
    if last.weights:
        found["tv"] = last.weights[-1]["tv"]
        found["weights"] = [{k: _known(v) for k, v in record.items()} for record in last.weights]
    if problem.setup.margin > 0:
        found["margin"] = problem.setup.margin
    if problem.support is not None:
        found["support"] = {"share": float(problem.support.float().mean())}
    if last.plans:
        found["plans"] = list(last.plans)
    return found


def _known(value: Any) -> Any:
    """A value as JSON can hold it: no number is null."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def warn_of_poor_fit(misfit: float) -> None:
    """Warn PoorFitWarning where empty medium would explain the stack better than the volume that was found.

    misfit: of that volume.
    """
    if misfit > 1:
        warnings.warn(
            f"the misfit {misfit:.3g} is above 1: empty medium would explain the stack better; "
            "the optics in the configuration may not be those of the stack",
            PoorFitWarning,
            stacklevel=3,
        )


def write_results(
    out: Path,
    config: Config,
    measured: Measured,
    problem: Problem,
    ended: Checkpoint,
    sections: Float[Tensor, "focus y x"] | None = None,
) -> Result:
    """Write a finished descent's volume, metrics, resolved configuration and figures into a folder.

    sections: optical path lengths in µm, where the method gives them.
    """
    last, grid = ended.step, problem.setup.field
    images, data = model_images(problem, last), problem.misfit.data.cpu()
    delta = problem.setup.within_field(last.delta).cpu()
    found = metrics(problem, last, images, measured, config.reconstruction.method)
    warn_of_poor_fit(found["misfit"])
    write_volume(out / "volume.ome.tif", delta, grid)
    notes = [*filter(None, [str(measured.left_out)]), *map(announce_record, last.plans)]
    comments = "".join(f"# {note}\n" for note in notes)
    write_text(out / "config.resolved.toml", comments + dump(config))
    write_json(out / "metrics.json", found)
    drawn = figures.draw_images(data, images.cpu(), config.acquisition.prisms, measured.focus, problem.setup.field)
    figures.save(drawn, out / "images.png")
    figures.save(figures.draw_sections({"": delta}, grid), out / "sections.png")
    if ended.rows:
        figures.save(figures.draw_misfit(ended.rows), out / "misfit.png")
    if sections is not None:
        steps = [abs(b - a) for a, b in pairwise(measured.focus)]
        write_stack(out / "opl.ome.tif", sections[None].cpu(), grid.spacing[1:], steps[0] if steps else None)
    return Result(delta, found)
