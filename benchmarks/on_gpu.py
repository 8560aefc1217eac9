"""What a GPU makes of this: the CPU's numbers, its memory's bandwidth, and a whole reconstruction.

    python benchmarks/on_gpu.py [--parts check rays wave volume waits] [--small] [--device cuda]

check: images and their gradient beside the CPU's, by each propagation.
rays: there is one ray from each voxel of the first face of 256×1024×1024. The bytes that must move are counted as if
every evaluation were one fused kernel. In the forward pass each ray's δy, δx, δp_y, δp_x and W are read and written,
and its three sampled values are written. In the backward pass the sampled values are read, and the five derivatives
are read and written. Two slices are read in either pass, and their derivatives are read and written in the backward
one.
wave: images of 40×512×512 voxels. A split step of second order has four FFTs, each of which reads and writes the field
twice, and two products, each of which reads field and factor and writes the field; the backward pass has them again,
after the forward one.
These bytes over the time are a bandwidth, which is compared with that of a copy within the device.
volume: a reconstruction of 40×512×512 voxels from 2 prisms × 40 planes, its seconds, its peak memory and its error.
waits: how often the host waits for the device in a step of Newton's and one of Adam's, by PyTorch's profiler.
`--small` takes a hundredth of the voxels, to try the code; without a GPU `--device cpu --small` does.
"""

import argparse
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import torch
from torch import Tensor
from torch.nn import Parameter

from recon.descend import Problem, Recipe, Step, minimise
from recon.fit.setup import Setup, empty_medium
from recon.report.metrics import volume_error
from recon.run.reconstruct import RECOMMENDED
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Rays, Volume, image, trace
from torchdic.planning.cost import timed
from torchdic.rays.solver import TABLEAUX

RAY_FORWARD, RAY_BACKWARD = 2 * 5 + 3, 3 + 2 * 5
SLICE_FORWARD, SLICE_BACKWARD = 2, 2 + 2 * 2


# of a split step of second order, in fields that are read or written
OF_STEP = 4 * 2 * 2 + 2 * 3
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7))
# µm between the specimen's balls, and from its border to those next to it at least
APART = 6.0
PARTS = ("check", "rays", "wave", "volume", "waits")


def main() -> None:
    """Print what was measured, or why nothing was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--device", default="cuda")
    arguments = parser.parse_args()
    if arguments.device.startswith("cuda") and not torch.cuda.is_available():
        print("no CUDA device is there: nothing measured (--device cpu --small tries the code)")
        return
    warnings.simplefilter("ignore")
    device = torch.device(arguments.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    bandwidth = copy_bandwidth(device)
    print(f"{name}, torch {torch.__version__}; a copy within the device: {bandwidth / 1e9:.0f} GB/s")
    for part in arguments.parts:
        began = time.perf_counter()
        print(f"\n{part}:\n")
        {"check": check, "rays": rays, "wave": wave, "volume": volume, "waits": waits}[part](
            device, bandwidth, arguments.small
        )
        print(f"\n({time.perf_counter() - began:.0f} s)", flush=True)


def check(device: torch.device, _: float, small: bool) -> None:
    """Images and their gradient to Δn beside the CPU's."""
    side = 32 if small else 128
    print("| propagation | largest difference of images | of gradients, over their largest |\n|---|---|---|")
    for propagation in ("projection", "rays", "wave"):
        found = []
        for where in (torch.device("cpu"), device):
            volume, acquisition = specimen((8, side, side), where), recording(3)
            images = image(volume, MICROSCOPE, acquisition, Fidelity(propagation, sources=18))
            images.square().sum().backward()
            assert volume.delta.grad is not None
            found.append((images.detach().cpu(), volume.delta.grad.cpu()))
        (images, gradient), (theirs, their_gradient) = found
        off = (
            float((images - theirs).abs().max()),
            float((gradient - their_gradient).abs().max() / gradient.abs().max()),
        )
        print(f"| {propagation} | {off[0]:.1e} | {off[1]:.1e} |")


def specimen(shape: tuple[int, int, int], device: torch.device) -> Volume:
    """A learned volume of balls of 3 µm in rows, on voxels that suit the microscope."""
    grid = Grid(shape, (0.3, 0.15, 0.15))
    z, y, x = (grid.coordinates(axis, dtype=torch.float32, device=device) for axis in range(3))
    most = [APART * max(0, int((float(a[-1]) - APART / 2) / APART)) for a in (y, x)]
    centres = [(APART * (a / APART).round()).clamp(-end, end) for a, end in zip((y, x), most, strict=True)]
    off = [(a - centre).square() for a, centre in zip((y, x), centres, strict=True)]
    radius = (z.square()[:, None, None] + off[0][:, None] + off[1]).sqrt()
    return Volume(grid, Parameter(0.02 * torch.sigmoid((min(1.5, grid.extent[0] / 3) - radius) / 0.1)), 1.36)


def recording(planes: int) -> Acquisition:
    """Two shear axes and so many planes."""
    focus = [0.3 * (i - (planes - 1) / 2) for i in range(planes)]
    return Acquisition([Prism((0.0, 0.24), 1.57), Prism((0.24, 0.0), 1.57)], focus)


def wave(device: torch.device, bandwidth: float, small: bool) -> None:
    """Images by the wave, and their gradient."""
    shape, sources = (8, 64, 64) if small else (40, 512, 512), 8
    volume, acquisition = specimen(shape, device), recording(1)
    fidelity = Fidelity("wave", sources=sources, memory=room(device))

    def forward() -> None:
        with torch.no_grad():
            image(volume, MICROSCOPE, acquisition, fidelity)

    def both() -> None:
        volume.delta.grad = None
        image(volume, MICROSCOPE, acquisition, fidelity).square().sum().backward()

    nz, ny, nx = shape
    print(f"{nz}×{ny}×{nx} voxels, {sources} directions, one plane of two prisms\n")
    fields = 8 * nz * ny * nx * sources * OF_STEP
    table(device, bandwidth, 5, (("forward", forward, fields), ("forward and gradient", both, 2 * fields)))


def volume(device: torch.device, _: float, small: bool) -> None:
    """A whole reconstruction."""
    problem, truth = field((8, 48, 48) if small else (40, 512, 512), device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    found: deque[Step] = deque(maxlen=1)
    seconds = timed(lambda: found.extend(minimise(problem)), 1, device)[0]
    last, peak = found.pop(), memory_of(device)
    size, images = ("×".join(map(str, shape)) for shape in (truth.shape, problem.misfit.data.shape[:2]))
    print(f"{size} voxels, {images} images: {seconds:.0f} s, {last.number} steps")
    print(f"peak {peak} GiB, error {volume_error(last.delta, truth):.3f}, misfit {last.misfit:.4g}")


def field(shape: tuple[int, int, int], device: torch.device) -> tuple[Problem, Tensor]:
    """A stack with noise of a known volume, to be fitted, and Δn."""
    known, acquisition = specimen(shape, device), recording(shape[0])
    truth = known.delta.detach()
    with torch.no_grad():
        images = image(known, MICROSCOPE, acquisition, Fidelity(sources=72, memory=room(device)))
    generator = torch.Generator(device).manual_seed(0)
    data = images + 0.005 * torch.randn(images.shape, generator=generator, device=device)
    setup = Setup(empty_medium(known.grid, 1.36, data), MICROSCOPE, acquisition)
    fidelity = replace(RECOMMENDED, memory=room(device))
    return Problem.from_recipe(data, setup, fidelity, Recipe(), noise=[0.005] * len(data)), truth


def waits(device: torch.device, _: float, small: bool) -> None:
    """Calls by which the host waits for the device, in one step."""
    if device.type != "cuda":
        print("a CPU is not waited for")
        return
    problem = field((8, 48, 48) if small else (16, 256, 256), device)[0]
    for method, before in (("newton", 6), ("adam", 2)):
        steps = minimise(replace(problem, method=method))
        deque(islice(steps, before), maxlen=0)
        kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
        with torch.profiler.profile(activities=kinds) as profile:
            next(steps)
        calls = Counter(event.name for event in profile.events() or () if "Synchronize" in event.name)
        print(f"{method}: {dict(calls)}")


def rays(device: torch.device, bandwidth: float, small: bool) -> None:
    """Rays and their gradient."""
    (nz, ny, nx), steps = ((16, 64, 64), 16) if small else ((256, 1024, 1024), 256)
    volume, bundle = scene((nz, ny, nx), device)
    fidelity = Fidelity("rays", steps=steps, memory=room(device))

    def forward() -> None:
        with torch.no_grad():
            trace(volume, bundle, fidelity)

    def both() -> None:
        volume.delta.grad = None
        trace(volume, bundle, fidelity).opd.square().sum().backward()

    print(f"{nz}×{ny}×{nx} voxels, {ny * nx} rays, {steps} RK4 steps\n")
    each = 4 * steps * len(TABLEAUX[fidelity.solver][1]) * ny * nx
    of_forward, of_both = RAY_FORWARD - 3 + SLICE_FORWARD, RAY_FORWARD + RAY_BACKWARD + SLICE_FORWARD + SLICE_BACKWARD
    table(
        device, bandwidth, 5, (("forward", forward, each * of_forward), ("forward and gradient", both, each * of_both))
    )


def table(
    device: torch.device, bandwidth: float, repeats: int, passes: tuple[tuple[str, Callable[[], None], int], ...]
) -> None:
    """A row for each pass. passes: name, what is run, and the bytes that must move."""
    print("| pass | s | GB that must move | GB/s | of the copy's | peak GiB |\n|---|---|---|---|---|---|")
    for label, run, moved in passes:
        seconds, peak = best(run, device, repeats)
        rate = moved / seconds
        cells = [label, f"{seconds:.3f}", f"{moved / 1e9:.1f}", f"{rate / 1e9:.1f}", f"{rate / bandwidth:.1%}", peak]
        print("| " + " | ".join(cells) + " |")


def room(device: torch.device) -> int:
    """Half of the free memory: it may hold what the backward pass reads."""
    return torch.cuda.mem_get_info(device)[0] // 2 if device.type == "cuda" else 1 << 30


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
    return min(seconds), memory_of(device)


def memory_of(device: torch.device) -> str:
    """The most GiB of the device's memory that were taken at once."""
    return f"{torch.cuda.max_memory_allocated(device) / 2**30:.1f}" if device.type == "cuda" else "not measured"


def copy_bandwidth(device: torch.device) -> float:
    """Bytes per second, read and written, when a large tensor is copied."""
    source = torch.zeros((1 << 28) if device.type == "cuda" else (1 << 24), device=device)
    target = torch.empty_like(source)
    seconds, _ = best(lambda: target.copy_(source), device, 10)
    return 2 * source.nbytes / seconds


if __name__ == "__main__":
    main()
