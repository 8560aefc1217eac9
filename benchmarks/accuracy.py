"""What accuracy costs on five scenes: fronts of error against seconds, as tables and two figures.

    python benchmarks/accuracy.py [--out docs] [--scenes NAME ...] [--repeats 3]

Objective NA 0.9, condenser NA 0.7, 546 nm, shear 0.24 µm along x, bias π/2, float32 unless a candidate says otherwise.
The truth is an exact field if there is one, otherwise the converged wave. Errors are defined in
`torchdic.planning.work_precision`. The candidates are those of its ladder, and the presets.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

from data_synthetic import Bead, CellPhantom, GaussianBall
from data_synthetic.specimen import Specimen
from recon.report import figures
from recon.report.fronts import as_table, draw_fronts
from recon.run.exact_images import ExactSpecimen, exact_images
from torchdic import (
    DRAFT,
    REFERENCE,
    STANDARD,
    Acquisition,
    Candidate,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    Trial,
    Volume,
)
from torchdic.planning.work_precision import ladder, trials

MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7))
PRISM = Prism((0.0, 0.24), 1.5708)
PRESETS = {"DRAFT": DRAFT, "STANDARD": STANDARD, "REFERENCE": REFERENCE}


@dataclass(frozen=True)
class Scene:
    """A specimen in a medium, its voxels, and focus planes in µm. A specimen of None is an empty volume.

    finest: slabs per slice in the converged wave.
    """

    specimen: Specimen | None
    background: float
    grid: Grid
    focus: tuple[float, ...]
    finest: int = 2

    def volume(self) -> Volume:
        """The specimen on its voxels, float32."""
        if self.specimen is None:
            return Volume(self.grid, torch.zeros(self.grid.shape), self.background)
        return Volume(self.grid, self.specimen.delta(self.grid, dtype=torch.float32), self.background)

    @property
    def acquisition(self) -> Acquisition:
        """The one prism, at each focus plane."""
        return Acquisition([PRISM], self.focus)


SCENES = {
    "empty": Scene(None, 1.36, Grid((16, 64, 64), (0.4, 0.17, 0.17)), (-2.0, 0.0, 2.0)),
    "thin weak bead": Scene(Bead(1.0, 0.01, 1.36), 1.36, Grid((12, 64, 64), (0.2, 0.17, 0.17)), (-1.0, 0.0, 1.0)),
    "cell": Scene(CellPhantom(), 1.335, Grid((16, 64, 64), (0.4, 0.17, 0.17)), (-2.0, 0.0, 2.0)),
    "thick graded index": Scene(
        GaussianBall(1.6, 0.06, 1.36), 1.36, Grid((24, 64, 64), (0.5, 0.17, 0.17)), (-2.0, 0.0, 2.0)
    ),
    "sharp strong bead": Scene(
        Bead(1.5, 0.1, 1.36), 1.36, Grid((32, 64, 64), (0.125, 0.17, 0.17)), (-2.0, 0.0, 2.0), 4
    ),
}


def candidates(grid: Grid) -> list[Candidate]:
    """The presets, and the ladder's other rungs."""
    named = [Candidate(fidelity, name=name) for name, fidelity in PRESETS.items()]
    return named + [rung for rung in ladder(grid) if rung.dtype or rung.fidelity not in PRESETS.values()]


def measure(scene: Scene, repeats: int, tried: list[Candidate]) -> Iterator[Trial]:
    """Trials of the candidates on a scene, one by one."""
    # few steps for rays, and float32: even so the converged answers err by far less than the trials
    slices, margin = scene.grid.shape[0], REFERENCE.padding
    references: dict[str, Fidelity] = {
        "projection": Fidelity("projection", sources=200, padding=margin),
        "rays": Fidelity("rays", slices // 2, 48, padding=margin // 2),
        "wave": Fidelity("wave", scene.finest * slices, 200, padding=margin),
    }
    exact = None
    if isinstance(scene.specimen, ExactSpecimen):
        exact = exact_images(scene.specimen, scene.grid, MICROSCOPE, scene.acquisition, references["wave"])
    return trials(
        scene.volume(),
        MICROSCOPE,
        scene.acquisition,
        tried,
        {name: Candidate(fidelity, "float32") for name, fidelity in references.items()},
        exact=exact,
        repeats=repeats,
    )


def main() -> None:
    """Print a table for each scene, and draw the fronts."""
    parser = argparse.ArgumentParser(description="What accuracy costs on five scenes.")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    parser.add_argument("--scenes", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    found = {}
    for name in options.scenes:
        scene = SCENES[name]
        tried = candidates(scene.grid)
        steps = measure(scene, options.repeats, tried)
        found[name] = list(tqdm(steps, desc=name, total=len(tried)))
        print(f"\n{name}: {'×'.join(map(str, scene.grid.shape))} voxels\n\n{as_table(found[name])}", flush=True)
    for quantity in ("image", "gradient"):
        figures.save(draw_fronts(found, [quantity]), options.out / f"accuracy_{quantity}.png")


if __name__ == "__main__":
    main()
