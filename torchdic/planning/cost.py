"""What an image costs: its work, by counting, and its seconds, by timing a small part of it."""

import math
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from torchdic.fidelity import Fidelity
from torchdic.forward.images import image
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.propagation.base import propagation_of
from torchdic.specimen.volume import Volume

# Work in units of one FFT of a source's field, pointwise work included, measured on a CPU from 64² to 256² pixels. What
# crosses the specimen is for each propagation to say.
SETUP, IMAGE = 30.0, 4.5

# More, for each pure state of polarised light in an image, or for its two beams at once where they stay a scalar pair.
POLARISED = 8.0

# Work of the part that is timed: some 10 ms, beyond what calls alone take.
TIMED = 3e7


def work(fidelity: Fidelity, volume: Volume, microscope: Microscope, acquisition: Acquisition) -> float:
    """What an image costs, in FFT butterflies: sources × (what crosses the specimen + images) × N log2 N."""
    grid = volume.grid.widened(fidelity.padding, fidelity.padding)
    pixels = math.prod(grid.shape[1:])
    inside = propagation_of(fidelity).work(grid, fidelity, absorbs=volume.absorption is not None)
    polarisers = microscope.polarisers
    if microscope.lenses is not None:
        states = 1 if polarisers is None else polarisers.states
    else:
        states = 0 if polarisers is None else 1
    images = len(acquisition.prisms) * len(acquisition.focus) * (IMAGE + POLARISED * states)
    sources = len(microscope.colours()) * directions(microscope, fidelity.sources)
    return sources * (SETUP + inside + images) * pixels * math.log2(max(pixels, 2))


def directions(microscope: Microscope, sources: int) -> int:
    """How many directions the light comes from if at most so many are asked for."""
    return len(microscope.sources(sources)[1])


@torch.no_grad()
def seconds(volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity) -> float:
    """Seconds of an image without gradients: those of a few sources, slabs and one focus, scaled by the work.

    They cross an empty volume: few slabs need not carry the light of a strong specimen.
    """
    absorption = None if volume.absorption is None else torch.zeros_like(volume.delta)
    empty = Volume(volume.grid, torch.zeros_like(volume.delta), volume.background.detach(), absorption)
    short = replace(fidelity, steps=min(fidelity.steps or volume.grid.shape[0], 8))
    brief = Acquisition(acquisition.prisms, acquisition.focus[:1])
    points, _ = microscope.sources(fidelity.sources, dtype=torch.float64)
    each = work(short, volume, microscope, brief) / (len(points) * len(microscope.colours()))
    some = max(1, int(TIMED / each))
    few = replace(microscope.lit_from(points[-some:]), spectrum=None)
    best = min(timed(lambda: image(empty, few, brief, short), 2, volume.delta.device))
    return best * work(fidelity, volume, microscope, acquisition) / work(short, empty, few, brief)


def timed(run: Callable[[], object], repeats: int, device: torch.device) -> list[float]:
    """Seconds of each of several runs, by the clock, until the device is done."""

    def done() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    found = []
    for _ in range(repeats):
        started = done()
        run()
        found.append(done() - started)
    return found
