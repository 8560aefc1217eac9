"""A field without room in memory, reconstructed in tiles: the most memory that the process has had, and its seconds.

    OMP_NUM_THREADS=1 python benchmarks/large_field.py [--side 1024] [--memory 3] [--limit 10] [--out large_field]

The stack is that of 31 slices and planes of a cell, simulated on 128×128 pixels and repeated, with noise of its own: a
field of cells in rows. The process may have `--limit` GiB of addresses, in which the field has no room whole, and
`fidelity.memory` is `--memory` GiB. It takes one step with two condenser directions: they need as much memory as all.
"""

import argparse
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch

from torchdic.files.stack import read_stack, write_stack

CELL = 128
CONFIG = """
[volume]
shape = [31, {side}, {side}]
spacing = [0.3, 0.12, 0.12]
background = 1.33
[microscope]
wavelength = 0.55
objective = {{ na = 0.9 }}
condenser = {{ na = 0.6 }}
camera = {{ photons = 20000 }}
[acquisition]
focus = {{ first = -4.5, step = 0.3, count = 31 }}
prisms = [{{ shear = [0.0, 0.24], bias = 1.5708 }}]
[fidelity]
sources = {sources}
memory = {memory}
[data]
path = "{stack}"
"""
SPECIMEN = '[specimen]\nkind = "cell"\n'
ONE_STEP = "[reconstruction]\nsteps = 1\n"
NOISE = 0.007


def run(*words: str, limit: int | None = None) -> str:
    """Run a command of torchdic, which must succeed; returns what it said. limit: bytes of addresses."""

    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    command = [sys.executable, "-m", "recon", *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limited)
    if done.returncode != 0:
        sys.exit(done.stderr)
    return done.stdout


def repeated(path: Path, cell: Path, times: int) -> None:
    """Write the field's stack: a cell's, repeated along y and x, with noise."""
    images = np.tile(read_stack(cell).data, (1, 1, times, times)).astype(np.float32)
    images += NOISE * np.random.default_rng(0).standard_normal(images.shape, dtype=np.float32)
    write_stack(path, torch.from_numpy(images), (0.12, 0.12), 0.3)


def main() -> None:
    """Make the stack, reconstruct it and print a row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("large_field"))
    parser.add_argument("--side", type=int, default=1024)
    parser.add_argument("--memory", type=float, default=3.0)
    parser.add_argument("--limit", type=float, default=10.0)
    options = parser.parse_args()
    out, memory = options.out, int(options.memory * 2**30)
    out.mkdir(parents=True, exist_ok=True)
    cell, field = out / "cell.toml", out / "field.toml"
    cell.write_text(CONFIG.format(side=CELL, sources=18, memory=memory, stack="none.tif") + SPECIMEN, encoding="utf-8")
    run("simulate", str(cell), "--out", str(out / "cell"), "--restart")
    repeated(out / "field.ome.tif", out / "cell" / "stack.ome.tif", options.side // CELL)
    told = CONFIG.format(side=options.side, sources=2, memory=memory, stack="field.ome.tif")
    field.write_text(told + ONE_STEP, encoding="utf-8")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    limit = int(options.limit * 2**30)
    said = run("reconstruct", str(field), "--out", str(out / "volume"), "--restart", limit=limit)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    found = re.search(r"(\d+) tiles of (.*?) and (\d+) more", said)
    tiles = "whole" if found is None else f"{found[1]} of {found[2]}, margin {found[3]}"
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    print("| field | fidelity.memory | tiles | most memory of the process | processor seconds |")
    print("|---|---|---|---|---|")
    size = f"31×{options.side}×{options.side}"
    print(f"| {size} | {options.memory:g} GiB | {tiles} | {after.ru_maxrss / 2**20:.2f} GiB | {seconds:.0f} |")


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
