"""Rays through a volume, with the gradient to every voxel: torchdic against other ways to do the same.

    python benchmarks/rays.py [--voxels 64 256 256] [--steps 64] [--repeats 5] [--pause 0] [--ways Torchdic ...]

Each way of ray_rivals.py runs in processes of its own, in turn with the others. After a pause the host of a virtual
machine has taken back the memory of the process before, and the next process gets its memory anew, more slowly. A
process's time is the least of three runs by wall clock, after a first run that compiles and warms up. The table has the
median over the processes, and in brackets the least and the most. Memory is the peak of resident memory above what the
imports take, treated alike. Threads are set by OMP_NUM_THREADS and NUMBA_NUM_THREADS; JAX takes as many as the process
may use (`taskset -c 0`). All ways solve the same ODE by as many Runge-Kutta steps of fourth order, through the same
smooth random volume, from the same rays, in float32. The table shows that they agree (mean OPD in µm, and the absolute
sum of the gradient). A package that isn't installed (`pip install torchdic[bench]`) is reported as missing.
"""

import argparse
import importlib
import importlib.util
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from statistics import median

import numpy as np
from scipy.ndimage import gaussian_filter

import ray_rivals

# Each way and what it imports.
WAYS = {
    "Torchdic": ["torch", "torchdiffeq", "torchdic"],
    "TorchdicRecomputing": ["torch", "torchdiffeq", "torchdic"],
    "Torchdiffeq2d": ["torch", "torchdiffeq"],
    "Torchdiffeq3d": ["torch", "torchdiffeq"],
    "Diffrax": ["jax", "diffrax"],
    "Numba": ["numba"],
}


def main() -> None:
    """Run every way in turn and print the table."""
    parser = argparse.ArgumentParser(description="Rays through a volume: torchdic against other ways.")
    parser.add_argument("--voxels", type=int, nargs=3, default=(64, 256, 256))
    parser.add_argument("--steps", type=int, default=64)
    parser.add_argument("--repeats", type=int, default=5, help="processes of each way")
    parser.add_argument("--pause", type=float, default=0, help="idle seconds before each process")
    parser.add_argument("--ways", nargs="+", choices=list(WAYS), default=list(WAYS))
    parser.add_argument("--alone", choices=list(WAYS), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    shape, steps = tuple(arguments.voxels), arguments.steps
    if arguments.alone:
        print(json.dumps(measure(arguments.alone, shape, steps)))
        return
    found: dict[str, list[dict[str, float]]] = {way: [] for way in arguments.ways}
    missing = {way: [m for m in WAYS[way] if importlib.util.find_spec(m) is None] for way in arguments.ways}
    for _ in range(arguments.repeats):
        for way in arguments.ways:
            if not missing[way]:
                time.sleep(arguments.pause)
                command = [sys.executable, __file__, *sys.argv[1:], "--alone", way]
                done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
                found[way].append(json.loads(done.stdout.splitlines()[-1]))
    print(f"{'×'.join(map(str, shape))} voxels, {shape[1] * shape[2]} rays, {steps} steps, float32\n")
    print("| way | forward | peak | forward and gradient | peak | mean OPD | gradient |")
    print("|---|---|---|---|---|---|---|")
    for way in arguments.ways:
        if missing[way]:
            print(f"| {way} | not installed: {', '.join(missing[way])} | | | | | |")
        else:
            print(row(way, {key: [run[key] for run in found[way]] for key in found[way][0]}))


def row(way: str, runs: dict[str, list[float]]) -> str:
    """A line of the table. A way without a gradient has empty cells for it."""
    cells = []
    for run in ("forward", "gradient"):
        if run not in runs:
            cells += ["", ""]
            continue
        seconds, peaks = runs[run], runs[f"{run} peak"]
        cells.append(f"{median(seconds):.2f} s ({min(seconds):.2f}–{max(seconds):.2f})")
        cells.append(f"{median(peaks):.0f} MiB")
    cells.append(f"{runs['mean OPD'][0]:.6f}")
    cells.append(f"{runs['gradient sum'][0]:.4g}" if "gradient sum" in runs else "")
    return f"| {way} | {' | '.join(cells)} |"


def measure(way: str, shape: tuple[int, ...], steps: int) -> dict[str, float]:
    """Seconds and peak MiB of one way, in this process."""
    for module in WAYS[way]:
        importlib.import_module(module)
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(shape), 4)
    delta = (0.02 * noise / noise.std()).astype(np.float32)
    imported = peak()
    trial = getattr(ray_rivals, way)(delta, steps)
    found = {}
    found["forward"], (_, opd) = best(trial.forward)
    found["forward peak"] = peak() - imported
    found["mean OPD"] = float(opd.mean())
    if hasattr(trial, "gradient"):
        found["gradient"], gradient = best(trial.gradient)
        found["gradient peak"] = peak() - imported
        found["gradient sum"] = float(np.abs(gradient).sum())
    return found


def best(run: Callable) -> tuple:
    """Seconds of the best of three runs after a first one, and what they gave."""
    result, seconds = run(), []
    for _ in range(3):
        start = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - start)
    return min(seconds), result


def peak() -> float:
    """The most memory in MiB that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
