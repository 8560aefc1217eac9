"""An image by waves, and its gradient, against the Fourier transforms that they can't do without.

    OMP_NUM_THREADS=1 python benchmarks/transforms.py [--repeats 9]

The scenes have 4 prisms at 9 planes, in float32. For each source, a slab of order 1 takes 2 transforms, a slab of order
2 takes 4, and each image takes 1. A gradient takes as many again. The bare transforms are as many complex FFTs of
arrays of the same shape, all of a batch's sources in one call, and nothing else. Image, gradient and transforms run in
turn. Ratios are those of the least process seconds of each.
Sources on a condenser's rings have equal |p0|, and their screens are the same. On a spiral no two are.
"""

import argparse
import math
import time
import warnings
from collections.abc import Callable
from itertools import product

import torch
from torch import Tensor

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

# Voxels (z, y, x) and sources.
SCENES = (((24, 128, 128), 24), ((20, 64, 64), 18), ((20, 64, 64), 40))
PRISMS = tuple(Prism(s, b) for s in ((0.0, 0.24), (0.24, 0.0)) for b in (math.pi / 2, -math.pi / 2))
FOCUS = tuple(0.5 * (i - 4) for i in range(9))
CONDENSERS = {"rings": lambda count: Condenser(0.6), "spiral": lambda count: Condenser(0.6, spiral(count))}


def main() -> None:
    """Print the ratios of each scene."""
    parser = argparse.ArgumentParser(description="Waves against bare Fourier transforms.")
    parser.add_argument("--repeats", type=int, default=9)
    repeats = parser.parse_args().repeats
    print("| voxels | sources | order | transforms, ms | image | image and gradient |\n|---|---|---|---|---|---|")
    for shape, count in SCENES:
        for (name, condenser), order in product(CONDENSERS.items(), (1, 2)):
            microscope = Microscope(0.546, Objective(0.9), condenser(count))
            bare, forward, both = measured(shape, microscope, Fidelity("wave", order=order, sources=count), repeats)
            print(
                f"| {'×'.join(map(str, shape))} | {count}, {name} | {order} | {1e3 * bare:.1f} | "
                f"{forward / bare:.2f} | {both / (2 * bare):.2f} |",
                flush=True,
            )


def spiral(count: int) -> Tensor:
    """Points (source, 2) that fill a disc of radius 0.6 evenly, no two at the same distance from the axis."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    radius, angle = 0.6 * (i / count).sqrt(), i * math.pi * (3 - math.sqrt(5))
    return torch.stack((radius * angle.sin(), radius * angle.cos()), 1)


def measured(shape: tuple[int, int, int], microscope: Microscope, fidelity: Fidelity, repeats: int) -> list[float]:
    """Least process seconds of the forward pass's bare transforms, of the image, and of image and gradient."""
    torch.manual_seed(0)
    grid = Grid(shape, (0.4, 0.2, 0.2))
    delta = torch.nn.functional.avg_pool3d(torch.randn(1, *shape), 5, 1, 2)[0]
    volume = Volume(grid, torch.nn.Parameter(0.01 * delta), 1.36)
    acquisition = Acquisition(PRISMS, FOCUS)
    sources = len(microscope.sources(fidelity.sources)[1])
    transforms = 2 * fidelity.order * shape[0] + len(PRISMS) * len(FOCUS)
    field = torch.randn(sources, *shape[1:], dtype=torch.complex64)

    def bare() -> None:
        for _ in range(transforms):
            torch.fft.fft2(field)

    def forward() -> None:
        with torch.no_grad():
            image(volume, microscope, acquisition, fidelity)

    def both() -> None:
        volume.delta.grad = None
        image(volume, microscope, acquisition, fidelity).square().sum().backward()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the voxels are a little coarse for the light
        seconds = [[process_seconds(run) for run in (bare, forward, both)] for _ in range(repeats + 1)]
    return [min(column) for column in zip(*seconds[1:], strict=True)]


def process_seconds(run: Callable[[], None]) -> float:
    """Process seconds of one run."""
    start = time.process_time()
    run()
    return time.process_time() - start


if __name__ == "__main__":
    main()
