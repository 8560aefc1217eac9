"""What an image costs: its work, which is counted, and its seconds, for which a small part of it is timed."""

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

# Work of a source and of each of its images, in FFTs of a field with pointwise work included, measured on a CPU from
# 64² to 256² pixels. Each propagation says by itself what its way across the specimen costs.
SETUP, IMAGE = 30.0, 4.5

# The work that polarisers add: for each pure state of light in an image; once for both beams where light is a scalar.
POLARISED = 8.0

# Work of the part that is timed. It takes some 10 ms, much more than the calls of Python alone.
TIMED = 3e7


def work(fidelity: Fidelity, volume: Volume, microscope: Microscope, acquisition: Acquisition) -> float:
    """What an image costs, in FFT butterflies: sources × (crossing the specimen + images) × N log2 N, for N pixels."""
    pixels = math.prod(volume.grid.widened(fidelity.padding, fidelity.padding).shape[1:])
    polarisers = microscope.polarisers
    if microscope.lenses is not None:
        states = 1 if polarisers is None else polarisers.states
    else:
        states = 0 if polarisers is None else 1
    images = len(acquisition.prisms) * len(acquisition.focus) * (IMAGE + POLARISED * states)
    sources = len(microscope.colours()) * directions(microscope, fidelity.sources)
    return sources * (SETUP + crossing(fidelity, volume) + images) * pixels * math.log2(max(pixels, 2))


def crossing(fidelity: Fidelity, volume: Volume) -> float:
    """What the light of each source costs inside the specimen, in FFTs of a field."""
    grid = volume.grid.widened(fidelity.padding, fidelity.padding)
    return propagation_of(fidelity).work(grid, fidelity, absorbs=volume.absorption is not None)


def directions(microscope: Microscope, sources: int) -> int:
    """The number of directions that the light comes from if at most `sources` are asked for."""
    return len(microscope.sources(sources)[1])


@torch.no_grad()
def seconds(volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity) -> float:
    """The seconds that an image will take, without its gradient.

    An image of few sources, few slabs and one focus plane is timed, and its seconds are scaled by the work. Its volume
    is empty, because few slabs may not carry the light of a strong specimen.
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
    """The seconds that each of several runs takes by the clock, until the device is done with it."""

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
