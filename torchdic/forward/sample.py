"""A sample of a scene: few of its pixels and one of its sources or two, computed to see what memory they take.

The sample has all slices, prisms and focus planes of the scene. It is computed, with its gradient where one is wanted,
while the bytes that it holds are counted (`torchdic.memory.held`). The result is then scaled to the scene: bytes grow
in proportion to the pixels, and linearly with the sources of a batch.
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.forward.passage import FieldPassage, Passage
from torchdic.grid import Grid
from torchdic.imaging import passband
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.memory.budget import Batches
from torchdic.memory.held import Course, Growth, course_of, most
from torchdic.memory.signature import stand_in
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# Pixels along a side of the sample: about so many, and as many as the scene has where those are fewer.
SIDES = range(36, 53)
# Computes a sample of so many sources in batches, and its gradient if one is wanted.
Run = Callable[[int, Batches], None]


class Sample:
    """A scene's sample, and what it was found to hold.

    run: computes the sample. scale: pixels of the scene to one of the sample.
    apart: whether every source has a field of its own, which is held beside the batches.
    """

    def __init__(self, run: Run, scale: float, *, apart: bool = False) -> None:
        self._run, self._scale, self._apart = run, scale, apart
        self._graph = torch.is_grad_enabled()
        self._most: dict[tuple[int, Batches], int] = {}
        self._growth: dict[tuple[bool, bool], Growth] = {}

    def peak(self, sources: int, batches: Batches) -> int:
        """The most bytes that the scene holds at once, lit by so many sources."""
        count, slabs, several = batches.sources, batches.slabs, batches.sources < sources
        if count == 1:
            held = self._most_of(1 + several, batches)
        else:
            if (slabs, several) not in self._growth:
                two, three = (self._course(n * (1 + several), Batches(n, slabs)) for n in (2, 3))
                self._growth[slabs, several] = Growth.of(two, three)
            held = self._growth[slabs, several].at(count)
        if self._apart and several:
            # two single sources, and three: the third one's field is held beside them
            pair, three = (self._most_of(few, Batches(1)) for few in (2, 3))
            held += (three - pair) * (sources - 2 * count)
        return math.ceil(self._scale * held)

    def _most_of(self, sources: int, batches: Batches) -> int:
        """The most bytes that a sample of so many sources holds."""
        if (sources, batches) not in self._most:
            self._most[sources, batches] = most(self._course(sources, batches))
        return self._most[sources, batches]

    def _course(self, sources: int, batches: Batches) -> Course:
        with warnings.catch_warnings(), torch.set_grad_enabled(self._graph):
            warnings.simplefilter("ignore")  # the scene itself will warn
            return course_of(lambda: self._run(sources, batches))


class VolumeSample:
    """A volume's scene on few pixels; scale: pixels of the scene to one of the sample, padding included."""

    def __init__(
        self,
        volume: Volume,
        microscope: Microscope,
        acquisition: Acquisition,
        fidelity: Fidelity,
        levels: int,
        *,
        learned: bool,
    ) -> None:
        pad = fidelity.padding
        whole = volume.grid.widened(pad, pad)
        sides, padding = _few_pixels(volume.grid, pad, microscope, number(volume.background))
        self._grid = replace(volume.grid, shape=(volume.grid.shape[0], *sides))
        self.scale = math.prod(whole.shape[1:]) / math.prod(self._grid.widened(padding, padding).shape[1:])
        memory = max(1, int(fidelity.memory / self.scale))
        self._fidelity = replace(fidelity, padding=padding, memory=memory)
        self._microscope, self._acquisition = stand_in(replace(microscope, camera=None)), stand_in(acquisition)
        self._levels, self._background = max(levels, 2), stand_in(volume.background)
        # the content is as far apart as in the volume, relative to the sides, and its slopes are as steep
        gentle = min(sides[0] / volume.grid.shape[1], sides[1] / volume.grid.shape[2])
        self._delta = gentle * _pooled(volume.delta, sides)
        self._absorption = None if volume.absorption is None else _pooled(volume.absorption, sides)
        self._learned = [
            learned,
            volume.absorption is not None and volume.absorption.requires_grad,
        ]

    def run(self, sources: int, batches: Batches) -> None:
        """Compute the sample, without its content if that does not let light through."""
        try:
            self._compute(sources, batches)
        except ValueError:
            self._delta = torch.zeros_like(self._delta)
            self._compute(sources, batches)

    def _compute(self, sources: int, batches: Batches) -> None:
        delta = self._delta.detach().requires_grad_(self._learned[0])
        absorption = self._absorption
        if absorption is not None:
            absorption = absorption.detach().requires_grad_(self._learned[1])
        volume = Volume(self._grid, delta, self._background, absorption)
        microscope = _lit_by(self._microscope, sources, self._fidelity)
        passage = Passage.through(volume, microscope, self._acquisition, self._fidelity, self._levels)
        images = passage.images(batches)
        if images.requires_grad:
            images.sum().backward()


def field_sample(passage: FieldPassage) -> tuple[Run, float]:
    """What computes a sample of fields, and the scene's pixels to one of the sample's."""
    fidelity, pad = passage.fidelity, passage.fidelity.padding
    (ny, nx), padding = _few_pixels(passage.grid, pad, passage.microscope, number(passage.background))
    whole = passage.grid.widened(pad, pad)
    grid = Grid((1, ny, nx), passage.grid.spacing)
    scale = math.prod(whole.shape[1:]) / math.prod(grid.widened(padding, padding).shape[1:])
    learned = passage.transmission.requires_grad
    few = passage.transmission.detach()[..., :ny, :nx].cpu().clone()  # of its own: the whole field is not kept
    background = stand_in(passage.background)
    microscope, acquisition = stand_in(replace(passage.microscope, camera=None)), stand_in(passage.acquisition)

    def run(sources: int, batches: Batches) -> None:
        field = few if few.ndim == 2 else few[torch.arange(sources) % len(few)]
        field = field.clone().requires_grad_(learned)
        lit = _lit_by(microscope, sources, fidelity)
        sample = FieldPassage(field, grid, background, lit, acquisition, replace(fidelity, padding=padding))
        images = sample.images(batches)
        if images.requires_grad:
            images.sum().backward()

    return run, scale


def _lit_by(microscope: Microscope, sources: int, fidelity: Fidelity) -> Microscope:
    """A microscope with so many of its sources, one after the other and again from the first."""
    points, _ = microscope.sources(fidelity.sources, dtype=torch.float64)
    return microscope.lit_from(points[torch.arange(sources) % len(points)])


def _few_pixels(grid: Grid, padding: int, microscope: Microscope, background: float) -> tuple[tuple[int, int], int]:
    """The sample's sides (y, x) without padding, and its padding.

    Of the sizes that serve, the one in which a pupil's window and the coarser array for the intensities take about the
    same parts of the pixels as in the scene.
    """
    whole = grid.widened(padding, padding)
    wavelength = min(part.wavelength for part, _ in microscope.colours())
    aimed = _parts(whole, wavelength, microscope, background)
    best = None
    for side in SIDES:
        share = min(1.0, side / min(whole.shape[1:]))
        pad = math.ceil(padding * share)
        sides = tuple(min(n, max(1, math.ceil(share * (n + 2 * padding)) - 2 * pad)) for n in grid.shape[1:])
        sides = (min(sides[0], side), min(sides[1], side))
        few = replace(grid, shape=(grid.shape[0], *sides)).widened(pad, pad)
        differs = sum(abs(a - b) for a, b in zip(_parts(few, wavelength, microscope, background), aimed, strict=True))
        if best is None or differs < best[0]:
            best = differs, sides, pad
    assert best is not None
    return best[1], best[2]


def _parts(grid: Grid, wavelength: float, microscope: Microscope, background: float) -> tuple[float, float]:
    """The parts of the array's pixels that a pupil's window and the array for the intensities have."""
    objective = microscope.objective
    found = None if objective is None else passband.sizes(grid, wavelength, objective.reach(background))
    if found is None:
        return 1.0, 1.0
    window, array = (math.prod(shape) / math.prod(grid.shape[1:]) for shape in found)
    return window, array


def _pooled(field: Tensor, sides: tuple[int, int]) -> Tensor:
    """A field's means over blocks of pixels, on the CPU; the field itself where it has no more pixels."""
    return F.adaptive_avg_pool2d(field.detach()[None], sides)[0].cpu()
