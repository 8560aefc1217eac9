"""What planning gains, and what it costs.

    OMP_NUM_THREADS=1 python benchmarks/planner.py

The scenes run from simple to demanding, and some are drawn at random. For each the table shows the plan's choice, its
predicted error, and the realised error against the converged wave. It also shows the process seconds of REFERENCE, of
the plan's run (measured and predicted) and of planning, in float32, the least of two. Planning may take one second, or
a fifth of the run that it plans.
"""

import math
import random
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from data_synthetic import Bead, CellPhantom, GaussianBall
from torchdic import (
    REFERENCE,
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Spectrum,
    ToleranceWarning,
    Volume,
    image,
    plan,
)
from torchdic.planning.image_error import image_error
from torchdic.planning.plan import describe

GRID = Grid((20, 96, 96), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4))
PRISMS = [Prism((0.0, 0.2), math.pi / 2), Prism((0.2, 0.0), -math.pi / 2)]
ACQUISITION = Acquisition(PRISMS, [-2.0, -1.0, 0.0, 1.0, 2.0])
SEED, DRAWN = 7, 5
T = TypeVar("T")
COLUMNS = (
    "scene",
    "tolerance",
    "chosen",
    "predicted",
    "realised",
    "predicted / realised",
    "REFERENCE s",
    "run s (predicted)",
    "REFERENCE / run",
    "planning s",
    "within its limit",
)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene to plan.

    padding: how far the truth's sides are moved away; 0 if the specimen reaches them.
    """

    volume: Volume
    tolerance: float = 0.03
    microscope: Microscope = MICROSCOPE
    acquisition: Acquisition = ACQUISITION
    padding: int = 32


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore", ToleranceWarning)
    print("| " + " | ".join(COLUMNS) + " |")
    print("|---" * len(COLUMNS) + "|")
    for name, scene in scenes().items():
        _row(name, scene)


def scenes() -> dict[str, Scene]:
    """Scenes from an empty one to those that need everything, then some drawn at random."""
    y, x = (GRID.coordinates(axis) for axis in (1, 2))
    layered = 0.02 * torch.sin(GRID.coordinates(0))[:, None, None].expand(GRID.shape)
    rod = (0.02 * torch.exp(-(y[:, None] ** 2 + x**2) / 2 / 2.0**2)).expand(GRID.shape)
    cell = CellPhantom().delta(GRID)
    polarised = replace(MICROSCOPE, polarisation=Polarisation(analyser_extinction=0.01, analyser_error=0.1))
    ring = replace(MICROSCOPE, condenser=Condenser(0.5, inner_na=0.4))
    named = {
        "empty": Scene(_volume(torch.zeros(GRID.shape), 1.36)),
        "layered": Scene(_volume(layered, 1.36), padding=0),
        "weak smooth ball": Scene(_volume(GaussianBall(1.2, 0.002, 1.36).delta(GRID), 1.36)),
        "smooth ball": Scene(_volume(GaussianBall(1.2, 0.03, 1.36).delta(GRID), 1.36)),
        "smooth ball, coherent": Scene(
            _volume(GaussianBall(1.2, 0.03, 1.36).delta(GRID), 1.36), microscope=replace(MICROSCOPE, condenser=None)
        ),
        "smooth ball, polarisers that leak": Scene(
            _volume(GaussianBall(1.2, 0.03, 1.36).delta(GRID), 1.36), microscope=polarised
        ),
        "smooth ball, ring of light, loose": Scene(
            _volume(GaussianBall(1.2, 0.03, 1.36).delta(GRID), 1.36), 0.1, microscope=ring
        ),
        "smooth ball, light beyond the pupil, loose": Scene(
            _volume(GaussianBall(1.2, 0.03, 1.36).delta(GRID), 1.36),
            0.2,
            Microscope(0.546, Objective(0.5), Condenser(0.7)),
        ),
        "thick graded index": Scene(_volume(rod, 1.36), padding=0),
        "weak bead": Scene(_volume(Bead(2.0, 0.005, 1.56).delta(GRID), 1.56)),
        "strong bead, loose": Scene(_volume(Bead(2.0, 0.08, 1.36).delta(GRID), 1.36), 0.1),
        "cell": Scene(_volume(cell, 1.335)),
        "cell in nine colours": Scene(
            _volume(cell, 1.335),
            microscope=replace(MICROSCOPE, spectrum=Spectrum([0.47 + 0.02 * n for n in range(9)])),
        ),
        "absorbing cell": Scene(_volume(cell, 1.335, 0.1 * cell.clamp_min(0))),
    }
    draw = random.Random(SEED)
    return named | {f"drawn {n + 1}": _drawn(draw) for n in range(DRAWN)}


def _drawn(draw: random.Random) -> Scene:
    na = draw.uniform(0.4, 0.75)
    microscope = Microscope(0.546, Objective(na), Condenser(draw.uniform(0.1, 0.7) * na))
    shear = draw.uniform(-0.2, 0.2), draw.uniform(0.1, 0.2)
    acquisition = Acquisition([Prism(shear, draw.uniform(0.5, 2.5))], [0.0, draw.uniform(-3.0, 3.0)])
    contrast = draw.choice([-1, 1]) * 10 ** draw.uniform(-3.0, -1.4)
    ball = GaussianBall(draw.uniform(0.5, 1.5), contrast, 1.36)
    return Scene(_volume(ball.delta(GRID), 1.36), draw.choice([0.02, 0.05]), microscope, acquisition)


def _volume(delta: Tensor, background: float, absorption: Tensor | None = None) -> Volume:
    return Volume(GRID, delta.float(), background, absorption)


@torch.no_grad()
def _row(name: str, scene: Scene) -> None:
    def seen(fidelity: Fidelity) -> Tensor:
        return image(scene.volume, scene.microscope, scene.acquisition, fidelity)

    made, planning = _timed(lambda: plan(scene.volume, scene.microscope, scene.acquisition, scene.tolerance))
    images, run = _timed(lambda: seen(made.fidelity))
    _, reference = _timed(lambda: seen(REFERENCE))
    steps = max(2 * GRID.shape[0], 2 * (made.fidelity.steps or 0))
    sources = max(128, 2 * made.fidelity.sources)
    truth = seen(Fidelity("wave", steps=steps, sources=sources, padding=scene.padding))
    error = image_error(images, truth)
    met = "yes" if planning < max(1.0, run / 5) else "no"
    print(
        f"| {name} | {scene.tolerance:g} | {describe(made.fidelity)} | {made.error:.2g} | {error:.2g} | "
        f"{made.error / error:.2f} | {reference:.2f} | {run:.3f} ({made.seconds:.3f}) | {reference / run:.0f} | "
        f"{planning:.2f} | {met} |",
        flush=True,
    )


def _timed(run: Callable[[], T]) -> tuple[T, float]:
    """The function's result, and its process seconds, the least of two."""

    def once() -> tuple[T, float]:
        started = time.process_time()
        return run(), time.process_time() - started

    return min((once(), once()), key=lambda timed: timed[1])


if __name__ == "__main__":
    main()
