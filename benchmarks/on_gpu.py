"""Rays and their gradient on a GPU, and the fraction of its memory's bandwidth that they reach.

    python benchmarks/on_gpu.py [--voxels 256 1024 1024] [--steps 256] [--device cuda]

There is one ray from each voxel of the first face. The bytes that must move are counted as if every evaluation were one
fused kernel. In the forward pass each ray's δy, δx, δp_y, δp_x and W are read and written, and its three sampled values
are written. In the backward pass the sampled values are read, and the five derivatives are read and written. Two slices
are read in either pass, and their derivatives are read and written in the backward one. These bytes over the time are a
bandwidth, which is compared with that of a copy within the device.
"""

import argparse
from collections.abc import Callable

import torch
from torch.nn import Parameter

from torchdic import Fidelity, Grid, Rays, Volume, trace
from torchdic.planning.cost import timed
from torchdic.rays.solver import TABLEAUX

RAY_FORWARD, RAY_BACKWARD = 2 * 5 + 3, 3 + 2 * 5
SLICE_FORWARD, SLICE_BACKWARD = 2, 2 + 2 * 2


def main() -> None:
    """Print times and bandwidths, or why there are none."""
    parser = argparse.ArgumentParser(description="Rays and their gradient on a GPU.")
    parser.add_argument("--voxels", type=int, nargs=3, default=(256, 1024, 1024))
    parser.add_argument("--steps", type=int, default=256)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cuda")
    arguments = parser.parse_args()
    if arguments.device.startswith("cuda") and not torch.cuda.is_available():
        print("no CUDA device is there: nothing measured (--device cpu --voxels 16 64 64 --steps 16 tries the code)")
        return
    device = torch.device(arguments.device)
    nz, ny, nx = arguments.voxels
    volume, rays = scene((nz, ny, nx), device)
    # half of the free memory may hold what the backward pass reads
    memory = torch.cuda.mem_get_info(device)[0] // 2 if device.type == "cuda" else 1 << 34
    fidelity = Fidelity("rays", steps=arguments.steps, memory=memory)

    def forward() -> None:
        with torch.no_grad():
            trace(volume, rays, fidelity)

    def both() -> None:
        volume.delta.grad = None
        trace(volume, rays, fidelity).opd.square().sum().backward()

    bandwidth = copy_bandwidth(device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    print(f"{name}, torch {torch.__version__}: {nz}×{ny}×{nx} voxels, {ny * nx} rays, {arguments.steps} RK4 steps")
    print(f"copy within the device: {bandwidth / 1e9:.0f} GB/s\n")
    print("| pass | s | GB that must move | GB/s | of the copy's | peak GiB |\n|---|---|---|---|---|---|")
    evaluations = arguments.steps * len(TABLEAUX[fidelity.solver][1])
    for label, run, per_ray, per_voxel in (
        ("forward", forward, RAY_FORWARD - 3, SLICE_FORWARD),
        ("forward and gradient", both, RAY_FORWARD + RAY_BACKWARD, SLICE_FORWARD + SLICE_BACKWARD),
    ):
        seconds, peak = best(run, device, arguments.repeats)
        moved = 4 * evaluations * ny * nx * (per_ray + per_voxel)
        rate = moved / seconds
        cells = [label, f"{seconds:.3f}", f"{moved / 1e9:.1f}", f"{rate / 1e9:.1f}", f"{rate / bandwidth:.1%}", peak]
        print("| " + " | ".join(cells) + " |")


def scene(shape: tuple[int, int, int], device: torch.device) -> tuple[Volume, Rays]:
    """A smooth, learned volume, and a ray from each voxel of its first face."""
    grid = Grid(shape, (0.1, 0.1, 0.1))
    z, y, x = (grid.coordinates(axis, dtype=torch.float32, device=device) for axis in range(3))
    delta = torch.sin(1.1 * z)[:, None, None] * torch.cos(0.9 * y)[:, None] * torch.sin(0.7 * x + 0.4)
    position = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1).reshape(-1, 2)
    momentum = torch.tensor([0.2, -0.1], device=device).expand_as(position)
    return Volume(grid, Parameter(0.01 * delta), 1.36), Rays(position, momentum, torch.zeros_like(position[:, 0]))


def best(run: Callable, device: torch.device, repeats: int) -> tuple[float, str]:
    """Seconds of the best run after a first one, and the peak of the device's memory."""
    run()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    seconds = timed(run, repeats, device)
    peak = f"{torch.cuda.max_memory_allocated(device) / 2**30:.1f}" if device.type == "cuda" else "not measured"
    return min(seconds), peak


def copy_bandwidth(device: torch.device) -> float:
    """Bytes per second, read and written, when a large tensor is copied."""
    source = torch.zeros((1 << 28) if device.type == "cuda" else (1 << 24), device=device)
    target = torch.empty_like(source)
    seconds, _ = best(lambda: target.copy_(source), device, 10)
    return 2 * source.nbytes / seconds


if __name__ == "__main__":
    main()
