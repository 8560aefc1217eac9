"""The scenes by which the reconstruction is judged: stacks of known specimens that no model which fits them has made.

    python benchmarks/scenes.py [--out scenes] [--cache DIR] [--scenes NAME ...] [--drawn N]

It draws each scene's sections and its images into a folder, and prints a table. "noise misfit" is the misfit that noise
alone leaves (`recon.misfit`).

Where a specimen's exact field is known, it makes the images. The others come from a finer model: voxels of a third of
the depth and half of the width, 112 condenser directions on other rings than the 18, 24 or 40 of a reconstruction, and
second order. All images are those of pixels that integrate, each the mean of 2 × 2 finer ones, in a field that is wider
than the recorded one, so that no light comes back in at the opposite side; the demo's are the demo's own. Poisson noise
is drawn from a fixed seed.
"""

import argparse
import hashlib
import math
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_synthetic import Bead, CellPhantom, Ellipsoid, GaussianBall, Organelle, Specimen
from recon.cli import demo
from recon.misfit.gaussian import GaussianMisfit
from recon.report import figures
from recon.run.fits.finer import FinerModel
from specimens import Fibre, GradedEllipsoid, Together, any_specimen, solid, stronger
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Grid,
    Microscope,
    Objective,
    Prism,
    __version__,
)
from torchdic.files.whole import written_whole

Bounds = tuple[float | None, float | None]

GRID = Grid((20, 64, 64), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7))
SHEARS = ((0.0, 0.24), (0.24, 0.0))
FOCUS = tuple(float(z) for z in range(-4, 5))
SOURCES = 112


@dataclass(frozen=True, eq=False)
class Scene:
    """A recorded stack and the specimen behind it.

    name, kind: of the scene, and of the group that it belongs to.
    data: (prism, focus, y, x), float32, relative to the empty bright field.
    truth: Δn (z, y, x), float32, on the reconstruction's grid; each voxel holds the mean over its volume.
    grid, background: of the reconstruction.
    microscope, acquisition: with which the data were recorded.
    photons: per pixel of the empty bright field; None is no noise.
    bounds: of Δn, known beforehand; None is none.
    """

    name: str
    kind: str
    data: Float[Tensor, "prism focus y x"]
    truth: Float[Tensor, "z y x"]
    grid: Grid
    background: float
    microscope: Microscope
    acquisition: Acquisition
    photons: float | None
    bounds: Bounds = (0.0, None)

    @property
    def noise(self) -> tuple[float, ...]:
        """Standard deviation of the noise in each prism's images; its square is their mean over the photons."""
        if self.photons is None:
            return (0.0,) * len(self.data)
        return tuple(math.sqrt(float(mean) / self.photons) for mean in self.data.mean((1, 2, 3)))

    @property
    def noise_misfit(self) -> float:
        """What noise alone leaves of the misfit."""
        alone = GaussianMisfit(self.data).of_noise(self.noise)
        assert alone is not None
        return alone


def acquisition(shears: Sequence[tuple[float, float]], biases: Sequence[float], focus: Sequence[float]) -> Acquisition:
    """Every shear with every bias, at every focus."""
    return Acquisition([Prism(shear, bias) for shear in shears for bias in biases], focus)


USUAL = acquisition(SHEARS, (math.pi / 2, -math.pi / 2), FOCUS)


@dataclass(frozen=True, eq=False)
class Setup:
    """What a scene is made from.

    kind, photons, bounds, microscope, acquisition: as of a `Scene`.
    specimen: known everywhere, also outside the grid.
    grid: of the reconstruction.
    seed: of the noise.
    margin: voxels on each side by which the finer model's field is wider than the recorded one.
    finer: parts of a voxel along (z, y, x) in the model that makes the images; exact fields ignore z.
    sources: condenser directions of that model.
    The exact field makes the images of a specimen that knows one.
    """

    kind: str
    specimen: Specimen
    grid: Grid = GRID
    microscope: Microscope = MICROSCOPE
    acquisition: Acquisition = USUAL
    photons: float | None = 4000.0
    bounds: Bounds = (0.0, None)
    seed: int = 0
    margin: int = 16
    finer: tuple[int, int, int] = (3, 2, 2)
    sources: int = SOURCES

    @property
    def fingerprint(self) -> str:
        """Names what the noiseless images depend on."""
        parts = (self.specimen, self.grid, self.microscope, self.acquisition, self.margin, self.finer, self.sources)
        return hashlib.sha256(repr((__version__, *parts)).encode()).hexdigest()[:16]

    @property
    def model(self) -> FinerModel:
        """The model that makes the images of a specimen without an exact field."""
        return FinerModel(self.finer, self.margin, self.sources)

    @property
    def fine_grid(self) -> Grid:
        """The grid of the model that makes the images, without its margin."""
        return self.model.grid(self.grid)

    def truth(self) -> Float[Tensor, "z y x"]:
        """Δn on the reconstruction's grid: the mean of the finer voxels in each."""
        return self.model.truth(self.specimen, self.grid)

    def images(self) -> Float[Tensor, "prism focus y x"]:
        """The noiseless images on the recorded pixels, float32."""
        return self.model.images(self.specimen, self.grid, self.microscope, self.acquisition)

    def scene(self, name: str, cache: Path | None = None) -> Scene:
        """The scene itself. cache: a folder in which its noiseless images are found or left; None keeps nothing."""
        if cache is None:
            images, truth = self.images(), self.truth()
        else:
            images, truth = self._kept(cache / f"{self.fingerprint}.npz")
        if self.photons is not None:
            images = Camera(photons=self.photons).record(images, torch.Generator().manual_seed(self.seed))
        return Scene(
            name,
            self.kind,
            images,
            truth,
            self.grid,
            self.specimen.background,
            self.microscope,
            self.acquisition,
            self.photons,
            self.bounds,
        )

    def _kept(self, file: Path) -> tuple[Tensor, Tensor]:
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            with written_whole(file) as partial, open(partial, "wb") as stream:
                np.savez(stream, images=self.images().numpy(), truth=self.truth().numpy())
        with np.load(file) as arrays:
            return torch.from_numpy(arrays["images"]), torch.from_numpy(arrays["truth"])


CELL = CellPhantom()


def two_beads(factor: float = 1.0) -> Together:
    """Two weak beads, one above the other, a little to the side."""
    return Together(
        (
            Bead(1.4, 0.016 * factor, 1.36, (-1.9, 0.3, -0.4)),
            Bead(1.2, 0.018 * factor, 1.36, (1.9, -0.3, 0.5)),
        )
    )


def crossed_fibres() -> Together:
    """Three fibres at three depths: along x, along y and aslant."""
    return Together(
        (
            Fibre(0.6, 7.0, 0.025, 1.36, 0.0, (-1.6, 0.8, 0.0)),
            Fibre(0.5, 6.5, 0.03, 1.36, math.pi / 2, (0.2, 0.0, -1.0)),
            Fibre(0.55, 6.0, 0.025, 1.36, 0.7, (1.8, -0.4, 0.6)),
        )
    )


def holes() -> Together:
    """A flattened hole and a round one, of lower index than their medium."""
    return Together(
        (
            solid(Ellipsoid((1.2, 1.8, 1.4), (-1.0, 0.6, -1.4)), -0.02, 1.45),
            Bead(1.0, -0.03, 1.45, (1.2, -0.9, 1.6)),
        )
    )


def graded() -> Together:
    """A parabola and a Gaussian."""
    return Together(
        (
            GradedEllipsoid(Ellipsoid((2.0, 2.4, 2.8), (-0.5, 0.6, -1.2)), 0.03, 1.36),
            GaussianBall(0.7, 0.025, 1.36, (0.9, -1.6, 2.2)),
        )
    )


def yeast(centre: tuple[float, float, float], radius: float) -> CellPhantom:
    """A yeast-like cell in water: a wall, a body, and in it a vacuole and a droplet of high index.

    centre: (z, y, x) in µm. radius: the wall's outer radius across z in µm; its other axes are a little longer.
    """

    def part(size: tuple[float, float, float], place: tuple[float, float, float], contrast: float) -> Organelle:
        axes = (radius * size[0], radius * size[1], radius * size[2])
        at = (centre[0] + radius * place[0], centre[1] + radius * place[1], centre[2] + radius * place[2])
        return Organelle(Ellipsoid(axes, at), contrast)

    origin = (0.0, 0.0, 0.0)
    return CellPhantom(
        1.335,
        cytoplasm=part((1.0, 1.05, 1.25), origin, 0.055),
        nucleus=part((0.93, 0.98, 1.18), origin, 0.04),
        nucleoli=(
            part((0.38, 0.4, 0.42), (0.15, 0.25, -0.5), 0.015),
            part((0.17, 0.17, 0.17), (-0.2, -0.45, 0.45), 0.09),
        ),
        vacuole=None,
        lipid=None,
    )


def yeast_setup() -> Setup:
    """One prism, many planes, a wide aperture; a neighbour is cut by the field's edge.

    Without noise the true volume leaves a misfit of 0.003 with 112 directions, if 24 voxels of truth are added on each
    side, and 0.055 with 40. Without those voxels it leaves 0.24 and 0.30, most of it beside the neighbour.
    """
    return Setup(
        "strong",
        Together((yeast((0.0, 0.6, -1.2), 2.7), yeast((0.3, -2.4, 7.4), 2.4))),
        Grid((31, 96, 96), (0.3, 0.15, 0.15)),
        Microscope(0.546, Objective(1.33), Condenser(0.9)),
        acquisition(SHEARS[:1], (math.pi / 2,), [0.3 * (i - 15) for i in range(31)]),
        margin=24,
    )


def demo_setup() -> Setup:
    """The stack of `torchdic demo`: without noise, points for pixels."""
    return Setup("demo", demo.BEAD, demo.GRID, demo.MICROSCOPE, demo.ACQUISITION, None, finer=(3, 1, 1), sources=150)


def cell(kind: str = "cell", **changes: object) -> Setup:
    """The cell, with changes of its setup."""
    return replace(Setup(kind, CELL), **changes)  # pyright: ignore[reportArgumentType]


_BEAD = Setup("beads", Bead(2.5, 0.035, 1.56), photons=5000.0)
SETUPS: dict[str, Callable[[], Setup]] = {
    "two beads": lambda: Setup("beads", two_beads()),
    "cell": cell,
    "bead": lambda: _BEAD,
    "bead, clean": lambda: replace(_BEAD, photons=None),
    "beads side by side": lambda: Setup(
        "beads",
        Together((Bead(1.5, 0.02, 1.45, (-0.5, 0.3, -2.0)), Bead(1.2, 0.02, 1.45, (0.6, -0.4, 1.6)))),
    ),
    "fibres": lambda: Setup("fibres", crossed_fibres()),
    "fibres, one axis": lambda: Setup(
        "fibres", crossed_fibres(), acquisition=acquisition(SHEARS[:1], (math.pi / 2, -math.pi / 2), FOCUS)
    ),
    "lower index": lambda: Setup("lower", holes(), bounds=(None, 0.0)),
    "graded": lambda: Setup("graded", graded()),
    "faint beads, much light": lambda: Setup("beads", two_beads(0.15), photons=1e5),
    "cell, 400 photons": lambda: cell("sparse light", photons=400.0),
    "cell, 300 photons": lambda: cell("sparse light", photons=300.0, seed=1),
    "cell, 40000 photons": lambda: cell(photons=4e4),
    "cell, Δn × 2": lambda: cell("strong", specimen=stronger(CELL, 2)),
    "cell, Δn × 3": lambda: cell("strong", specimen=stronger(CELL, 3)),
    "cell, bias ±0.3": lambda: cell(acquisition=acquisition(SHEARS, (0.3, -0.3), FOCUS)),
    "cell, one bias": lambda: cell(acquisition=acquisition(SHEARS, (math.pi / 2,), FOCUS)),
    "strong bead": lambda: Setup("strong", Bead(2.0, 0.1, 1.36)),
    "yeast": yeast_setup,
    "demo": demo_setup,
    "smooth ball": lambda: Setup("smooth", GaussianBall(1.2, 0.03, 1.36)),
}


def default_cache() -> Path:
    """The folder that TORCHDIC_CACHE names; without it one of the system's folder for temporary files."""
    named = os.environ.get("TORCHDIC_CACHE")
    return Path(named) if named else Path(tempfile.gettempdir()) / "torchdic_scenes"


def scene(name: str, cache: Path | None = None) -> Scene:
    """A scene by its name, from images that are computed once.

    cache: the folder where they are kept; None is `default_cache()`. After a change to the code that makes them, empty
    it. Raises ValueError for a name that isn't in SCENES.
    """
    if name not in SETUPS:
        raise ValueError(f"scene {name!r} must be one of {', '.join(map(repr, SETUPS))}")
    return SETUPS[name]().scene(name, cache or default_cache())


def _computed(name: str) -> Callable[[], Scene]:
    return lambda: SETUPS[name]().scene(name)


SCENES: dict[str, Callable[[], Scene]] = {name: _computed(name) for name in SETUPS}


def drawn_setup(seed: int) -> Setup:
    """Optics, specimen and light drawn at random."""
    random = np.random.default_rng(seed)
    wavelength, na = (float(random.uniform(*limits)) for limits in ((0.5, 0.6), (0.6, 1.3)))
    background = float(random.choice([n for n in (1.335, 1.36, 1.45, 1.518, 1.56) if n > 1.02 * na]))
    # as fine as the usual scene's for its aperture, or finer
    pixel = float(random.uniform(0.15, max(0.16, min(0.25, 0.36 * wavelength / na))))
    dz = float(random.uniform(0.3, 0.5))
    depth = float(random.uniform(7.0, 9.0))
    ny, nx = (int(n) for n in random.choice([54, 60, 64, 72], 2))
    grid = Grid((round(depth / dz), ny, nx), (dz, pixel, pixel))
    shear, turned = float(random.uniform(0.12, 0.3)), float(random.choice([0.0, math.pi / 4]))
    axes = [(round(shear * math.sin(a), 6), round(shear * math.cos(a), 6)) for a in (turned, turned + math.pi / 2)]
    bias = float(random.uniform(0.6, 1.8))
    biases = (bias, -bias) if random.random() < 0.7 else (bias,)
    planes, reach = int(random.integers(5, 16)), float(random.uniform(0.4, 0.55)) * grid.extent[0]
    focus = [round(float(z), 6) for z in np.linspace(-reach, reach, planes)]
    kind, specimen = any_specimen(random, grid.extent, background)
    return Setup(
        f"drawn {kind}",
        specimen,
        grid,
        Microscope(wavelength, Objective(na), Condenser(na * float(random.uniform(0.3, 0.9)))),
        acquisition(axes[: int(random.integers(1, 3))], biases, focus),
        float(math.exp(random.uniform(math.log(500), math.log(40000)))),
        (None, 0.0) if kind == "lower" else (0.0, None),
        seed,
    )


def drawn(seed: int, cache: Path | None = None) -> Scene:
    """A random scene: optics, specimen, contrast and light; the same for the same seed. cache: as of `scene`."""
    return drawn_setup(seed).scene(f"drawn {seed}", cache or default_cache())


def draw(scene: Scene, folder: Path) -> None:
    """Leave pictures of a scene's sections and images in a folder."""
    stem = "".join(c if c.isalnum() else "_" for c in scene.name)
    figures.save(figures.draw_sections({scene.name: scene.truth}, scene.grid), folder / f"{stem}_sections.png")
    stack = figures.draw_stack(scene.data, scene.acquisition.prisms, scene.acquisition.focus, scene.grid.spacing[1:])
    figures.save(stack, folder / f"{stem}_images.png")


def row(scene: Scene) -> str:
    """A scene's line of the table."""
    prisms, planes = scene.data.shape[:2]
    low, high = float(scene.truth.min()), float(scene.truth.max())
    cells = (
        scene.name,
        scene.kind,
        "×".join(map(str, scene.grid.shape)),
        f"{prisms} × {planes}",
        "–" if scene.photons is None else f"{scene.photons:.4g}",
        f"{low if -low > high else high:.3g} in {scene.background:g}",
        f"{scene.noise_misfit:.3g}",
    )
    return "| " + " | ".join(cells) + " |"


def main() -> int:
    """Draw the scenes, and print their table."""
    parser = argparse.ArgumentParser(description="The scenes by which the reconstruction is judged.")
    parser.add_argument("--out", type=Path, default=Path("scenes"), help="folder for the pictures")
    parser.add_argument("--cache", type=Path, default=default_cache(), help="folder where images are kept")
    parser.add_argument("--scenes", nargs="*", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--drawn", type=int, default=0, help="how many scenes to draw at random besides")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print("| scene | kind | voxels | prisms × planes | photons | strongest Δn | noise misfit |")
    print("|---|---|---|---|---|---|---|")
    for make in [
        *(lambda name=name: scene(name, options.cache) for name in options.scenes),
        *(lambda seed=seed: drawn(seed, options.cache) for seed in range(options.drawn)),
    ]:
        made = make()
        draw(made, options.out)
        print(row(made), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
