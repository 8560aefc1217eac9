"""What a run is foreseen to take before its first step, beside what it takes.

    OMP_NUM_THREADS=1 python benchmarks/forecast.py [--scenes NAME ...]

The trial and the steps are timed by the processor's clock, because cores that other programs share have no other that
tells anything. Memory is what a descent's tensors hold at once, foreseen and as they are counted while it runs.
"""

import argparse
import time
import warnings
from collections import deque
from dataclasses import dataclass, replace

import scenes
from recon.descend import Problem, Recipe, minimise
from recon.fit.bounds import Bounds
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from recon.report.forecast import Forecast
from recon.run.reconstruct import RECOMMENDED, RECOMMENDED_FOR_ADAM
from recon.run.room import bytes_held
from torchdic.memory.held import course_of, most


@dataclass(frozen=True)
class Run:
    """A scene's name, the method, and how many of its planes and voxels along each side are fitted."""

    scene: str
    method: str = "newton"
    planes: int | None = None
    side: int | None = None


RUNS = (
    Run("two beads"),
    Run("cell"),
    Run("fibres", planes=5),
    Run("graded", side=48),
    Run("strong bead"),
    Run("two beads", "adam"),
)


def problem_of(run: Run) -> Problem:
    """What a run fits."""
    scene = scenes.scene(run.scene, scenes.default_cache())
    grid, data, focus = scene.grid, scene.data, scene.acquisition.focus
    if run.planes is not None:
        first = (len(focus) - run.planes) // 2
        data, focus = data[:, first : first + run.planes], focus[first : first + run.planes]
    if run.side is not None:
        off = (grid.shape[1] - run.side) // 2
        data = data[..., off : off + run.side, off : off + run.side]
        grid = replace(grid, shape=(grid.shape[0], run.side, run.side))
    acquisition = replace(scene.acquisition, focus=focus)
    setup = Setup(empty_medium(grid, scene.background, data), scene.microscope, acquisition)
    fidelity = RECOMMENDED if run.method == "newton" else RECOMMENDED_FOR_ADAM
    recipe = Recipe(run.method, bounds=Bounds(*scene.bounds))  # pyright: ignore[reportArgumentType]
    return Problem.from_recipe(data.contiguous(), setup, fidelity, recipe, GaussianMisfit, scene.noise)


def main() -> None:
    """Print a row for each run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", choices=sorted({run.scene for run in RUNS}))
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    time.perf_counter = time.process_time
    print("| run | voxels, images | foreseen, s | taken, s | ratio | steps | foreseen, MiB | held, MiB |")
    print("|---|---|---|---|---|---|---|---|")
    for run in RUNS:
        if options.scenes and run.scene not in options.scenes:
            continue
        problem = problem_of(run)
        foreseen, memory = Forecast(problem).whole(), bytes_held(problem, GaussianMisfit)
        assert foreseen is not None
        began = time.process_time()
        last = deque(minimise(problem), maxlen=1).pop()
        taken = time.process_time() - began
        few = replace(problem, steps=min(problem.steps, 9))
        held = most(course_of(lambda few=few: deque(minimise(few), maxlen=1)))
        size = "×".join(map(str, problem.setup.volume.grid.shape))
        images = "×".join(map(str, problem.misfit.data.shape[:2]))
        print(
            f"| {run.scene}, {run.method} | {size}, {images} | {foreseen:.0f} | {taken:.0f} | {taken / foreseen:.2f} "
            f"| {last.number} | {memory / 2**20:.0f} | {held / 2**20:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
