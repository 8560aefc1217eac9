"""A field fitted in tiles beside the same field fitted whole: how far apart they are, at the seams too, and the cost.

    OMP_NUM_THREADS=1 python benchmarks/tiles.py [--out tiles] [--scenes NAME ...]

Images come from a finer model than the fits', with noise (`scenes.py`). Each field has specimens on its seams. "apart"
is the distance of the two volumes over the whole fit's length, "at seams" the same of the voxels in which two tiles are
blended; "error" is that of each from the truth. "jump" is the mean |step| of Δn from one voxel to the next across the
seams' middles over the same of the whole fit. Seconds are of the processor, and memory is what a descent is foreseen to
hold.
"""

import argparse
import math
import time
import warnings
from collections import deque
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from jaxtyping import Bool, Float
from torch import Tensor

import scenes
from data_synthetic import Bead, CellPhantom, Ellipsoid
from recon.descend import Problem, Recipe, minimise
from recon.fit.bounds import Bounds
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.cut_field import margin_beyond
from recon.report.metrics import volume_error
from recon.run.reconstruct import RECOMMENDED
from recon.run.room import bytes_held
from recon.run.tiles.sizes import OVERLAP
from recon.tiling.blending import blended_volume
from recon.tiling.layout import Layout
from recon.tiling.part import SharedByTiles, problem_of_tile, strongest_first
from specimens import GradedEllipsoid, Together
from torchdic import Grid

FIELD = Grid((12, 144, 144), (0.4, 0.17, 0.17))
FOCUS = tuple(0.6 * (i - 3.5) for i in range(8))
SIDE = 92


def beads() -> Together:
    """Beads of several sizes and contrasts, two of them on the seams."""
    generator = torch.Generator().manual_seed(8)
    places = [
        (-8.5, -8.7),
        (-9.0, 0.2),
        (-8.3, 8.6),
        (0.1, -8.4),
        (0.3, 0.4),
        (-0.6, 8.9),
        (8.7, -8.5),
        (8.9, 0.7),
        (8.2, 9.0),
    ]
    found = []
    for y, x in places:
        z, radius, contrast = torch.rand(3, generator=generator).tolist()
        found.append(Bead(0.8 + 0.6 * radius, 0.008 + 0.014 * contrast, 1.36, (1.6 * z - 0.8, y, x)))
    return Together(tuple(found))


def graded() -> Together:
    """Smooth lumps above and below the medium's index, whose sign nobody knows."""
    shapes = [
        ((-5.5, -5.0), 0.012),
        ((0.3, -4.0), -0.009),
        ((-4.0, 4.5), -0.012),
        ((4.5, 4.6), 0.010),
        ((5.5, -3.5), 0.008),
    ]
    return Together(
        tuple(
            GradedEllipsoid(Ellipsoid((1.4, 2.0, 2.4), (0.2 * i - 0.4, y, x)), contrast, 1.36)
            for i, ((y, x), contrast) in enumerate(shapes)
        )
    )


def setups() -> dict[str, scenes.Setup]:
    """The scenes by name."""
    acquisition = scenes.acquisition(scenes.SHEARS, (math.pi / 2,), FOCUS)
    usual = scenes.Setup("tiles", beads(), FIELD, acquisition=acquisition, photons=20000.0)
    return {
        "beads": usual,
        "dim beads": replace(usual, photons=4000.0, seed=1),
        "cell": replace(usual, specimen=CellPhantom(), seed=2),
        "lumps of any sign": replace(usual, specimen=graded(), bounds=(None, None), seed=3),
    }


@dataclass(frozen=True, eq=False)
class Fit:
    """A volume (z, y, x), the processor's seconds, and the bytes that its descent is foreseen to hold."""

    delta: Float[Tensor, "z y x"]
    seconds: float
    bytes: int


def solved(problem: Problem) -> tuple[Step, float]:
    """The last step of a problem's descent, and the processor's seconds."""
    began = time.process_time()
    last = deque(minimise(problem), maxlen=1).pop()
    return last, time.process_time() - began


def fitted_whole(problem: Problem) -> Fit:
    """The field in one fit."""
    last, seconds = solved(problem)
    return Fit(last.delta, seconds, bytes_held(problem, GaussianMisfit))


def fitted_in_tiles(problem: Problem, layout: Layout, noise: tuple[float, ...]) -> Fit:
    """The field in tiles."""
    shared, found, total, largest = None, [], 0.0, 0
    for tile in strongest_first(layout, problem.misfit):
        part = problem_of_tile(problem, layout, tile, noise, shared)
        last, seconds = solved(part)
        if shared is None:
            shared, largest = SharedByTiles.by(part, last), bytes_held(part, GaussianMisfit)
        found.append((tile, last.delta))
        total += seconds
    return Fit(blended_volume(layout, FIELD.shape[0], found), total, largest)


def seams(layout: Layout) -> Bool[Tensor, "y x"]:
    """Where two tiles are blended."""
    y, x = ((axis.weights_of_voxels().max(0).values < 1) for axis in (layout.along_y, layout.along_x))
    return y[:, None] | x


def jump(delta: Float[Tensor, "z y x"], layout: Layout) -> float:
    """Mean |step| of Δn across the middles of the seams."""
    steps = []
    for axis, cut in ((1, layout.along_y), (2, layout.along_x)):
        for before, after in zip(cut.spans, cut.spans[1:], strict=False):
            middle = (before.voxels.stop + after.voxels.start) // 2
            steps.append(delta.diff(dim=axis).narrow(axis, middle - 1, 1).abs().mean())
    return float(torch.stack(steps).mean())


def draw(name: str, whole: Fit, tiles: Fit, layout: Layout, path: Path) -> None:
    """A section through both volumes and ten times their difference, with the seams' middles."""
    middle = FIELD.shape[0] // 2
    most = float(whole.delta[middle].abs().max())
    pictures = {"whole": whole.delta, "in tiles": tiles.delta, "10 × difference": 10 * (tiles.delta - whole.delta)}
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
    for axis, (title, delta) in zip(axes, pictures.items(), strict=True):
        axis.imshow(delta[middle].numpy(), cmap="RdBu_r", vmin=-most, vmax=most)
        axis.set(title=title, xticks=[], yticks=[])
        for cut, line in ((layout.along_y, axis.axhline), (layout.along_x, axis.axvline)):
            for before, after in zip(cut.spans, cut.spans[1:], strict=False):
                line((before.voxels.stop + after.voxels.start) / 2 - 0.5, color="0.5", linewidth=0.6, linestyle="--")
    figure.colorbar(axes[0].images[0], ax=axes, label="Δn")
    figure.suptitle(f"{name}: a section at mid depth; dashed: the seams")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Fit each scene both ways and print a row for it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("tiles"))
    parser.add_argument("--scenes", nargs="+", choices=list(setups()), default=list(setups()))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    margin = margin_beyond(FIELD, scenes.MICROSCOPE, 1.36)
    layout = Layout.of(FIELD, FIELD, SIDE, margin, OVERLAP * margin)
    print(f"{len(layout)} tiles of {SIDE} voxels, margin {margin}, overlap {OVERLAP * margin} of {FIELD.shape}\n")
    print(
        "| scene | apart | at seams | error whole | in tiles | jump | seconds whole | in tiles | MiB whole | a tile |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in options.scenes:
        scene = setups()[name].scene(name, options.out / "cache")
        setup = Setup(empty_medium(FIELD, scene.background, scene.data), scene.microscope, scene.acquisition)
        recipe = Recipe(bounds=Bounds(*scene.bounds))
        problem = Problem.from_recipe(scene.data, setup, RECOMMENDED, recipe, GaussianMisfit, scene.noise)
        whole, tiles = fitted_whole(problem), fitted_in_tiles(problem, layout, scene.noise)
        at = seams(layout)
        columns = [
            f"{volume_error(tiles.delta, whole.delta):.3f}",
            f"{volume_error(tiles.delta[:, at], whole.delta[:, at]):.3f}",
            *(f"{volume_error(fit.delta, scene.truth):.3f}" for fit in (whole, tiles)),
            f"{jump(tiles.delta, layout) / jump(whole.delta, layout):.2f}",
            *(f"{fit.seconds:.0f}" for fit in (whole, tiles)),
            *(f"{fit.bytes / 2**20:.0f}" for fit in (whole, tiles)),
        ]
        print(f"| {name} | {' | '.join(columns)} |", flush=True)
        draw(name, whole, tiles, layout, options.out / f"{name.replace(' ', '_')}.png")


if __name__ == "__main__":
    main()
