"""The memory that an image will hold at once, measured on a sample of the scene before the image is computed.

The sample is the scene itself, with all of its slices, prisms and focus planes, but with few pixels and one or two
sources. It is run, with its gradient if one is wanted, and the bytes that it holds are counted
(`torchdic.memory.held`). They are then scaled to the scene: bytes grow in proportion to the pixels, and linearly with
the sources of a batch. The memory of a sample depends on the scene's shapes and not on its values, so each kind of
scene is measured once. Rays are an exception: their memory also depends on how much of the array is empty, so that this
is part of the kind.
"""

import math
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.forward.passage import FieldPassage, Passage
from torchdic.grid import Grid
from torchdic.imaging import passband
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.memory.budget import Batches, Foreseen, fitted, least_of
from torchdic.memory.free import check_room, free_bytes
from torchdic.memory.held import Course, course_of, extrapolated, most
from torchdic.memory.signature import signature, stand_in
from torchdic.propagation.base import propagation_of
from torchdic.propagation.presets import STANDARD
from torchdic.specimen.volume import Volume

# Pixels along a side of the sample: a number in this range, or all pixels of the scene if it has fewer.
SIDES = range(36, 53)
# Bytes that a batch on the CPU may hold if no gradient is wanted. Its arrays then stay in the caches, which is up to
# 1.4 times as fast (fields of 192² pixels, 50 sources) or more (rays at 256² pixels, 13 sources).
CACHED = 32 << 20
# More bytes than any scene holds for each source and pixel. With a gradient they count for each slice and image. If a
# scene fits into its budget even by this number, it is computed at once and not measured.
AMPLE = 2048
# The map of an object aberration serves all sources: it holds less than this many times AMPLE for each slice.
MAP = 40
# Number of kinds of scenes whose measurements are kept.
KEPT = 32
_measured: "OrderedDict[Hashable, _Sample]" = OrderedDict()


def foreseen(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity = STANDARD,
    *,
    gradient: bool | None = None,
) -> Foreseen:
    """The memory that `image` of the same arguments will hold at once, found without computing it; see `Foreseen`.

    volume, microscope, acquisition, fidelity: as for `image`.
    gradient: whether a gradient is wanted, at least with respect to the volume. None decides as `image` does, by which
        tensors require grad.
    If the fidelity names an object_aberration, its map is computed, because the memory depends on how strong it is.
    """
    levels = 0
    if fidelity.object_aberration is not None:
        with torch.no_grad():
            levels = Passage.through(volume, microscope, acquisition, fidelity).most_levels
    with torch.set_grad_enabled(torch.is_grad_enabled() if gradient is None else gradient):
        sample = _sample_of(volume, microscope, acquisition, fidelity, levels, learned=bool(gradient))
        return sample.foreseen(fidelity.memory)


def allot(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, levels: int | None = None
) -> Batches:
    """The batches in which `image` stays within its budget and within the free memory.

    levels: number of levels of an object aberration; None if it isn't known yet.
    Raises ShortOfMemoryError if even single sources, whose steps are computed again, need more memory than is free.
    """
    grid, device = volume.grid.widened(fidelity.padding, fidelity.padding), volume.delta.device
    slices, images = grid.shape[0], len(acquisition.prisms) * len(acquisition.focus)
    sources, gradient = len(microscope.sources(fidelity.sources)[1]), torch.is_grad_enabled()
    of_source = slices + images + (levels or 0) if gradient else 1
    of_map = 0 if fidelity.object_aberration is None else MAP * (slices if gradient else 1)
    free = free_bytes(device)
    if _ample(sources * of_source + of_map, grid, fidelity, device, free):
        return Batches(sources)
    shape = "×".join(map(str, volume.grid.shape))
    what = (
        f"{len(acquisition.prisms)} prism settings × {len(acquisition.focus)} focus planes of {shape} voxels by "
        f'"{fidelity.propagation}"'
    )
    sample = _sample_of(volume, microscope, acquisition, fidelity, levels or 0)
    sample.check_room(free, what)
    return sample.fitted(fidelity.memory, free)


def allot_fields(passage: FieldPassage) -> Batches:
    """Like `allot`, for the images of given fields."""
    fidelity, acquisition, device = passage.fidelity, passage.acquisition, passage.transmission.device
    grid = passage.grid.widened(fidelity.padding, fidelity.padding)
    prisms, planes = len(acquisition.prisms), len(acquisition.focus)
    sources, free = len(passage.microscope.sources(fidelity.sources)[1]), free_bytes(device)
    kept = sources * (prisms * planes if torch.is_grad_enabled() else 1)
    if _ample(kept, grid, fidelity, device, free):
        return Batches(sources)
    _, ny, nx = passage.grid.shape
    sample = _sample_of_fields(passage)
    sample.check_room(free, f"{prisms} × {planes} images of {ny}×{nx} pixels")
    return sample.fitted(fidelity.memory, free)


def _ample(kept: int, grid: Grid, fidelity: Fidelity, device: torch.device, free: int | None) -> bool:
    """Whether all sources fit into the budget at once by the number AMPLE. kept: what AMPLE counts for each pixel."""
    return AMPLE * kept * math.prod(grid.shape[1:]) <= _budget(fidelity.memory, free, device)


def _budget(memory: int, free: int | None, device: torch.device) -> int:
    """Bytes that an image may hold: within `memory`, what is free, and the caches (on the CPU without a gradient)."""
    budget = memory if free is None else max(1, min(memory, free))
    return min(budget, CACHED) if device.type == "cpu" and not torch.is_grad_enabled() else budget


# --- the sample ------------------------------------------------------------------------------------------------------

# Runs a sample with this many sources in batches, and its gradient if one is wanted.
Run = Callable[[int, Batches], None]


class _Sample:
    """A scene's sample, and the memory that it was found to hold.

    run: computes the sample.
    sources: number of sources of the scene.
    scale: pixels of the scene for each pixel of the sample.
    device: of the scene.
    small_batches: see `ways`.
    apart: whether every source has a field of its own, which is held beside the batches.
    """

    def __init__(
        self,
        run: Run,
        sources: int,
        scale: float,
        device: torch.device,
        *,
        small_batches: bool = False,
        apart: bool = False,
    ) -> None:
        self._run, self._sources, self._scale, self._device = run, sources, scale, device
        self._small_batches, self._apart = small_batches, apart
        self._gradient = torch.is_grad_enabled()
        self._courses: dict[tuple[int, Batches], Course] = {}

    def foreseen(self, memory: int) -> Foreseen:
        """The memory that the scene holds within a budget in bytes."""
        batches = self._fitted(_budget(memory, None, self._device))
        return Foreseen(self.peak(batches), self._least, batches.sources, batches.slabs)

    def check_room(self, free: int | None, what: str) -> None:
        """Raise ShortOfMemoryError if the scene can't be computed in the free memory."""
        if free is not None and self.peak(Batches(self._sources)) > free:
            check_room(self._least, free, what)

    def fitted(self, memory: int, free: int | None) -> Batches:
        """The batches that fit into a budget in bytes and into the free memory."""
        return self._fitted(_budget(memory, free, self._device))

    def _fitted(self, budget: int) -> Batches:
        ways = {"gradient": self._gradient, "small_batches": self._small_batches}
        return fitted(self.peak, self._sources, budget, **ways)

    @property
    def _least(self) -> int:
        return least_of(self.peak, self._sources, gradient=self._gradient, small_batches=self._small_batches)

    def peak(self, batches: Batches) -> int:
        """The largest number of bytes that the scene holds at once in these batches."""
        count, several = batches.sources, batches.sources < self._sources
        one = self._course(1 + several, Batches(1, batches.slabs))
        if count == 1:
            held = most(one)
        else:
            held = extrapolated(one, self._course(2 * (1 + several), Batches(2, batches.slabs)), count)
        if self._apart and several:
            further = most(self._course(3, Batches(1))) - most(self._course(2, Batches(1)))
            held += further * (self._sources - 2 * count)
        return math.ceil(self._scale * held)

    def _course(self, sources: int, batches: Batches) -> Course:
        if (sources, batches) not in self._courses:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the scene itself will warn
                with torch.set_grad_enabled(self._gradient):
                    self._courses[sources, batches] = course_of(lambda: self._run(sources, batches))
        return self._courses[sources, batches]


def _remembered(key: Hashable, make: Callable[[], _Sample]) -> _Sample:
    """The sample of a kind of scene. It is made if there is none yet."""
    if key not in _measured:
        _measured[key] = make()
        if len(_measured) > KEPT:
            _measured.popitem(last=False)
    _measured.move_to_end(key)
    return _measured[key]


def _sample_of(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
    levels: int,
    *,
    learned: bool = False,
) -> _Sample:
    """The sample of a volume's scene. learned: True counts Δn as learned even if it doesn't require grad."""
    learned = learned or volume.delta.requires_grad
    propagation = propagation_of(fidelity)
    filled = _filled(volume) if propagation.holds_by_content else None
    # the budget matters only to the map of an object aberration, which may exceed it by itself
    plain = fidelity if fidelity.object_aberration is not None else replace(fidelity, memory=1)
    parts = volume.grid, volume.delta.dtype, volume.absorption, volume.background, microscope, acquisition
    key = signature(parts), plain, levels, filled, learned, torch.is_grad_enabled(), volume.delta.device.type

    def make() -> _Sample:
        sample = _VolumeSample(volume, microscope, acquisition, fidelity, levels, learned=learned)
        sources, device = len(microscope.sources(fidelity.sources)[1]), volume.delta.device
        return _Sample(sample.run, sources, sample.scale, device, small_batches=propagation.small_batches)

    return _remembered(key, make)


def _sample_of_fields(passage: FieldPassage) -> _Sample:
    """The sample of a scene of given fields."""
    parts = passage.grid, passage.transmission, passage.background, passage.microscope, passage.acquisition
    plain, device = replace(passage.fidelity, memory=1), passage.transmission.device
    key = signature(parts), plain, torch.is_grad_enabled(), device.type

    def make() -> _Sample:
        sources = len(passage.microscope.sources(passage.fidelity.sources)[1])
        run, scale = _field_run(passage)
        return _Sample(run, sources, scale, device, apart=passage.transmission.ndim == 3)

    return _remembered(key, make)


class _VolumeSample:
    """A volume's scene on few pixels. scale: pixels of the scene for each pixel of the sample, padding included."""

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
        sides, padding = _few_pixels(volume.grid, pad, microscope)
        self._grid = replace(volume.grid, shape=(volume.grid.shape[0], *sides))
        self.scale = math.prod(whole.shape[1:]) / math.prod(self._grid.widened(padding, padding).shape[1:])
        memory = max(1, int(fidelity.memory / self.scale))
        self._fidelity = replace(fidelity, padding=padding, memory=memory)
        self._microscope, self._acquisition = stand_in(replace(microscope, camera=None)), stand_in(acquisition)
        self._levels, self._background = max(levels, 2), stand_in(volume.background)
        # pooling brings the content closer together, so Δn is lowered to keep its slopes as steep as in the volume
        gentle = min(sides[0] / volume.grid.shape[1], sides[1] / volume.grid.shape[2])
        self._delta = gentle * _pooled(volume.delta, sides)
        self._absorption = None if volume.absorption is None else _pooled(volume.absorption, sides)
        self._learned = [
            learned,
            volume.absorption is not None and volume.absorption.requires_grad,
        ]

    def run(self, sources: int, batches: Batches) -> None:
        """Compute the sample. If light can't cross its content, compute it without content."""
        try:
            self._compute(sources, batches, self._delta)
        except ValueError:
            self._compute(sources, batches, torch.zeros_like(self._delta))

    def _compute(self, sources: int, batches: Batches, delta: Tensor) -> None:
        delta = delta.detach().requires_grad_(self._learned[0])
        absorption = self._absorption
        if absorption is not None:
            absorption = absorption.detach().requires_grad_(self._learned[1])
        volume = Volume(self._grid, delta, self._background, absorption)
        microscope = _lit_by(self._microscope, sources, self._fidelity)
        passage = Passage.through(volume, microscope, self._acquisition, self._fidelity, self._levels)
        images = passage.images(batches)
        if images.requires_grad:
            images.sum().backward()


def _field_run(passage: FieldPassage) -> tuple[Run, float]:
    """A function that computes fields on few pixels, and the scene's pixels for each of these."""
    fidelity, pad = passage.fidelity, passage.fidelity.padding
    (ny, nx), padding = _few_pixels(passage.grid, pad, passage.microscope)
    whole = passage.grid.widened(pad, pad)
    grid = Grid((1, ny, nx), passage.grid.spacing)
    scale = math.prod(whole.shape[1:]) / math.prod(grid.widened(padding, padding).shape[1:])
    own = passage.transmission
    few = own.detach()[..., :ny, :nx].cpu()
    background = stand_in(passage.background)
    microscope, acquisition = stand_in(replace(passage.microscope, camera=None)), stand_in(passage.acquisition)

    def run(sources: int, batches: Batches) -> None:
        field = few if few.ndim == 2 else few[torch.arange(sources) % len(few)]
        field = field.clone().requires_grad_(own.requires_grad)
        lit = _lit_by(microscope, sources, fidelity)
        sample = FieldPassage(field, grid, background, lit, acquisition, replace(fidelity, padding=padding))
        images = sample.images(batches)
        if images.requires_grad:
            images.sum().backward()

    return run, scale


def _lit_by(microscope: Microscope, sources: int, fidelity: Fidelity) -> Microscope:
    """The microscope lit by this many of its sources. If it has fewer, they are repeated."""
    points, _ = microscope.sources(fidelity.sources, dtype=torch.float64)
    return microscope.lit_from(points[torch.arange(sources) % len(points)])


def _few_pixels(grid: Grid, padding: int, microscope: Microscope) -> tuple[tuple[int, int], int]:
    """The sample's sides (y, x) without padding, and its padding, in pixels.

    Of the sizes in SIDES this is the one in which the pupil's window, and the coarser array for the intensities, take
    about the same parts of the pixels as in the scene.
    """
    whole = grid.widened(padding, padding)
    wavelength = min(part.wavelength for part, _ in microscope.colours())
    aimed = _parts(whole, wavelength, microscope)
    best = None
    for side in SIDES:
        share = min(1.0, side / min(whole.shape[1:]))
        pad = math.ceil(padding * share)
        sides = tuple(min(n, max(1, math.ceil(share * (n + 2 * padding)) - 2 * pad)) for n in grid.shape[1:])
        sides = (min(sides[0], side), min(sides[1], side))
        few = replace(grid, shape=(grid.shape[0], *sides)).widened(pad, pad)
        differs = sum(abs(a - b) for a, b in zip(_parts(few, wavelength, microscope), aimed, strict=True))
        if best is None or differs < best[0]:
            best = differs, sides, pad
    assert best is not None
    return best[1], best[2]


def _parts(grid: Grid, wavelength: float, microscope: Microscope) -> tuple[float, float]:
    """The parts of the array's pixels that the pupil's window and the coarser array for the intensities take."""
    objective = microscope.objective
    found = None if objective is None else passband.sizes(grid, wavelength, objective.na)
    if found is None:
        return 1.0, 1.0
    window, array = (math.prod(shape) / math.prod(grid.shape[1:]) for shape in found)
    return window, array


def _pooled(field: Tensor, sides: tuple[int, int]) -> Tensor:
    """Means of a field over blocks of pixels, on the CPU. A field with no more pixels than `sides` is unchanged."""
    return F.adaptive_avg_pool2d(field.detach().cpu()[None], sides)[0]


def _filled(volume: Volume) -> int:
    """How many eighths of the array's pixels have a Δn in any slice."""
    there = (volume.delta.detach() != 0).any(0)
    return round(8 * float(there.sum()) / there.numel())
