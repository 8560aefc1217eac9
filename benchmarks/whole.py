"""A whole forward pass and gradient: 13 sources, 9 focus planes, 4 prisms, by each propagation.

    python benchmarks/whole.py [--voxels 64 256 256] [--repeats 3] [--propagations projection rays wave]

Each propagation runs in a process of its own, in float32, with the default memory budget. Seconds are the least of the
repeats, by wall clock and of the process's threads together. The peak of resident memory is above what the imports
take. Transforms are counted in the forward pass, for each source. Beside them stands the smallest number that the
method needs: an inverse transform for each source, prism and plane, and before it one of each source's field
(projection, rays) or 4 for each source and slab (wave).
"""

import argparse
import json
import math
import subprocess
import sys
from unittest import mock

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from rays import peak
from thin_stack import timed
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

PROPAGATIONS: tuple[str, ...] = ("projection", "rays", "wave")
SOURCES = 13
FOCUS = tuple(float(z) for z in np.linspace(-2, 2, 9))
PRISMS = tuple(Prism(s, b) for s in ((0.0, 0.24), (0.24, 0.0)) for b in (math.pi / 2, -math.pi / 2))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="A whole forward pass and gradient by each propagation.")
    parser.add_argument("--voxels", type=int, nargs=3, default=(64, 256, 256))
    parser.add_argument("--repeats", type=int, default=3, help="the first has to get its memory from the system")
    parser.add_argument("--propagations", nargs="+", choices=PROPAGATIONS, default=PROPAGATIONS)
    parser.add_argument("--alone", choices=PROPAGATIONS, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    shape = tuple(arguments.voxels)
    if arguments.alone:
        print(json.dumps(measure(arguments.alone, shape, arguments.repeats)))
        return
    counts = f"{SOURCES} sources, {len(FOCUS)} planes, {len(PRISMS)} prisms"
    print(f"{'×'.join(map(str, shape))} voxels, {counts}, float32, {torch.get_num_threads()} thread(s)\n")
    print("| propagation | forward s (process) | with gradient s (process) | peak MiB | transforms | least |")
    print("|---|---|---|---|---|---|")
    for propagation in arguments.propagations:
        command = [sys.executable, __file__, *sys.argv[1:], "--alone", propagation]
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
        r = json.loads(done.stdout.splitlines()[-1])
        print(
            f"| {propagation} | {r['forward'][0]:.1f} ({r['forward'][1]:.1f}) | {r['both'][0]:.1f} ({r['both'][1]:.1f})"
            f" | {r['peak']:.0f} | {r['transforms']} | {r['least']} |",
            flush=True,
        )


def measure(propagation: str, shape: tuple[int, ...], repeats: int) -> dict:
    """Seconds, peak MiB and transforms of one propagation, in this process."""
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(shape), 4)
    delta = torch.nn.Parameter(torch.from_numpy((0.01 * noise / noise.std()).astype(np.float32)))
    volume = Volume(Grid((shape[0], shape[1], shape[2]), (0.15, 0.15, 0.15)), delta, 1.36)
    # 13 points of a disc: the axis and two rings
    angle = 2 * np.pi * np.arange(6) / 6
    rings = [r * np.stack((np.sin(angle + t), np.cos(angle + t)), 1) for r, t in ((0.35, 0), (0.6, np.pi / 6))]
    points = torch.from_numpy(np.concatenate((np.zeros((1, 2)), *rings)))
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.6, points))
    acquisition, fidelity = Acquisition(PRISMS, FOCUS), Fidelity(propagation)

    def forward() -> None:
        with torch.no_grad():
            image(volume, microscope, acquisition, fidelity)

    def both() -> None:
        delta.grad = None
        image(volume, microscope, acquisition, fidelity).square().sum().backward()

    imported, transforms = peak(), 0

    def counted(transform):
        def call(field: torch.Tensor, **options: str) -> torch.Tensor:
            nonlocal transforms
            transforms += field.numel() // (field.shape[-1] * field.shape[-2])
            return transform(field, **options)

        return call

    forward()  # whose memory is measured first, on a small sample with transforms of its own
    with (
        mock.patch.object(torch.fft, "fft2", counted(torch.fft.fft2)),
        mock.patch.object(torch.fft, "ifft2", counted(torch.fft.ifft2)),
    ):
        forward()
    found = {}
    for name, run in (("forward", forward), ("both", both)):
        found[name] = [min(s) for s in zip(*(timed(run) for _ in range(repeats)), strict=True)]
    images = SOURCES * len(FOCUS) * len(PRISMS)
    least = images + SOURCES * (4 * shape[0] if propagation == "wave" else 1)
    return found | {"peak": peak() - imported, "transforms": transforms, "least": least}


if __name__ == "__main__":
    main()
