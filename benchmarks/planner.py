"""What planning gains, and what it costs itself.

    python benchmarks/planner.py

For scenes up the ladder: the plan's choice, its predicted and realised error against the converged wave, seconds of
REFERENCE, of the plan's run (predicted too) and of planning, float32.
"""

import math
import time
import warnings
from collections.abc import Callable

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
    Prism,
    ToleranceWarning,
    Volume,
    image,
    plan,
)
from torchdic.image_error import image_error
from torchdic.plan import describe

GRID = Grid((20, 96, 96), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4))
PRISMS = [Prism((0.0, 0.2), math.pi / 2), Prism((0.2, 0.0), -math.pi / 2)]
ACQUISITION = Acquisition(PRISMS, [-2.0, -1.0, 0.0, 1.0, 2.0])
TOLERANCE = 0.03
PADDING = 32


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore", ToleranceWarning)
    layered = 0.02 * torch.sin(GRID.coordinates(0))[:, None, None].expand(GRID.shape)
    scenes = {
        "empty": (torch.zeros(GRID.shape), 1.36),
        "layered": (layered, 1.36),
        "weak smooth ball": (GaussianBall(1.2, 0.002, 1.36).delta(GRID), 1.36),
        "smooth ball": (GaussianBall(1.2, 0.03, 1.36).delta(GRID), 1.36),
        "weak bead": (Bead(2.0, 0.005, 1.56).delta(GRID), 1.56),
        "cell": (CellPhantom().delta(GRID), 1.335),
    }
    print("| scene | chosen | predicted | realised | REFERENCE s | run s (predicted) | planning s |")
    print("|---" * 7 + "|")
    for name, (delta, background) in scenes.items():
        _row(name, delta.float(), background, padding=0 if name == "layered" else PADDING)


@torch.no_grad()
def _row(name: str, delta: Tensor, background: float, padding: int) -> None:
    volume = Volume(GRID, delta, background)
    made = plan(volume, MICROSCOPE, ACQUISITION, TOLERANCE)

    def seen(fidelity: Fidelity) -> Tensor:
        return image(volume, MICROSCOPE, ACQUISITION, fidelity)

    reference = _seconds(lambda: seen(REFERENCE))
    run = _seconds(lambda: seen(made.fidelity))
    sources = max(128, 2 * made.fidelity.sources)
    truth = seen(Fidelity("wave", steps=2 * GRID.shape[0], sources=sources, padding=padding))
    error = image_error(seen(made.fidelity), truth)
    print(
        f"| {name} | {describe(made.fidelity)} | {made.error:.2g} | {error:.2g} | {reference:.2f} | "
        f"{run:.3f} ({made.seconds:.3f}) | {made.planning:.2f} |",
        flush=True,
    )


def _seconds(run: Callable[[], Tensor]) -> float:
    started = time.perf_counter()
    run()
    return time.perf_counter() - started


if __name__ == "__main__":
    main()
