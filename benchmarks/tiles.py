"""A field fitted in tiles beside the same field fitted whole: how far apart they are, at the seams too, and the cost.

    OMP_NUM_THREADS=1 python benchmarks/tiles.py [--out tiles] [--scenes NAME ...] [--pixels 288] [--across 2]

Images come from a finer model than the fits', with noise (`scenes.py`). Each field has specimens on its seams. "apart"
is the distance of the two volumes over the whole fit's length, "at seams" the same of the voxels in which two tiles are
blended; "error" is that of each from the truth. "jump" is the mean |step| of Δn from one voxel to the next across the
seams' middles over the same of the whole fit. "weight" is that of the tiles' priors over that of the whole fit's.
Seconds are of the processor, and memory is what a descent is foreseen to hold.
"""

import argparse
import math
import time
import warnings
from collections import deque
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from io import StringIO
from itertools import product
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from jaxtyping import Bool, Float
from torch import Tensor

import scenes
from data_synthetic import Bead, CellPhantom, Ellipsoid, Specimen
from recon.descend import Problem, Recipe, minimise
from recon.fit.bounds import Bounds
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.cut_field import margin_beyond
from recon.report.metrics import volume_error
from recon.run.folder.prepared import prepare_folder
from recon.run.reconstruct import RECOMMENDED
from recon.run.room import bytes_held
from recon.run.tiles.fitting import TiledFit
from recon.run.tiles.kept import forget
from recon.run.tiles.sizes import OVERLAP
from recon.tiling.layout import Layout
from recon.tiling.leaders import strongest_first
from specimens import GradedEllipsoid, Together, moved
from torchdic import Grid

VOXEL = (0.4, 0.17, 0.17)
SLICES = 12
FOCUS = tuple(0.6 * (i - 3.5) for i in range(8))

# Pixels of the tiles' overlap, and µm from the field's border within which no specimen has its centre.
SHARED, BORDER = 40, 2.5


def field_of(pixels: int) -> Grid:
    """The field of so many pixels along a side."""
    return Grid((SLICES, pixels, pixels), VOXEL)


def within(field: Grid, placed: list[tuple[Specimen, tuple[float, float]]]) -> Together:
    """Those specimens, given with their places (y, x), that lie within a field."""
    far = field.extent[1] / 2 - BORDER
    return Together(tuple(specimen for specimen, (y, x) in placed if max(abs(y), abs(x)) < far))


def beads(field: Grid) -> Together:
    """Beads of several sizes and contrasts, in rows of which the middle ones lie on the seams."""
    generator, found = torch.Generator().manual_seed(8), []
    for row, column in product(range(-2, 3), repeat=2):
        z, y, x, radius, contrast = torch.rand(5, generator=generator).tolist()
        place = (1.6 * z - 0.8, 9 * row + 1.8 * y - 0.9, 9 * column + 1.8 * x - 0.9)
        found.append((Bead(0.8 + 0.6 * radius, 0.008 + 0.014 * contrast, 1.36, place), place[1:]))
    return within(field, found)


def lumps(field: Grid) -> Together:
    """Smooth lumps above and below the medium's index, whose sign nobody knows."""
    generator, found = torch.Generator().manual_seed(5), []
    for row, column in product(range(4), range(5)):
        z, y, x, a, b, c, contrast, sign = torch.rand(8, generator=generator).tolist()
        place = (1.2 * z - 0.6, 10 * row - 17 + 4 * y, 9.5 * column - 21 + 4 * x)
        shape = Ellipsoid((1.0 + 0.6 * a, 1.6 + 1.2 * b, 1.6 + 1.2 * c), place)
        contrast = (0.006 + 0.007 * contrast) * (1 if sign < 0.5 else -1)
        found.append((GradedEllipsoid(shape, contrast, 1.36), place[1:]))
    return within(field, found)


def cells(field: Grid) -> Together:
    """A cell where four tiles meet, one on the seam of two, and others in each tile."""
    places = [(0.0, 0.0), (-11.0, 1.0), (-12.0, -13.0), (10.0, -9.5), (9.0, 12.0), (-10.0, 14.0)]
    return within(field, [(moved(CellPhantom(), (0.0, *place)), place) for place in places])


def setups(field: Grid) -> dict[str, scenes.Setup]:
    """The scenes by name."""
    acquisition = scenes.acquisition(scenes.SHEARS, (math.pi / 2,), FOCUS)
    usual = scenes.Setup("tiles", beads(field), field, acquisition=acquisition, photons=20000.0)
    return {
        "beads": usual,
        "dim beads": replace(usual, photons=4000.0, seed=1),
        "cells": replace(usual, specimen=cells(field), seed=2),
        "lumps of any sign": replace(usual, specimen=lumps(field), bounds=(None, None), seed=3),
    }


@dataclass(frozen=True, eq=False)
class Fit:
    """A volume (z, y, x), the weight of its priors, seconds, and the bytes that its descent is foreseen to hold.

    weight: per pixel, over the same scale of the misfit in the whole field and in its tiles. seconds: the processor's.
    """

    delta: Float[Tensor, "z y x"]
    weight: float
    seconds: float
    bytes: int


def solved(problem: Problem) -> tuple[Step, float]:
    """The last step of a problem's descent, and the processor's seconds."""
    began = time.process_time()
    last = deque(minimise(problem), maxlen=1).pop()
    return last, time.process_time() - began


def weight_of(problem: Problem, last: Step) -> float:
    """The weight of a fit's priors per pixel, with its misfit in the unit of the images."""
    return last.weights[-1]["tv"] * float(problem.misfit.variance.mean()) / problem.setup.dilution


def fitted_whole(problem: Problem) -> Fit:
    """The field in one fit."""
    last, seconds = solved(problem)
    return Fit(last.delta, weight_of(problem, last), seconds, bytes_held(problem, GaussianMisfit))


def fitted_in_tiles(problem: Problem, layout: Layout, noise: tuple[float, ...], out: Path) -> Fit:
    """The field in tiles, which are kept in a folder until they are all fitted."""
    began, folder = time.process_time(), out / "kept"
    fit = TiledFit(problem, layout, tuple(strongest_first(layout, problem.misfit)), noise, folder, "", problem.steps)
    prepare_folder(folder)
    forget(folder)  # of a run that was stopped
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):  # bars and lines of each tile
        tiled = fit.fitted()
    first, last = tiled.first, tiled.ended.step
    forget(folder)
    seconds = time.process_time() - began
    return Fit(last.delta, weight_of(first, last), seconds, bytes_held(first, GaussianMisfit))


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
    middle = SLICES // 2
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


def row(name: str, scene: scenes.Scene, layout: Layout, out: Path, steps: int | None) -> str:
    """Fit a scene both ways, in so many steps at most, draw it, and return its row."""
    setup = Setup(empty_medium(scene.grid, scene.background, scene.data), scene.microscope, scene.acquisition)
    recipe = Recipe(steps=steps, bounds=Bounds(*scene.bounds))
    problem = Problem.from_recipe(scene.data, setup, RECOMMENDED, recipe, GaussianMisfit, scene.noise)
    whole, tiles = fitted_whole(problem), fitted_in_tiles(problem, layout, scene.noise, out)
    draw(name, whole, tiles, layout, out / f"{name.replace(' ', '_')}.png")
    at = seams(layout)
    columns = [
        f"{volume_error(tiles.delta, whole.delta):.3f}",
        f"{volume_error(tiles.delta[:, at], whole.delta[:, at]):.3f}",
        *(f"{volume_error(fit.delta, scene.truth):.3f}" for fit in (whole, tiles)),
        f"{jump(tiles.delta, layout) / jump(whole.delta, layout):.2f}",
        f"{tiles.weight / whole.weight:.2f}",
        *(f"{fit.seconds:.0f}" for fit in (whole, tiles)),
        *(f"{fit.bytes / 2**20:.0f}" for fit in (whole, tiles)),
    ]
    return f"| {name} | {' | '.join(columns)} |"


HEAD = """
| scene | apart | at seams | error whole | in tiles | jump | weight | seconds whole | in tiles | MiB whole | a tile |
|---|---|---|---|---|---|---|---|---|---|---|"""


def main() -> None:
    """Fit each scene both ways and print a row for it."""
    names = list(setups(field_of(144)))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("tiles"))
    parser.add_argument("--scenes", nargs="+", choices=names, default=names)
    parser.add_argument("--pixels", type=int, default=288, help="of the field along a side")
    parser.add_argument("--across", type=int, default=2, help="tiles along a side")
    parser.add_argument("--steps", type=int, help="of each fit at most")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore")
    field = field_of(options.pixels)
    margin = margin_beyond(field, scenes.MICROSCOPE, 1.36)
    side = (options.pixels + (options.across - 1) * SHARED) // options.across
    layout = Layout.of(field, field, side, margin, OVERLAP * margin)
    print(f"{len(layout)} tiles of {side} voxels, margin {margin}, overlap {SHARED} of {field.shape}\n{HEAD}")
    for name in options.scenes:
        scene = setups(field)[name].scene(name, options.out / "cache")
        print(row(name, scene, layout, options.out, options.steps), flush=True)


if __name__ == "__main__":
    main()
