"""One stack, reconstructed with each propagation: what accuracy costs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from recon.fit.descent import Recipe, descend
from recon.report import figures
from recon.report.metrics import mean_inside, volume_error
from torchdic import Acquisition, Fidelity, Grid, Microscope
from torchdic.files.stack import write_volume
from torchdic.files.whole import write_json


@dataclass(frozen=True)
class Trial:
    """One reconstruction: its propagation, relative L2 volume error, mean Δn inside the truth, misfit and seconds."""

    propagation: str
    volume_error: float
    mean_delta: float
    misfit: float
    seconds: float


def compare(
    data: Float[Tensor, "prism focus y x"],
    truth: Float[Tensor, "z y x"],
    inside: Bool[Tensor, "z y x"],
    grid: Grid,
    background: float,
    microscope: Microscope,
    acquisition: Acquisition,
    contenders: Sequence[tuple[Fidelity, Recipe]],
    out: Path,
) -> list[Trial]:
    """Reconstruct with each contender; leaves each volume, comparison.png and comparison.json in `out`."""
    volumes, trials = {"truth": truth}, []
    for fidelity, recipe in contenders:
        name = fidelity.propagation
        steps = descend(data, grid, background, microscope, acquisition, fidelity, recipe)
        *_, step = tqdm(steps, desc=f"{name:>10}", total=recipe.steps, unit="step")
        delta = step.delta.cpu()
        trials.append(
            Trial(
                name,
                volume_error(delta, truth),
                mean_inside(delta, inside),
                step.misfit,
                round(step.seconds, 2),
            )
        )
        volumes[name] = delta
        write_volume(out / f"{name}.ome.tif", delta, grid)
    figures.save(figures.draw_sections(volumes, grid, ("xy", "xz")), out / "comparison.png")
    write_json(out / "comparison.json", [asdict(trial) for trial in trials])
    return trials


def table(trials: Sequence[Trial], truth_mean: float) -> str:
    """The trials as text, a row each."""
    lines = [f"{'propagation':<12}{'volume error':>14}{'mean Δn':>10}{'misfit':>10}{'seconds':>10}"]
    lines += [
        f"{t.propagation:<12}{t.volume_error:>14.3f}{t.mean_delta:>10.4f}{t.misfit:>10.4f}{t.seconds:>10.1f}"
        for t in trials
    ]
    lines.append(f"{'truth':<12}{0:>14.3f}{truth_mean:>10.4f}")
    return "\n".join(lines)
