"""One stack, reconstructed by several propagations and held against the truth: what accuracy costs."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from recon.fit.descent import descend
from recon.fit.problem import Recipe
from recon.fit.step import Step
from recon.report import figures
from recon.report.metrics import mean_inside, volume_error
from torchdic import Acquisition, Fidelity, Grid, Microscope
from torchdic.files.stack import write_volume
from torchdic.files.whole import write_json


@dataclass(frozen=True, eq=False)
class Truth:
    """The specimen that a reconstruction should find.

    grid: its voxels.
    delta: its Δn (z, y, x).
    background: index of its medium.
    inside: the voxels (z, y, x) that lie wholly inside it.
    """

    grid: Grid
    delta: Float[Tensor, "z y x"]
    background: float
    inside: Bool[Tensor, "z y x"]


@dataclass(frozen=True)
class Score:
    """How near one reconstruction came to the truth, and how long it took.

    propagation: by which the stack was reconstructed.
    volume_error: relative L2 error of Δn.
    mean_delta: mean Δn over the voxels inside the true specimen.
    misfit: of the images, before the last step.
    seconds: of the whole reconstruction.
    """

    propagation: str
    volume_error: float
    mean_delta: float
    misfit: float
    seconds: float


def compare(
    data: Float[Tensor, "prism focus y x"],
    truth: Truth,
    microscope: Microscope,
    acquisition: Acquisition,
    contenders: Sequence[tuple[Fidelity, Recipe]],
    out: Path,
) -> list[Score]:
    """Reconstruct a stack by each contender; leaves the volumes, comparison.png and comparison.json in a folder.

    The true volume is among them.

    data: the stack, relative to the empty bright field.
    truth: the specimen that the stack shows.
    microscope, acquisition: how the stack was recorded.
    contenders: a fidelity and a recipe for each reconstruction.
    out: the folder.
    """
    volumes, scores = {"truth": truth.delta}, []
    for fidelity, recipe in contenders:
        name = fidelity.propagation
        steps = descend(data, truth.grid, truth.background, microscope, acquisition, fidelity, recipe)
        *_, last = tqdm(steps, desc=f"{name:>10}", total=recipe.most_steps, unit="step")
        volumes[name] = last.delta.cpu()
        scores.append(_score(name, last, truth))
        write_volume(out / f"{name}.ome.tif", volumes[name], truth.grid)
    _write(volumes, scores, truth.grid, out)
    return scores


def _score(propagation: str, last: Step, truth: Truth) -> Score:
    delta = last.delta.cpu()
    error, mean = volume_error(delta, truth.delta), mean_inside(delta, truth.inside)
    return Score(propagation, error, mean, last.misfit, round(last.seconds, 2))


def _write(volumes: Mapping[str, Tensor], scores: Sequence[Score], grid: Grid, out: Path) -> None:
    figures.save(figures.draw_sections(volumes, grid, ("xy", "xz")), out / "comparison.png")
    write_volume(out / "truth.ome.tif", volumes["truth"], grid, name="delta n, true")
    write_json(out / "comparison.json", [asdict(score) for score in scores])


def table(scores: Sequence[Score], truth_mean: float) -> str:
    """The scores as text, a row each, and below them the truth with its mean Δn."""
    lines = [f"{'propagation':<12}{'volume error':>14}{'mean Δn':>10}{'misfit':>10}{'seconds':>10}"]
    lines += [
        f"{s.propagation:<12}{s.volume_error:>14.3f}{s.mean_delta:>10.4f}{s.misfit:>10.4f}{s.seconds:>10.1f}"
        for s in scores
    ]
    lines.append(f"{'truth':<12}{0:>14.3f}{truth_mean:>10.4f}")
    return "\n".join(lines)
