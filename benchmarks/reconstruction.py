"""How well the default recipe reconstructs scenes that it wasn't tuned on, what each of its parts buys, and by which
method.

    python benchmarks/reconstruction.py scenes [NAME ...] [--drawn N] [--method adam] [--cache DIR]
    python benchmarks/reconstruction.py ablation [NAME ...] [--cache DIR]
    python benchmarks/reconstruction.py acquisitions [cell bead] [--cache DIR]
    python benchmarks/reconstruction.py nuisances | propagations | planned | methods | strong | stuck | support |
                                        verdicts | mistakes [--cache DIR]

"error" is the relative L2 error of Δn over the volume, "mass" the sum of Δn over the true one, "misfit/noise" the final
misfit over what noise alone leaves, for a clean stack the misfit itself. Seconds are processor seconds of one thread.
The noise is measured in the images, as `torchdic reconstruct` does.
"""

import argparse
import math
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar
from unittest.mock import patch

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

import scenes
from recon.earlier.path_length import path_length
from recon.earlier.tikhonov import tikhonov
from recon.fit import planned
from recon.fit.bounds import Bounds
from recon.fit.descent import minimise, solved
from recon.fit.newton import correction, descent
from recon.fit.newton.secants import Secants
from recon.fit.problem import Problem, Recipe, measured_noise
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference
from recon.misfit.gaussian import GaussianMisfit
from recon.prior import edges
from recon.recording.cut_field import needed_margin
from recon.recording.masks import LeftOut, left_out
from recon.recording.preparation import ExpectedStack, prepare
from recon.recording.stuck_pixels import sharpest, stuck_pixels
from recon.recording.support import edges_support
from recon.report.metrics import volume_error
from recon.report.verdict import Verdict, judged
from recon.run.reconstruct import RECOMMENDED, RECOMMENDED_FOR_ADAM
from recon.run.results import model_images
from scenes import Scene
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Prism
from torchdic.errors import SamplingWarning, WrapAroundWarning
from torchdic.files.format import Stack

# Adam's learning rate where it goes on from a fit.
RATE = 1e-4

T = TypeVar("T")

# Scenes on which parts of the recipe are left out.
SOME = ("two beads", "cell", "bead", "fibres", "cell, 400 photons", "cell, 40000 photons", "cell, Δn × 3")


@dataclass(frozen=True, eq=False)
class Found:
    """What a fit of a scene came to."""

    scene: Scene
    last: Step
    delta: Tensor
    seconds: float

    @property
    def error(self) -> float:
        """Relative L2 error of Δn."""
        return volume_error(self.delta, self.scene.truth)

    @property
    def misfit(self) -> float:
        """The final misfit, over the noise's where there is noise."""
        return self.last.misfit / (self.scene.noise_misfit or 1.0)

    @property
    def mass(self) -> float:
        """Sum of Δn over the true one."""
        return float(self.delta.sum() / self.scene.truth.sum())


def setup_of(scene: Scene, margin: int | None = None) -> Setup:
    """The empty volume before the scene's microscope.

    margin: voxels beyond the field; None is as many as the images ask for.
    """
    grid, data = scene.grid, scene.data
    if margin is None:
        margin = needed_margin(data.numpy(), measured_noise(data), grid, scene.microscope, scene.background)
    medium = empty_medium(grid.widened(margin, margin), scene.background, data)
    return Setup(medium, scene.microscope, scene.acquisition, margin=margin)


def fit(scene: Scene, *asked: Any, **named: Any) -> Found:
    """Fit a scene; arguments as of `problem_for`."""
    began = time.process_time()
    problem = problem_for(scene, *asked, **named)
    last = solved(problem)
    return Found(scene, last, problem.setup.within_field(last.delta), time.process_time() - began)


def problem_for(
    scene: Scene,
    recipe: Recipe | None = None,
    fidelity: Fidelity | float | None = None,
    setup: Setup | None = None,
    mask: Tensor | None = None,
    support: Tensor | None = None,
) -> Problem:
    """The fit of a scene by a recipe; None is the default one, at the recommended fidelity.

    fidelity: or a tolerance, for which one is planned. mask: the pixels that count. support: the voxels in which Δn is
        sought.
    """
    recipe = replace(recipe or Recipe(), bounds=Bounds(*scene.bounds))
    usual = RECOMMENDED if recipe.method == "newton" else RECOMMENDED_FOR_ADAM
    noise = measured_noise(scene.data, mask)

    def misfit(data: Tensor) -> GaussianMisfit:
        return GaussianMisfit(data, mask=mask)

    return Problem.from_recipe(scene.data, setup or setup_of(scene), fidelity or usual, recipe, misfit, noise, support)


def row(name: str, found: Found) -> str:
    """A fit's line of a table."""
    weight = f"{found.last.weights[-1]['tv']:.0f}" if found.last.weights else "–"
    cells = (
        name,
        f"{found.scene.noise_misfit:.3g}",
        f"{found.error:.3f}",
        f"{found.mass:.2f}",
        f"{found.misfit:.3f}" if found.scene.photons else f"({found.misfit:.4f})",
        weight,
        str(found.last.number),
        f"{found.seconds:.1f}",
    )
    return "| " + " | ".join(cells) + " |"


HEAD = "| scene | noise | error | mass | misfit/noise | tv | steps | s |\n|---|---|---|---|---|---|---|---|"


def all_scenes(options: argparse.Namespace) -> None:
    """The default recipe on every scene, and on drawn ones."""
    print(HEAD)
    names = options.names or list(scenes.SETUPS)
    chosen = [scenes.scene(name, options.cache) for name in names]
    chosen += [scenes.drawn(seed, options.cache) for seed in range(options.drawn)]
    errors = []
    for scene in chosen:
        found = fit(scene, Recipe(method=options.method))
        errors.append(math.log(found.error))
        print(row(f"{scene.name} ({scene.kind})" if "drawn" in scene.name else scene.name, found), flush=True)
    print(f"\ngeometric mean of the errors: {math.exp(sum(errors) / len(errors)):.4f}")


def ablation(options: argparse.Namespace) -> None:
    """The default recipe without one of its parts, on SOME scenes or those named: errors."""
    usual = Recipe()
    plain = replace(RECOMMENDED, sources=32, padding=0)
    ways: Sequence[tuple[str, Recipe, Fidelity | None]] = (
        ("default", usual, None),
        ("plain total variation", replace(usual, prior="tv"), None),
        ("smooth prior", replace(usual, prior="smooth"), None),
        ("no term in |Δn|", replace(usual, l1=0.0), None),
        ("tv 60 → 5 in place of the noise's", replace(usual, tv=(60.0, 5.0)), None),
        ("no correction: 32 directions", usual, plain),
        ("all directions in every step", replace(usual, draft_sources=None), None),
        ("10 steps", replace(usual, steps=10), None),
        ("40 steps", replace(usual, steps=40), None),
    )
    table("without", ways, options)
    without = (
        ("no secants: the weak Hessian alone", descent, "Secants", lambda hessian, _: Secants(hessian, ())),
        ("drafts that don't follow the volume", correction, "share_of", lambda *_: 0.0),
        ("each edge by itself", edges, "among_neighbours", _by_themselves),
    )
    for name, module, part, other in without:
        with patch.object(module, part, other):
            table("without", ((name, usual, None),), options, head=False)


def _by_themselves(lengths: Tensor) -> Tensor:
    """In the place of `among_neighbours`: lengths of all corners stay, and so do weights."""
    return lengths if len(lengths) == len(edges.CORNERS) else lengths[0]


def table(
    title: str, ways: Sequence[tuple[str, Recipe, Fidelity | None]], options: argparse.Namespace, *, head: bool = True
) -> None:
    """A row of errors (and processor seconds) for each way, a column for each of SOME scenes, or of those named."""
    some = options.names or SOME
    if head:
        print(f"| {title} | " + " | ".join(some) + " |\n" + "|---" * (len(some) + 1) + "|")
    for name, recipe, fidelity in ways:
        found = [fit(scenes.scene(scene, options.cache), recipe, fidelity) for scene in some]
        print(f"| {name} | " + " | ".join(f"{f.error:.3f} ({f.seconds:.0f} s)" for f in found) + " |", flush=True)


def strong(options: argparse.Namespace) -> None:
    """Strong specimens by Newton, by Adam, and by Adam from where Newton ended; how soon Newton errs less than Adam."""
    overtaken: list[str] = []
    print(HEAD)
    for name in options.names or ("cell, Δn × 3", "strong bead", "yeast"):
        scene = scenes.scene(name, options.cache)
        by_newton = fit(scene)
        print(row(f"{name}, newton", by_newton), flush=True)
        by_adam = fit(scene, Recipe(method="adam"))
        print(row(f"{name}, adam", by_adam), flush=True)
        print(row(f"{name}, newton, then adam", adam_from(by_newton)), flush=True)
        overtaken.append(overtaking(by_adam))
    print("\n" + "\n".join(overtaken))


def overtaking(by_adam: Found) -> str:
    """After how many steps, and in which share of its time, Newton's error is below Adam's."""
    began = time.process_time()
    problem = problem_for(by_adam.scene)
    for step in minimise(problem):
        error = volume_error(problem.setup.within_field(step.delta), by_adam.scene.truth)
        if error < by_adam.error:
            share = (time.process_time() - began) / by_adam.seconds
            return f"{by_adam.scene.name}: below Adam's error after {step.number} steps, in {share:.2f} of its seconds"
    return f"{by_adam.scene.name}: never below Adam's error"


def adam_from(found: Found, steps: int = 20) -> Found:
    """The volume that Adam makes of another one in a few steps, on the objective in which a fit has ended."""
    scene, weight, setup = found.scene, found.last.weights[-1]["tv"], setup_of(found.scene)
    recipe = replace(Recipe(), bounds=Bounds(*scene.bounds)).held(weight)
    recipe = replace(recipe, method="adam", steps=steps, draft_sources=None, learning_rate=RATE)
    problem = Problem.from_recipe(scene.data, setup, RECOMMENDED, recipe)
    index, *others = problem.unknowns
    assert isinstance(index, IndexDifference)
    going_on = replace(index, given=found.last.delta)
    began = time.process_time()
    last = solved(replace(problem, unknowns=[going_on, *others]))
    return Found(scene, last, setup.within_field(last.delta), time.process_time() - began)


def nuisances(options: argparse.Namespace) -> None:
    """The cell with a bias 10° off, brightness ±2 % and drift of 0.1 µm: ignored, learned, and known."""
    scene = scenes.scene("cell", options.cache)
    wrong = math.radians(10)
    prisms = [Prism(p.shear, p.bias + math.copysign(wrong, float(p.bias))) for p in scene.acquisition.prisms if p]
    random = torch.Generator().manual_seed(3)
    shape = scene.data.shape[:2]
    drift = 0.1 * torch.randn(*shape, 2, generator=random)
    brightness = 1 + 0.02 * torch.randn(shape, generator=random)
    spoiled = replace(setup_of(scene), brightness=brightness, drift=drift - drift.mean((0, 1))).recorded(scene.data)
    declared = replace(scene, data=spoiled, acquisition=Acquisition(prisms, scene.acquisition.focus))
    print(HEAD)
    print(row("known and cleaned", fit(scene)), flush=True)
    for name, learn in (
        ("only brightness learned", ()),
        ("and bias", ("bias",)),
        ("and drift", ("drift",)),
        ("and bias and drift", ("bias", "drift")),
    ):
        found = fit(declared, Recipe(learn=learn))
        print(row(name, found), flush=True)
        if "bias" in found.last.values:
            off = [abs(float(b)) - math.pi / 2 for b in found.last.values["bias"]]
            print(f"  |bias| off by {', '.join(f'{math.degrees(o):+.2f}°' for o in off)}")


def with_stuck_pixels(data: Tensor, hot: int, dead: int = 0) -> Tensor:
    """A stack in which some pixels of the camera, drawn from a fixed seed, hold three times the median, others 0."""
    spoiled, (ny, nx) = data.clone(), data.shape[2:]
    rows, columns = np.divmod(np.random.default_rng(0).choice(ny * nx, hot + dead, replace=False), nx)
    spoiled[:, :, rows[:hot], columns[:hot]] = 3 * float(data.median())
    spoiled[:, :, rows[hot:], columns[hot:]] = 0.0
    return spoiled


def stuck(options: argparse.Namespace) -> None:
    """The cell on a camera of which 9 pixels are hot and 5 dead: left out as the command does, and counted."""
    scene = scenes.scene("cell", options.cache)
    spoiled = with_stuck_pixels(scene.data, hot=9, dead=5)
    print(HEAD)
    print(row("clean", fit(scene)), flush=True)
    stack = Stack(spoiled.numpy())
    found = stuck_pixels(stack.data, sharpest(scene.microscope, scene.grid.spacing[1:], scene.background))
    for name, seen in (("left out", left_out(stack, stuck=found)), ("counted", LeftOut())):
        prisms = [prism for prism in scene.acquisition.prisms if prism is not None]
        focus = tuple(map(float, scene.acquisition.focus))
        expected = ExpectedStack(tuple(float(prism.bias) for prism in prisms), focus, scene.grid.spacing[1:])
        measured = prepare(stack, expected, left_out=seen)
        mask = None if seen.counted is None else torch.from_numpy(seen.counted)
        cleaned = replace(scene, data=torch.from_numpy(measured.data))
        print(row(f"{seen.stuck or 14} stuck pixels, {name}", fit(cleaned, mask=mask)), flush=True)


def support(options: argparse.Namespace) -> None:
    """Scenes with Δn sought everywhere, within the edges in focus, and within the truth widened by one voxel.

    "held": the error where the priors' weight is held at the last one of the fit without a support.
    """
    print("| scene | support | share | lost | error | held | mass | misfit/noise | tv |\n" + "|---" * 9 + "|")
    for name in options.names or ("two beads", "cell", "bead", "cell, 400 photons"):
        scene, usual = scenes.scene(name, options.cache), Recipe(method=options.method)
        focus, true = [float(z) for z in scene.acquisition.focus], (scene.truth != 0).numpy()
        edges = edges_support(scene.data.numpy(), focus, scene.grid, scene.microscope, scene.background)
        known = np.asarray(ndimage.binary_dilation(true, np.ones((3, 3, 3), bool)), bool)
        everywhere, held = np.ones(true.shape, bool), usual
        for kind, voxels in (("none", everywhere), ("edges", edges), ("the truth's, widened by a voxel", known)):
            within = torch.from_numpy(voxels)
            found = fit(scene, usual, support=within)
            weight = found.last.weights[-1]["tv"]
            if kind == "none":
                held = replace(usual, tv=(weight, weight), l1=usual.sparse * weight)
            parts = (float(voxels.mean()), float((true & ~voxels).sum() / true.sum()), found.error)
            numbers = [f"{number:.3f}" for number in (*parts, fit(scene, held, support=within).error)]
            numbers += [f"{found.mass:.2f}", f"{found.misfit:.3f}", f"{weight:.0f}"]
            print("| " + " | ".join((name, kind, *numbers)) + " |", flush=True)


def verdicts(options: argparse.Namespace) -> None:
    """What the verdict says of right fits: misfit/noise, whiteness, and whether it would warn."""
    print("| scene | misfit/noise | whiteness | explained | verdict |\n|---|---|---|---|---|")
    for name in options.names or list(scenes.SETUPS):
        _, found, _ = judged_fit(scenes.scene(name, options.cache))
        ratio = "–" if found.ratio is None else f"{found.ratio:.3f}"
        numbers = (name, ratio, f"{found.white:.2f}", f"{found.explained:.4f}", "warned" if found.poor else "explained")
        print("| " + " | ".join(numbers) + " |", flush=True)


def mistakes(options: argparse.Namespace) -> None:
    """The cell with a deliberate mistake: what the verdict says is wrong."""
    scene = scenes.scene("cell", options.cache)
    declared, wider = scene.acquisition, replace(scene.microscope, condenser=Condenser(0.9))

    def sheared(change: Callable[[float, float], tuple[float, float]]) -> Acquisition:
        prisms = [replace(p, shear=change(*map(float, p.shear))) for p in declared.prisms if p is not None]
        return Acquisition(prisms, declared.focus)

    swapped = Acquisition([declared.prisms[i] for i in (0, 2, 1, 3)], declared.focus)
    made = {
        "shear's sign": replace(scene, acquisition=sheared(lambda y, x: (-y, -x))),
        "focus reversed": replace(scene, acquisition=Acquisition(declared.prisms, [-f for f in declared.focus])),
        "axes exchanged": replace(scene, acquisition=sheared(lambda y, x: (x, y))),
        "two prisms exchanged": replace(scene, acquisition=swapped),
        "mirrored in y": replace(scene, data=scene.data.flip(2)),
        "condenser 0.9 for 0.7": replace(scene, microscope=wider),
        "wavelength 0.633 for 0.546": replace(scene, microscope=replace(scene.microscope, wavelength=0.633)),
        "shear 1.3 times too long": replace(scene, acquisition=sheared(lambda y, x: (1.3 * y, 1.3 * x))),
        "nine hot pixels, counted": replace(scene, data=with_stuck_pixels(scene.data, hot=9)),
        "one image of another plane": replace(
            scene, data=scene.data.index_copy(1, torch.tensor([6]), scene.data[:, 1:2])
        ),
        "one prism's shear reversed": replace(
            scene, acquisition=Acquisition([_reversed(declared.prisms[0]), *declared.prisms[1:]], declared.focus)
        ),
        "cut by the edge, no margin": cut_scene(scene, 28),
    }
    print(
        "| mistake | error | misfit/noise | whiteness | warned | first | second | s of the search |\n"
        + "|---" * 8
        + "|"
    )
    for name in options.names or made:
        found, verdict, seconds = judged_fit(made[name], margin=0 if "margin" in name else None)
        causes = [f"{cause.name} ({cause.share:.0%})" for cause in verdict.causes[:2]] + ["–", "–"]
        numbers = (f"{found.error:.2f}", f"{verdict.ratio or math.nan:.3f}", f"{verdict.white:.2f}")
        cells = (name, *numbers, "yes" if verdict.poor else "no", *causes[:2], f"{seconds:.0f}")
        print("| " + " | ".join(cells) + " |", flush=True)


def _reversed(prism: Prism | None) -> Prism:
    """A prism whose shear points the other way."""
    assert prism is not None
    return replace(prism, shear=tuple(-float(part) for part in prism.shear))


def cut_scene(scene: Scene, columns: int) -> Scene:
    """The part of a scene's field from a column on, whose edge cuts the specimen."""
    nz, ny, nx = scene.grid.shape
    grid = Grid((nz, ny, nx - columns), scene.grid.spacing)
    return replace(scene, data=scene.data[..., columns:], truth=scene.truth[..., columns:], grid=grid)


def judged_fit(scene: Scene, margin: int | None = None) -> tuple[Found, Verdict, float]:
    """A scene's fit, the verdict on it, and the processor seconds that the verdict took.

    margin: voxels beyond the field; None is as many as the images ask for.
    """
    setup, noise = setup_of(scene, margin), measured_noise(scene.data)
    found, recipe = fit(scene, setup=setup), replace(Recipe(), bounds=Bounds(*scene.bounds))
    problem = Problem.from_recipe(scene.data, setup, RECOMMENDED, recipe, noise=noise)
    began, rows = time.process_time(), [(n + 1, found.last.misfit, 0.0, 0.0) for n in range(found.last.number)]
    verdict = judged(problem, model_images(problem, found.last), noise, "newton", rows)
    return found, verdict, time.process_time() - began


def propagations(options: argparse.Namespace) -> None:
    """Rays and projection alone, by both methods."""
    print(HEAD)
    for name in ("bead, clean", "smooth ball"):
        scene = scenes.scene(name, options.cache)
        for fidelity in (Fidelity("projection"), Fidelity("rays", sources=16, steps=10), RECOMMENDED):
            for method in ("newton", "adam"):
                if (fidelity.propagation, method) == ("wave", "adam"):
                    continue
                found = fit(scene, Recipe(method=method, steps=80 if method == "adam" else None), fidelity)
                inside = scene.truth > 0.9 * scene.truth.max()
                centre = float(found.delta[inside].mean() / scene.truth[inside].mean())
                print(row(f"{name}, {fidelity.propagation}, {method}, centre {centre:.2f}", found), flush=True)


def planned_for(options: argparse.Namespace) -> None:
    """Fidelities that are planned for a tolerance: the error, seconds, and the plans' share of these."""
    print("| scene | tolerance | directions | slabs | error | s | plans |\n" + "|---" * 7 + "|")
    for name in options.names or SOME[:4]:
        scene = scenes.scene(name, options.cache)
        for tolerance in (0.1, 0.05, 0.02):
            taken: list[float] = []
            with patch.object(planned, "plan", _timed(planned.plan, taken)):
                found = fit(scene, fidelity=tolerance)
            last = planned.current(found.last.plans)
            seconds = (f"{found.error:.3f}", f"{found.seconds:.1f}", f"{sum(taken) / found.seconds:.0%}")
            print("| " + " | ".join((name, f"{tolerance:g}", str(last.sources), str(last.steps), *seconds)) + " |")


def _timed(function: Callable[..., T], taken: list[float]) -> Callable[..., T]:
    """A function that also notes its processor seconds."""

    def timed(*arguments: object, **more: object) -> T:
        began = time.process_time()
        result = function(*arguments, **more)
        taken.append(time.process_time() - began)
        return result

    return timed


def methods(options: argparse.Namespace) -> None:
    """All methods on SOME scenes: errors."""
    print("| method | " + " | ".join(SOME) + " |\n" + "|---" * (len(SOME) + 1) + "|")
    for name, solve in (("newton", _newton), ("linear", _linear), ("opl", _opl)):
        print(f"| {name} | " + " | ".join(solve(scenes.scene(s, options.cache)) for s in SOME) + " |", flush=True)


def _newton(scene: Scene) -> str:
    found = fit(scene)
    return f"{found.error:.3f} ({found.seconds:.1f} s)"


def _linear(scene: Scene) -> str:
    began = time.process_time()
    found = tikhonov(scene.data, setup_of(scene), measured_noise(scene.data), Bounds(*scene.bounds))
    return f"{volume_error(found.delta, scene.truth):.3f} ({time.process_time() - began:.1f} s)"


def _opl(scene: Scene) -> str:
    began = time.process_time()
    found = path_length(scene.data, setup_of(scene), measured_noise(scene.data))
    return f"{volume_error(found.delta, scene.truth):.3f} ({time.process_time() - began:.1f} s)"


# What an acquisition may hold: which prisms of two shear axes × bias ±90°.
PRISMS = {
    "two axes, ±90°": (0, 1, 2, 3),
    "two axes, 90°": (0, 2),
    "one axis, ±90°": (0, 1),
    "one axis, 90°": (0,),
}
# Planes that are evenly spaced from −4 to 4 µm; one is the middle. All are among the 17.
PLANES = (1, 3, 5, 9, 17)
PHOTONS = (300.0, 1000.0, 4000.0, 40000.0)
USUAL_PLANES, USUAL_PHOTONS = 9, 4000.0


def acquisitions(options: argparse.Namespace) -> None:
    """Errors of the default recipe by planes, shear axes, biases and photons: of the cell and the bead, or those named.

    All stacks of a scene are parts of one noiseless stack of 17 planes, each with noise of its own.
    """
    for name in options.names or ("cell", "bead"):
        most = scenes.acquisition(scenes.SHEARS, (math.pi / 2, -math.pi / 2), [i / 2 for i in range(-8, 9)])
        full = replace(scenes.SETUPS[name](), acquisition=most, photons=None).scene(name, options.cache)
        columns = [*PRISMS, "two axes, ±90°, the light of 9 planes"]
        print(f"\n{name}, {USUAL_PHOTONS:g} photons\n\n| planes | " + " | ".join(columns) + " |")
        print("|---" * (1 + len(columns)) + "|")
        for planes in PLANES:
            found = [fit(part(full, prisms, planes, USUAL_PHOTONS)) for prisms in PRISMS.values()]
            shared = USUAL_PHOTONS * USUAL_PLANES / planes
            found.append(fit(part(full, PRISMS["two axes, ±90°"], planes, shared)))
            print(f"| {planes} | " + " | ".join(f"{f.error:.3f} ({f.mass:.2f})" for f in found) + " |", flush=True)
        some = {which: PRISMS[which] for which in ("two axes, ±90°", "one axis, 90°")}
        print(f"\n{name}, {USUAL_PLANES} planes\n\n| photons | " + " | ".join(some) + " |")
        print("|---" * (1 + len(some)) + "|")
        for photons in PHOTONS:
            found = [fit(part(full, prisms, USUAL_PLANES, photons)) for prisms in some.values()]
            print(f"| {photons:g} | " + " | ".join(f"{f.error:.3f} ({f.mass:.2f})" for f in found) + " |", flush=True)


def part(full: Scene, prisms: Sequence[int], planes: int, photons: float) -> Scene:
    """Some prisms and evenly spaced planes of a noiseless scene, with noise."""
    acquired, number = full.acquisition, len(full.acquisition.focus)
    chosen = [number // 2] if planes == 1 else [i * (number - 1) // (planes - 1) for i in range(planes)]
    images = Camera(photons=photons).record(full.data[list(prisms)][:, chosen], torch.Generator().manual_seed(0))
    focus = [acquired.focus[i] for i in chosen]
    acquisition = Acquisition([acquired.prisms[p] for p in prisms], focus)
    return replace(full, data=images, acquisition=acquisition, photons=photons)


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "scenes": all_scenes,
    "ablation": ablation,
    "acquisitions": acquisitions,
    "nuisances": nuisances,
    "propagations": propagations,
    "planned": planned_for,
    "methods": methods,
    "strong": strong,
    "stuck": stuck,
    "support": support,
    "verdicts": verdicts,
    "mistakes": mistakes,
}


def run_chosen(
    commands: Mapping[str, Callable[[argparse.Namespace], None]],
    description: str | None,
    more: Callable[[argparse.ArgumentParser], object] = lambda _: None,
) -> int:
    """Run one of a script's commands, on one thread. more: adds arguments beside the scenes' names and their cache."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=commands)
    parser.add_argument("names", nargs="*", help="scenes; all without any")
    parser.add_argument("--cache", type=Path, default=scenes.default_cache(), help="folder of scenes' noiseless images")
    more(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for category in (SamplingWarning, WrapAroundWarning):
        warnings.simplefilter("ignore", category)
    commands[options.what](options)
    return 0


def drawn_and_method(parser: argparse.ArgumentParser) -> None:
    """What the table of all scenes takes."""
    parser.add_argument("--drawn", type=int, default=0, help="number of drawn scenes")
    parser.add_argument("--method", choices=("newton", "adam"), default="newton")


if __name__ == "__main__":
    sys.exit(run_chosen(COMMANDS, __doc__, drawn_and_method))
