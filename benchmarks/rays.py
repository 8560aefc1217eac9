"""Rays through a volume, with the gradient to every voxel: torchdic against other ways to do the same.

    python benchmarks/rays.py [--voxels 64 256 256] [--steps 64] [--repeats 3] [--ways Torchdic Diffrax ...]

Each way of ray_rivals.py runs in a process of its own, in turn with the others; times are the least over the processes
and their three runs each, after a first one that compiles and warms up: wall clock, and in brackets what the process's
threads took together, which a busy machine disturbs less. Memory is the peak of resident memory above what the imports
take. Threads: OMP_NUM_THREADS, NUMBA_NUM_THREADS; JAX takes as many as the process may use (`taskset -c 0`). All solve
the same ODE by as many Runge-Kutta steps of fourth order, through the same smooth random volume, from the same rays, in
float32, and the table shows that they land alike (mean OPD in µm, and the gradient's absolute sum). A package that
isn't installed (`pip install torchdic[bench]`) is reported as missing.
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
    parser.add_argument("--repeats", type=int, default=3, help="processes of each way")
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
            print(row(way, {key: min(r[key] for r in found[way]) for key in found[way][0]}))


def row(way: str, least: dict[str, float]) -> str:
    """A line of the table; a way without a gradient has none."""
    cells = [f"{least['forward']:.2f} s ({least['forward process']:.2f})", f"{least['forward peak']:.0f} MiB"]
    if "gradient" in least:
        cells += [f"{least['gradient']:.2f} s ({least['gradient process']:.2f})", f"{least['gradient peak']:.0f} MiB"]
    else:
        cells += ["", ""]
    cells += [f"{least['mean OPD']:.6f}", f"{least['gradient sum']:.4g}" if "gradient" in least else ""]
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
    found["forward"], found["forward process"], (_, opd) = best(trial.forward)
    found["forward peak"] = peak() - imported
    found["mean OPD"] = float(opd.mean())
    if hasattr(trial, "gradient"):
        found["gradient"], found["gradient process"], gradient = best(trial.gradient)
        found["gradient peak"] = peak() - imported
        found["gradient sum"] = float(np.abs(gradient).sum())
    return found


def best(run: Callable) -> tuple:
    """Seconds of the best of three runs after a first one, of the process's threads together, and what they gave."""
    result, seconds, process = run(), [], []
    for _ in range(3):
        start, used = time.perf_counter(), time.process_time()
        result = run()
        seconds.append(time.perf_counter() - start)
        process.append(time.process_time() - used)
    return min(seconds), min(process), result


def peak() -> float:
    """The most memory that this process has held, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
