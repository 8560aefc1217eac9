"""Foreseen memory beside measured memory.

    python benchmarks/memory.py [--small]

Each scene is run with its gradient and without, in float32. A row shows what `torchdic.foreseen` says before the run,
the most bytes of tensors that the run holds at once without the volume, as torch's allocator tells the profiler, and
the batches that the budget leads to. --small: an eighth of the pixels, for a quick check after a change.
"""

import argparse
import math
from dataclasses import replace

import torch

from scaling import specimen
from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    JonesPupil,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Volume,
    foreseen,
    image,
)
from torchdic.planning.work_precision import peak_bytes

MIB = 1 << 20
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.6))
LENSES = replace(MICROSCOPE, polarisation=Polarisation(pupil=JonesPupil({6: (0.1, 0.0)}, depolarisation=True)))
PRISMS = [Prism(s, b) for s in ((0.0, 0.24), (0.24, 0.0)) for b in (math.pi / 2, -math.pi / 2)]
FEW, MANY = Acquisition(PRISMS[:2], [-1.0, 1.0]), Acquisition(PRISMS, [0.5 * i - 2 for i in range(9)])
# name, slices, pixels a side, microscope, acquisition, fidelity
SCENES = (
    ("projection", 32, 128, MICROSCOPE, FEW, Fidelity("projection", sources=13)),
    ("projection, 4 × 9 images", 32, 128, MICROSCOPE, MANY, Fidelity("projection", sources=13)),
    ("projection, cubic", 32, 96, MICROSCOPE, FEW, Fidelity("projection", sources=13, interpolation="cubic")),
    ("rays", 32, 96, MICROSCOPE, FEW, Fidelity("rays", sources=13)),
    ("rays, cubic", 32, 64, MICROSCOPE, FEW, Fidelity("rays", sources=13, interpolation="cubic")),
    ("wave, order 1", 32, 128, MICROSCOPE, FEW, Fidelity(order=1, sources=13)),
    ("wave, order 2, padded", 32, 96, MICROSCOPE, FEW, Fidelity(sources=13, padding=16)),
    ("wave, lenses of matrices", 16, 96, LENSES, FEW, Fidelity(sources=13)),
    ("wave, budget 64 MiB", 32, 128, MICROSCOPE, FEW, Fidelity(sources=13, memory=64 * MIB)),
    ("wave, budget 1 MiB", 32, 128, MICROSCOPE, FEW, Fidelity(sources=13, memory=MIB)),
    ("rays, budget 64 MiB", 32, 96, MICROSCOPE, FEW, Fidelity("rays", sources=13, memory=64 * MIB)),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Memory foreseen beside what is measured.")
    parser.add_argument("--small", action="store_true")
    small = parser.parse_args().small
    print(
        "| scene | voxels | gradient | batches | foreseen MiB | measured MiB | ratio |\n|---|---|---|---|---|---|---|"
    )
    for name, slices, side, microscope, acquisition, fidelity in SCENES:
        side = side * 3 // 8 if small else side
        for gradient in (False, True):
            volume = specimen(slices, side, side)
            volume.delta.requires_grad_(gradient)
            found = foreseen(volume, microscope, acquisition, fidelity)
            bytes_ = measured(volume, microscope, acquisition, fidelity, gradient=gradient)
            batches = f"of {found.sources}" + (", in slabs" if found.slabs else "")
            cells = [name, f"{slices}×{side}×{side}", "yes" if gradient else "no", batches]
            cells += [f"{found.peak / MIB:.1f}", f"{bytes_ / MIB:.1f}", f"{found.peak / bytes_:.2f}"]
            print(f"| {' | '.join(cells)} |", flush=True)


def measured(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, *, gradient: bool
) -> int:
    """The most bytes held at once of those that the run allocates."""

    def run() -> None:
        with torch.set_grad_enabled(gradient):
            images = image(volume, microscope, acquisition, fidelity)
            if gradient:
                images.sum().backward()

    return peak_bytes(run)[1]


if __name__ == "__main__":
    main()
