"""How time and memory grow with voxels, rays, sources, images and steps.

    python benchmarks/scaling.py

Times are process seconds of the forward pass and gradient, the least of several runs in turn. The exponent is the slope
of a straight line through the logarithms. Beside it stands the exponent of the last doubling, in which costs that don't
grow count least. The memory of the steps is what lives between the passes, and at most at once in the backward pass. It
is counted in tensors that the run made, without the volume's gradient, once with everything kept and once with slabs
computed again for a small budget.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from thin_stack import timed
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Rays, Volume, image, trace

STEPS = (16, 32, 64, 128, 256, 512)
REPEATS = 5


def main() -> None:
    """Print each growth."""
    print("| what grows | sizes | process s | exponent | of the last doubling |\n|---|---|---|---|---|")
    row("voxels (of slices, as many rays)", (8, 16, 32, 64), lambda n: traced(8, 16 * n, 256, 8))
    row("voxels and steps (slices)", (8, 16, 32, 64), lambda n: traced(n, 128, 128, n))
    row("rays", (1, 2, 4, 8), lambda n: traced(8, 128, 128, 8, copies=n))
    for propagation in ("projection", "rays", "wave"):
        row(f"sources, {propagation}", (8, 16, 32), lambda n, p=propagation: imaged(p, n, 1, 1))
        row(f"prisms × planes, {propagation}", (32, 64, 128), lambda n, p=propagation: imaged(p, 2, 4, n // 4))
    print(f"\n| steps | {' | '.join(map(str, STEPS))} | exponent |\n{'|---' * (len(STEPS) + 2)}|")
    for name, memory in (("kept, MiB", 1 << 34), ("recomputed, MiB", 1)):
        found = [most(traced(8, 32, 32, steps, memory=memory)) for steps in STEPS]
        cells = " | ".join(f"{b / 2**20:.2f}" for b in found)
        print(f"| {name} | {cells} | {exponent(STEPS, found):.2f} |")


def row(name: str, sizes: tuple[int, ...], made: Callable[[int], Callable]) -> None:
    """A line of the table of times."""
    runs = [made(n) for n in sizes]
    for run in runs:
        run()
    seconds = np.min([[timed(run)[1] for run in runs] for _ in range(REPEATS)], 0).tolist()
    cells = [name, ", ".join(map(str, sizes)), ", ".join(f"{s:.3f}" for s in seconds)]
    cells += [f"{exponent(sizes, seconds):.2f}", f"{exponent(sizes[-2:], seconds[-2:]):.2f}"]
    print("| " + " | ".join(cells) + " |", flush=True)


def exponent(sizes: Sequence[int], values: Sequence[float]) -> float:
    """The slope of log value over log size."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def specimen(slices: int, rows: int, columns: int) -> Volume:
    """A learned volume of smooth waves of index in float32."""
    grid = Grid((slices, rows, columns), (0.2, 0.15, 0.15))
    z, y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float32) for a in range(3)), indexing="ij")
    delta = 0.01 * torch.sin(1.3 * y + 0.4 * z) * torch.cos(0.9 * x - 0.3 * z)
    return Volume(grid, torch.nn.Parameter(delta), 1.36)


def traced(slices: int, rows: int, columns: int, steps: int, *, copies: int = 1, memory: int = 1 << 34) -> Callable:
    """Rays from every voxel of the first slice, traced and differentiated."""
    volume = specimen(slices, rows, columns)
    y, x = (volume.grid.coordinates(a, dtype=torch.float32) for a in (1, 2))
    position = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1).expand(copies, -1, -1, -1).contiguous()
    rays = Rays(position, torch.full_like(position, 0.1), torch.zeros_like(position[..., 0]))

    def run() -> None:
        volume.delta.grad = None
        trace(volume, rays, Fidelity("rays", steps=steps, memory=memory)).opd.square().sum().backward()

    return run


def imaged(propagation: str, sources: int, prisms: int, planes: int) -> Callable:
    """Images and their gradient."""
    volume = specimen(2, 96, 96)
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.6, 0.5 * torch.rand(sources, 2)))
    settings = [Prism((0.0, 0.24), math.pi * (i + 1) / 8) for i in range(prisms)]
    acquisition = Acquisition(settings, [0.3 * i for i in range(planes)])

    def run() -> None:
        volume.delta.grad = None
        fidelity = Fidelity(propagation, memory=1 << 34)  # pyright: ignore[reportArgumentType]
        image(volume, microscope, acquisition, fidelity).square().sum().backward()

    return run


def most(run: Callable) -> int:
    """The most bytes of tensors alive at once, of those that a second run made."""
    run()
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        run()
    assert profiler.profiler is not None
    results: Any = profiler.profiler.kineto_results
    events = sorted((e for e in results.events() if e.name() == "[memory]"), key=lambda e: e.start_ns())
    return int(max(np.cumsum([e.nbytes() for e in events])))


if __name__ == "__main__":
    main()
