"""Whether what is said of a volume holds: error bars against many draws of noise, and coverage against fits.

    python benchmarks/evidence.py noise [SCENE ...]     # each draw's bars by noise, --draws of them
    python benchmarks/evidence.py bars [SCENE ...]      # whole bars and regions, over 20 draws of noise
    python benchmarks/evidence.py extents               # stated and measured widths of points, on six acquisitions
    python benchmarks/evidence.py gratings              # stated and measured transfer of gratings
    python benchmarks/evidence.py prior                 # what isn't seen changes with the prior
    python benchmarks/evidence.py suggestion            # suggested changes, carried out
    python benchmarks/evidence.py nothing               # stacks that can't say much

The scenes are those of benchmarks/scenes.py: exact fields or a finer, different model, with noise.
"""

import argparse
import io
import math
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

import scenes
from data_synthetic import Bead, CellPhantom, Ellipsoid
from data_synthetic.specimen import Specimen, centres
from recon.cli import main as main_of_torchdic
from recon.coverage.acquisition import DIRECTIONS, NoisyAcquisition
from recon.coverage.changes import changes
from recon.coverage.expected import ExpectedSpecimen
from recon.coverage.resolution import widths
from recon.coverage.seen import Coverage
from recon.evidence.bars import ErrorBars, bars_of
from recon.evidence.errors import near
from recon.evidence.estimate import Estimate
from recon.evidence.refits import planned_refits, refits
from recon.evidence.regions import INCREMENT, Region
from recon.fit.bounds import Bounds
from recon.fit.descent import solved
from recon.fit.newton.weak_hessian import cosines, waves_of_columns, weak_responses
from recon.fit.problem import Problem, Recipe, measured_noise
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from recon.run.evidence.error_bars import Wanted
from recon.run.reconstruct import RECOMMENDED
from reconstruction import fit, run_chosen, setup_of
from scenes import Scene
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective

# What error bars are judged by: faint and dim, with parts, sharp.
SCENES = ("two beads", "cell", "bead")

# Draws of noise, and how many of them share the error bars of the first.
DRAWS, SHARED = 20, 5

# Refits, as the command does them.
USUAL = Wanted()

# How much larger than a part of the cell its outline is drawn.
LOOSELY = 1.3


@dataclass(frozen=True, eq=False)
class Draws:
    """A scene with its noiseless images, of which noise can be drawn as often as one likes."""

    scene: Scene
    clean: Float[Tensor, "prism focus y x"]

    @classmethod
    def of(cls, name: str, cache: Path) -> "Draws":
        """The draws of one of the scenes, which has noise."""
        setup = scenes.SETUPS[name]()
        return cls(setup.scene(name, cache), replace(setup, photons=None).scene(name, cache).data)

    def data(self, seed: int) -> Float[Tensor, "prism focus y x"]:
        """The images with noise. seed: of it."""
        return Camera(photons=self.scene.photons).record(self.clean, torch.Generator().manual_seed(seed))

    def estimate(self, data: Tensor) -> Estimate:
        """The default fit of a draw."""
        noise = measured_noise(data)
        assert noise is not None
        recipe = replace(Recipe(), bounds=Bounds(*self.scene.bounds))
        problem = Problem.from_recipe(data, setup_of(replace(self.scene, data=data)), RECOMMENDED, recipe, noise=noise)
        photons = self.scene.photons
        assert photons is not None
        return Estimate(problem, solved(problem), lambda images: (images / photons).sqrt(), GaussianMisfit, solved)


def header(*columns: str) -> None:
    """Print a table's head."""
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)


def noise(options: argparse.Namespace) -> None:
    """Each draw's own bars by noise: how far off the volume of noiseless images is."""
    header("scene", "noise's bar", "spread", "hold", "68 % in", "that holds", "draws")
    for name in options.names or SCENES:
        draws = Draws.of(name, options.cache)
        where = near(draws.scene.truth)
        found = []
        for number in range(options.first, options.first + options.draws):
            estimate = draws.estimate(draws.data(number))
            setup = estimate.problem.setup
            bars = bars_of(estimate, list(refits(estimate, planned_refits(USUAL.noise, 0))), INCREMENT)
            off = (bars.delta - setup.within_field(estimate.refitted(draws.clean))).abs()
            counted = where & ((bars.deviation > 0) | (off > 0))  # elsewhere nothing is claimed
            held = [float((off <= n * bars.deviation)[counted].float().mean()) for n in (1.0, bars.interval)]
            squares = (float(v[where].square().mean()) for v in (bars.deviation, off))
            found.append((*squares, *held, bars.interval))
        bar, spread, one, those, interval = (np.array(column) for column in zip(*found, strict=True))
        roots = (f"{math.sqrt(v.mean()):.5f}" for v in (bar, spread))
        holds = (f"{v.mean():.0%} ({v.min():.0%} to {v.max():.0%})" for v in (one, those))
        cells = name, *roots, next(holds), f"{interval.mean():.2f} bars", next(holds), str(len(found))
        print("| " + " | ".join(cells) + " |", flush=True)


def bars(options: argparse.Namespace) -> None:
    """Error bars over draws of noise: what they hold, and how often a region's truth lies within two of its errors."""
    header("scene", "whole bar", "error", "held by whole bars", "fits")
    told: list[str] = []
    for name in options.names or SCENES:
        line, of_regions = _bars(name, options.cache)
        print(line, flush=True)
        told += of_regions
    print()
    header("scene", "region", "quantity", "truth", "first draw", "within one error", "within two")
    print("\n".join(told))


def _bars(name: str, cache: Path) -> tuple[str, list[str]]:
    """A scene's line of the table, and those of its regions."""
    draws = Draws.of(name, cache)
    truth, outlines = draws.scene.truth, drawn_outlines(name, draws.scene)
    where = near(truth)
    whole, sizes, errors, cost = [], [], [], []
    within: dict[tuple[str, str], list[float]] = {}
    first: dict[tuple[str, str], tuple[float, float, float]] = {}
    for start in range(0, DRAWS, SHARED):
        began = time.process_time()
        estimate = draws.estimate(draws.data(100 + start))
        of_fit = time.process_time() - began
        found = bars_of(
            estimate, list(refits(estimate, planned_refits(USUAL.noise, USUAL.copies))), INCREMENT, outlines
        )
        cost.append((time.process_time() - began) / of_fit - 1)
        setup = estimate.problem.setup
        for seed in range(100 + start, 100 + start + SHARED):
            other = estimate if seed == 100 + start else draws.estimate(draws.data(seed))
            delta = setup.within_field(other.delta)
            whole.append(float(((delta - truth).abs() <= found.total)[where].float().mean()))
            errors.append(float((delta - truth)[where].square().mean()))
            _count(within, first, found, delta, truth)
        sizes.append(found.typical(found.total))
    cells = (
        name,
        f"{sum(sizes) / len(sizes):.5f}",
        f"{math.sqrt(sum(errors) / DRAWS):.5f}",
        f"{sum(whole) / DRAWS:.0%} ({min(whole):.0%} to {max(whole):.0%})",
        f"{sum(cost) / len(cost):.1f}",
    )
    rows = []
    for (region, quantity), ratios in within.items():
        true, value, error = first[region, quantity]
        one, two = (sum(abs(r) <= n for r in ratios) for n in (1, 2))
        held = f"{one} of {len(ratios)} | {two} of {len(ratios)}"
        rows.append(f"| {name} | {region} | {quantity} | {true:.4g} | {value:.4g} ± {error:.2g} | {held} |")
    return "| " + " | ".join(cells) + " |", rows


def _count(
    within: dict[tuple[str, str], list[float]],
    first: dict[tuple[str, str], tuple[float, float, float]],
    found: ErrorBars,
    delta: Tensor,
    truth: Tensor,
) -> None:
    """Add by how many of its errors each region's numbers are off in one draw."""
    for name, (region, numbers) in found.regions.items():
        own, true = (
            Region.within(name, region.outline, volume).measures(volume, found.grid, INCREMENT)
            for volume in (delta, truth)
        )
        for quantity, known in numbers.items():
            value = own[quantity] / (1 + known.usual)
            first.setdefault((name, quantity), (true[quantity], value, known.error))
            within.setdefault((name, quantity), []).append((value - true[quantity]) / known.error)


def drawn_outlines(name: str, scene: Scene) -> Mapping[str, Bool[Tensor, "z y x"]]:
    """Outlines that are drawn loosely around the cell's nucleus and droplet; none of other specimens."""
    if not name.startswith("cell"):
        return {}
    cell = CellPhantom()
    assert cell.nucleus is not None
    assert cell.lipid is not None
    parts = {"nucleus": cell.nucleus.shape, "droplet": cell.lipid.shape}
    return {part: _outline(shape, scene) for part, shape in parts.items()}


def _outline(shape: Ellipsoid, scene: Scene) -> Bool[Tensor, "z y x"]:
    """The voxels within an ellipsoid that is LOOSELY larger."""
    z, y, x = (scene.grid.coordinates(axis) for axis in range(3))
    offsets = zip((z[:, None, None], y[:, None], x), shape.centre, shape.semi_axes, strict=True)
    return sum(((place - middle) / (LOOSELY * half)).square() for place, middle, half in offsets) <= torch.ones(())


# --- what coverage states ---------------------------------------------------------------------------------------------

FINE = Grid((25, 64, 64), (0.3, 0.15, 0.15))
MEDIUM = 1.36

# Shear axes, biases in degrees, planes over ±3 µm, and the condenser's NA.
ACQUISITIONS = (
    (2, (90, -90), 9, 0.7),
    (1, (90, -90), 9, 0.7),
    (2, (90, -90), 9, 0.3),
    (1, (90,), 17, 0.5),
    (2, (90, -90), 3, 0.8),
    (2, (30, -30), 9, 0.2),
)

# A small bead and gratings' amplitude, so weak that their images are linear in Δn; and what is expected beforehand.
POINT = Bead(0.2, 0.04, MEDIUM)
AMPLITUDE = 0.002
EXPECTED = ExpectedSpecimen()
LIGHT = 4000.0

# Periods in voxels across z, and numbers of half waves along z.
GRATINGS = ((4, 1), (8, 1), (8, 4), (16, 1), (16, 4), (32, 1), (32, 3))


@dataclass(frozen=True)
class Grating(Specimen):
    """Waves across z at 45°, and half waves along z through the volume; a medium around.

    period: along x and along y, µm. halves: half waves along z. depth: of the volume, µm. background: the medium's
    index.
    """

    period: float
    halves: int
    depth: float
    background: float = MEDIUM

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        z, y, x = centres(grid)
        along = torch.cos(math.pi * self.halves * (z / self.depth + 0.5))
        return AMPLITUDE * along * torch.cos(2 * math.pi * (y + x) / self.period)


def acquired(row: tuple[int, tuple[int, ...], int, float]) -> tuple[Microscope, Acquisition, str]:
    """The microscope and the acquisition of a row of ACQUISITIONS, and its name."""
    axes, biases, planes, na = row
    focus = [3.0 * (2 * i / (planes - 1) - 1) for i in range(planes)]
    made = scenes.acquisition(scenes.SHEARS[:axes], [math.radians(bias) for bias in biases], focus)
    at = ", ".join(f"{bias}°" for bias in biases)
    told = f"{'one axis' if axes == 1 else 'two axes'}, {at}, {planes} planes, NA {na}"
    return Microscope(0.546, Objective(0.9), Condenser(na)), made, told


def planned(scene: Scene) -> NoisyAcquisition:
    """A scene's acquisition with the noise that its stack shows."""
    noise = measured_noise(scene.data)
    assert noise is not None
    return NoisyAcquisition(scene.grid, scene.background, scene.microscope, scene.acquisition, tuple(noise))


def best_linear(scene: Scene, expected: ExpectedSpecimen = EXPECTED) -> Float[Tensor, "z y x"]:
    """The best linear estimate from a scene's noisy images: (JᴴJ/σ² + P⁻¹)⁻¹·Jᴴ(data − empty)/σ², float64."""
    setup = Setup(
        empty_medium(scene.grid, scene.background, torch.zeros((), dtype=torch.float64)),
        scene.microscope,
        scene.acquisition,
    )
    fidelity = Fidelity(sources=DIRECTIONS)
    T = weak_responses(setup, fidelity, torch.zeros((), dtype=torch.float64))
    along_z = cosines(scene.grid.shape[0]).to(T.dtype)
    levels = scene.data.double().mean((2, 3), keepdim=True)  # a weak specimen moves no mean
    noise = torch.tensor(planned(scene).noise, dtype=torch.float64)[:, None, None, None]
    images = torch.fft.rfft2((scene.data.double() - levels) / noise).permute(2, 3, 0, 1).flatten(2)
    J = (T / noise[..., None]).permute(3, 4, 0, 1, 2).flatten(2, 3) @ along_z.mT
    power = expected.power(scene.grid)
    told = J.mH @ J + torch.diag_embed(1 / power).to(J.dtype)
    waves = (along_z.mT @ torch.linalg.solve(told, J.mH @ images[..., None]))[..., 0]
    return torch.fft.irfft2(waves.permute(2, 0, 1), s=scene.grid.shape[1:])


def extents(options: argparse.Namespace) -> None:
    """Widths of a small bead of exact field: as stated, with its own; in the best linear estimate; by newton."""
    header("acquisition", "axial, stated", "best linear", "newton", "lateral, stated", "best linear", "newton")
    middle = FINE.shape[0] // 2, FINE.shape[1] // 2, FINE.shape[2] // 2
    for row in ACQUISITIONS:
        microscope, made, name = acquired(row)
        # the middle voxel's centre lies half a voxel off the field's, where the number of voxels is even
        centre = tuple((m - (n - 1) / 2) * d for m, n, d in zip(middle, FINE.shape, FINE.spacing, strict=True))
        point = Bead(POINT.radius, POINT.contrast, MEDIUM, (centre[0], centre[1], centre[2]))
        scene = scenes.Setup("point", point, FINE, microscope, made, photons=LIGHT).scene(name, options.cache)
        stated = widths(planned(scene).coverage(EXPECTED).estimate(scene.truth), middle, FINE.spacing)
        linear = widths(best_linear(scene), middle, FINE.spacing)
        newton = widths(fit(scene, setup=setup_of(scene, 0)).delta.double(), middle, FINE.spacing)
        told = [f"{w.axial:.2f}" for w in (stated, linear, newton)]
        told += [f"{w.finest:.2f} to {w.coarsest:.2f}" for w in (stated, linear, newton)]
        print(f"| {name} | {' | '.join(told)} |", flush=True)


def gratings(options: argparse.Namespace) -> None:
    """Transfer of weak gratings: as stated, in the best linear estimate of noisy images of a finer model."""
    names = [f"{period * FINE.spacing[2] / math.sqrt(2):.2g} µm, {halves}/2" for period, halves in GRATINGS]
    header("acquisition", *names)
    for row in ACQUISITIONS:
        microscope, made, name = acquired(row)
        cells = []
        for period, halves in GRATINGS:
            grating = Grating(period * FINE.spacing[2], halves, FINE.extent[0])
            setup = scenes.Setup(
                "grating", grating, FINE, microscope, made, photons=LIGHT, finer=(1, 2, 2), sources=256
            )
            scene = setup.scene(name, options.cache)
            stated, found = (
                float((estimate * scene.truth).sum() / scene.truth.double().square().sum())
                for estimate in (planned(scene).coverage(EXPECTED).estimate(scene.truth), best_linear(scene))
            )
            cells.append(f"{stated:.2f}, {found:.2f}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


# Bounds between frequencies that are guessed, half seen and seen.
SEEN = (0.0, 0.1, 0.5, 0.9, 1.0)


def prior(options: argparse.Namespace) -> None:
    """How far another prior's volume differs from the default's, relative to it, by how well frequencies are seen."""
    header("scene", "prior", *(f"seen {low:g} to {high:g}" for low, high in pairwise(SEEN)))
    for name in options.names or ("cell", "cell, 40000 photons"):
        scene = scenes.scene(name, options.cache)
        covered = planned(scene).coverage(EXPECTED)
        usual = fit(scene).delta
        for kind in ("tv", "smooth"):
            apart = fit(scene, Recipe(prior=kind)).delta - usual
            shares = [_share(covered, apart, usual, low, high) for low, high in pairwise(SEEN)]
            print(f"| {name} | {kind} | {' | '.join(f'{share:.2f}' for share in shares)} |", flush=True)


def _share(covered: Coverage, part: Tensor, whole: Tensor, low: float, high: float) -> float:
    """Norm of a volume over another one's, at the frequencies that are seen so well."""
    where = covered.passed & (covered.seen > low) & (covered.seen <= high)
    along_z = cosines(covered.grid.shape[0])
    powers = []
    for delta in (part, whole):
        waves = torch.fft.rfft2(torch.tensordot(along_z, delta.double(), 1)).permute(1, 2, 0)
        powers.append(float((waves.abs().square() * waves_of_columns(covered.grid.shape[2])[:, None])[where].sum()))
    return math.sqrt(powers[0] / powers[1])


# An acquisition of which much can be made better, and the bead of exact field on which that is tried: so small that all
# frequencies are in it, as in what is expected.
MODEST = (1, (90,), 5, 0.5)
SMALL = Bead(0.2, 0.08, MEDIUM)
MUCH_LIGHT = 1e5


def suggestion(options: argparse.Namespace) -> None:
    """Each suggested change carried out on a bead of exact field: the share of its variance that the images explain."""
    microscope, made, name = acquired(MODEST)
    setup = scenes.Setup("suggestion", SMALL, FINE, microscope, made, photons=MUCH_LIGHT)
    scene = setup.scene(name, options.cache)
    expected = ExpectedSpecimen(2 * float(scene.truth.double().square().mean().sqrt()), 0.75 * SMALL.radius)
    before = planned(scene)
    stated, found = before.coverage(expected).explained, explained(scene, best_linear(scene, expected))
    print(f"{name}: explained {stated:.2f} as stated, {found:.2f} as found\n")
    header("change", "adds, as stated", "best linear estimate", "error of newton, before", "after")
    error = fit(scene, setup=setup_of(scene, 0)).error
    for change in changes(before):
        other = change.recording
        light = MUCH_LIGHT * (before.noise[0] / other.noise[0]) ** 2
        tried = replace(setup, microscope=other.microscope, acquisition=other.acquisition, photons=light)
        after = tried.scene(change.name, options.cache)
        adds = planned(after).coverage(expected).explained - stated
        gain = explained(after, best_linear(after, expected)) - found
        newton = fit(after, setup=setup_of(after, 0)).error
        print(f"| {change.name} | {adds:+.3f} | {gain:+.3f} | {error:.3f} | {newton:.3f} |", flush=True)


def explained(scene: Scene, estimate: Tensor) -> float:
    """The share of Δn's variance that an estimate explains; no image tells its mean."""
    truth = scene.truth.double() - scene.truth.double().mean()
    return 1 - float((estimate - estimate.mean() - truth).square().sum() / truth.square().sum())


# A stack that says much, and what is changed of it.
STACK = """
[volume]
shape = [12, 40, 40]
spacing = [0.5, 0.2, 0.2]
background = 1.335
[microscope]
wavelength = 0.546
objective = { na = 0.9 }
condenser = { na = 0.6 }
camera = { photons = 4000 }
[acquisition]
focus = [-2.0, -1.0, 0.0, 1.0, 2.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }, { shear = [0.24, 0.0], bias = 1.5708 }]
[specimen]
kind = "bead"
radius = 1.3
contrast = 0.02
[data]
path = "made/stack.ome.tif"
"""
BY_ADAM = '[reconstruction]\nmethod = "adam"\nstart = "zero"'  # newton's method refuses a stack of bias 0 alone
CHANGED = {
    "nothing changed": {},
    "bias 0 alone": {
        "bias = 1.5708": "bias = 0.0",
        "[data]": '[reconstruction]\nmethod = "adam"\nstart = "zero"\n[data]',
    },
    "one plane": {"[-2.0, -1.0, 0.0, 1.0, 2.0]": "[0.0]"},
    "condenser closed": {"na = 0.6": "na = 0.0"},
    "50 photons": {"4000": "50"},
}


def nothing(_: argparse.Namespace) -> None:
    """What coverage, verdict and error bars say of stacks that can't say much, each in its last line but the files'."""
    header("stack", "coverage", "reconstruct", "error-bars", "dry mass, pg")
    for name, changed in CHANGED.items():
        text = STACK
        for before, after in changed.items():
            text = text.replace(before, after)
        with tempfile.TemporaryDirectory() as place:
            config, out = Path(place) / "run.toml", Path(place) / "run"
            config.write_text(text, encoding="utf-8")
            _said("simulate", config, "--out", Path(place) / "made")
            told = [_said("coverage", config, "--out", Path(place) / "covered")]
            told += [_said("reconstruct", config, "--out", out), _said("error-bars", out)]
            lines = [_of_images(one) for one in told]
            mass = next((line.split("mass")[1].split("pg")[0].strip() for line in told[2] if "dry mass" in line), "–")
        print(f"| {name} | {' | '.join(lines)} | {mass} |", flush=True)


def _said(*words: object) -> list[str]:
    """The lines that a command prints, its error among them."""
    said, wrong = io.StringIO(), io.StringIO()
    with redirect_stdout(said), redirect_stderr(wrong):
        main_of_torchdic([str(word) for word in words])
    errors = [line for line in wrong.getvalue().splitlines() if "error:" in line]
    return said.getvalue().splitlines() + [line.split("toml: ")[-1] for line in errors]


def _of_images(lines: list[str]) -> str:
    """The line that says what the images can't tell."""
    return next((line for line in lines if "these images" in line), "–")


def draws_of_noise(parser: argparse.ArgumentParser) -> None:
    """What the table of noise's bars takes."""
    parser.add_argument("--draws", type=int, default=DRAWS, help="of noise")
    parser.add_argument("--first", type=int, default=100, help="seed of the first")


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "noise": noise,
    "bars": bars,
    "extents": extents,
    "gratings": gratings,
    "prior": prior,
    "suggestion": suggestion,
    "nothing": nothing,
}


if __name__ == "__main__":
    sys.exit(run_chosen(COMMANDS, __doc__, draws_of_noise))
