"""Rays through a volume, with the gradient to every voxel: torchdic against other ways to do the same.

    python benchmarks/rays.py [--repeats 3] [--voxels 64 256 256] [--steps 64] [--device cpu]

Each way runs in a process of its own, several times in turn with the others; seconds are medians after one warm-up run,
memory is the peak above what the imports take (on a GPU, of the allocator). All integrate the ray ODE of torchdic.rays
by the same RK4 steps in float32, through the same random smooth volume, from the same rays, and must agree on where the
rays land before their times count. A package that isn't installed (`pip install torchdic[bench]`) is reported as missing.
"""

import argparse
import importlib.util
import json
import math
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

BACKGROUND = 1.36
VOXEL = 0.1  # µm
DIRECTION = (0.2, -0.1)  # n·sinθ, (y, x)


def main() -> None:
    """Run every way in turn and print the table."""
    arguments = _arguments()
    if arguments.way:
        print(json.dumps(_measure(arguments)))
        return
    results: dict[str, list[dict]] = {}
    for _ in range(arguments.repeats):
        for name, way in WAYS.items():
            missing = [m for m in way.needs if importlib.util.find_spec(m) is None]
            if missing:
                results[name] = [{"missing": ", ".join(missing)}]
                continue
            command = [sys.executable, __file__, "--way", name, *sys.argv[1:]]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            results.setdefault(name, []).append(json.loads(done.stdout.splitlines()[-1]))
    _print(results, arguments)


def _print(results: dict[str, list[dict]], arguments: argparse.Namespace) -> None:
    nz, ny, nx = arguments.voxels
    print(f"{nz}×{ny}×{nx} voxels, {ny * nx} rays, {arguments.steps} RK4 steps, float32, {arguments.device}\n")
    print("| way | forward s | forward and gradient s | forward: peak MiB | with gradient: peak MiB | landing |")
    print("|---|---|---|---|---|---|")
    for name, runs in results.items():
        if "missing" in runs[0]:
            print(f"| {name} | not installed: {runs[0]['missing']} | | | | |")
            continue
        middle = {
            key: statistics.median(r[key] for r in runs) if runs[0][key] is not None else math.nan for key in runs[0]
        }
        print(
            f"| {name} | {middle['forward']:.2f} | {middle['gradient']:.2f} | {middle['forward_bytes'] / 2**20:.0f} "
            f"| {middle['gradient_bytes'] / 2**20:.0f} | {middle['landing']:.6f} |"
        )
