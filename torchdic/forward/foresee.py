"""The memory that an image will hold at once, and whether there is room for it, found before it is computed.

It is measured on a small sample of the scene, see `torchdic.forward.sample`. The memory of a sample depends on the
scene's shapes and not on its values, so each kind of scene is measured once. Rays are an exception: their memory also
depends on how much of the array is empty, so that this is part of the kind.
"""

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import torch

from torchdic.fidelity import Fidelity
from torchdic.forward.passage import FieldPassage, Passage
from torchdic.forward.sample import Sample, VolumeSample, field_sample
from torchdic.instrument.microscope import Acquisition, Microscope, check_apertures, limited
from torchdic.memory.budget import Batches, Foreseen, fitted, least_of
from torchdic.memory.free import check_room, free_bytes
from torchdic.memory.signature import is_learned, signature
from torchdic.propagation.base import propagation_of
from torchdic.propagation.presets import STANDARD
from torchdic.ranks.group import ranks_here
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# Bytes that a batch on the CPU may hold if no gradient is wanted. Its arrays then stay in the caches, which is up to
# 1.4 times as fast (fields of 192² pixels, 50 sources) or more (rays at 256² pixels, 13 sources).
CACHED = 32 << 20
# More bytes than any scene holds for each source and pixel. With a gradient they count for each slice and image. If a
# scene fits into its budget even by this number, it is computed at once and not measured. Without a gradient a
# propagation's own number may be less, and each slice and image takes less than FLAT once, for all sources.
AMPLE, FLAT = 2048, 32
# The map of an object aberration serves all sources: it holds less than this many times AMPLE for each pixel and slice.
MAP = 40
# From so many sources on, a condenser's inner ring has as many as a sample takes: any number of them holds alike.
ALIKE = 8
# Number of kinds of scenes whose measurements are kept.
KEPT = 32
_measured: "OrderedDict[Hashable, Sample]" = OrderedDict()
# A second thread waits for what the first one measures.
_measuring = threading.RLock()


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
    check_apertures(microscope, number(volume.background), volume.delta.dtype)
    microscope = limited(microscope, number(volume.background), volume.delta.dtype)
    levels = 0
    if fidelity.object_aberration is not None:
        with torch.no_grad():
            levels = Passage.through(volume, microscope, acquisition, fidelity).most_levels
    with torch.set_grad_enabled(torch.is_grad_enabled() if gradient is None else gradient):
        room = _room_for(volume, microscope, acquisition, fidelity, levels, learned=bool(gradient))
        return room.foreseen(fidelity.memory)


def check_fits(volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity) -> None:
    """Raise ShortOfMemoryError if an image needs more memory than is free, however its sources are computed.

    An object aberration, whose map is not computed for this, is taken to be weak.
    """
    room, ample, what = _demand(volume, microscope, acquisition, fidelity, 0)
    room.check_fits(ample, what)


def allot(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, levels: int = 0
) -> Batches:
    """The batches in which `image` stays within its budget and within the free memory.

    levels: number of levels of an object aberration.
    Raises ShortOfMemoryError if even single sources, whose steps are computed again, need more memory than is free.
    """
    room, ample, what = _demand(volume, microscope, acquisition, fidelity, levels)
    return room.allot(ample, fidelity.memory, what)


def allot_fields(passage: FieldPassage) -> Batches:
    """As `allot`, for the images of fields that are there already."""
    fidelity, acquisition = passage.fidelity, passage.acquisition
    grid = passage.grid.widened(fidelity.padding, fidelity.padding)
    prisms, planes = len(acquisition.prisms), len(acquisition.focus)
    parts = passage.grid, passage.transmission, passage.background, passage.microscope, acquisition
    sources = len(passage.microscope.sources(fidelity.sources)[1])

    def make() -> Sample:
        run, scale = field_sample(passage)
        return Sample(run, scale, apart=passage.transmission.ndim == 3)

    key = signature(parts), replace(fidelity, memory=1)
    room = _Room(key, make, sources, passage.transmission.device, is_learned(parts), small_batches=False)
    _, ny, nx = passage.grid.shape
    ample = AMPLE * sources * (prisms * planes if room.gradient else 1) * math.prod(grid.shape[1:])
    return room.allot(ample, fidelity.memory, f"{prisms} × {planes} images of {ny}×{nx} pixels")


@dataclass(frozen=True)
class _Room:
    """The room that a scene takes, measured when it is asked for.

    kind: scenes of one kind hold the same. make: makes the sample of such a scene. sources: of the scene. gradient:
    whether one is wanted. small_batches: see `torchdic.memory.budget.ways`.
    """

    kind: Hashable
    make: Callable[[], Sample]
    sources: int
    device: torch.device
    gradient: bool
    small_batches: bool

    def foreseen(self, memory: int) -> Foreseen:
        """What the scene holds within a budget in bytes."""
        batches = self._fitted(self._budget(memory, None))
        return Foreseen(self._peak(batches), self._least, batches.sources, batches.slabs)

    def check_fits(self, ample: int, what: str) -> None:
        """Raise ShortOfMemoryError where the scene needs more memory than is free; see `allot`."""
        free = self._free
        if free is None or ample <= free:
            return
        if self._peak(Batches(self.sources)) > free:
            check_room(self._least, free, what)

    def allot(self, ample: int, memory: int, what: str) -> Batches:
        """The batches that fit into a budget and into what is free. Raises ShortOfMemoryError where none do.

        ample: more bytes than the scene holds. what: the scene, for the message.
        """
        budget = self._budget(memory, self._free)
        if ample <= budget:
            return Batches(self.sources)
        self.check_fits(ample, what)
        return self._fitted(budget)

    @property
    def _free(self) -> int | None:
        """Bytes that are free for this process: the ranks on a machine share its memory."""
        free = free_bytes(self.device)
        return free // ranks_here() if free is not None and self.device.type == "cpu" else free

    def _budget(self, memory: int, free: int | None) -> int:
        """Bytes that an image may hold: what is allowed, what is free, and on the CPU without a gradient its caches."""
        budget = memory if free is None else max(1, min(memory, free))
        cached = self.device.type == "cpu" and not self.gradient and self.sources > 1
        return min(budget, CACHED) if cached else budget

    def _fitted(self, budget: int) -> Batches:
        return fitted(self._peak, self.sources, budget, gradient=self.gradient, small_batches=self.small_batches)

    @property
    def _least(self) -> int:
        way = least_of(self._peak, self.sources, gradient=self.gradient, small_batches=self.small_batches)
        return self._peak(way)

    def _peak(self, batches: Batches) -> int:
        kind = self.kind, self.gradient, torch.is_grad_enabled(), self.device.type
        with _measuring:
            if kind not in _measured:
                _measured[kind] = self.make()
                if len(_measured) > KEPT:
                    _measured.popitem(last=False)
            _measured.move_to_end(kind)
            return _measured[kind].peak(self.sources, batches)


def _demand(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, levels: int
) -> "tuple[_Room, int, str]":
    """The room of a volume's scene, more bytes than the scene holds, and its name."""
    room = _room_for(volume, microscope, acquisition, fidelity, levels)
    prisms, planes = len(acquisition.prisms), len(acquisition.focus)
    layers = max(volume.grid.shape[0], fidelity.steps or 0) + prisms * planes
    if room.gradient:
        of_pixel = AMPLE * room.sources * (layers + levels)
    else:
        own = propagation_of(fidelity).ample * volume.delta.dtype.itemsize // torch.float32.itemsize
        of_pixel = (AMPLE if levels else min(own, AMPLE)) * room.sources + FLAT * layers
    if fidelity.object_aberration is not None:
        of_pixel += AMPLE * MAP * (layers if room.gradient else 1)
    pixels = math.prod(volume.grid.widened(fidelity.padding, fidelity.padding).shape[1:])
    shape = "×".join(map(str, volume.grid.shape))
    what = f'{prisms} prism settings × {planes} focus planes of {shape} voxels by "{fidelity.propagation}"'
    return room, of_pixel * pixels, what


def _room_for(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
    levels: int,
    *,
    learned: bool = False,
) -> _Room:
    """The room of a volume's scene; learned: whether a gradient to Δn is wanted, whatever the volume says."""
    propagation = propagation_of(fidelity)
    wanted = learned or volume.delta.requires_grad
    # the budget plays a part in the map of an object aberration, whose steps are computed again or not
    plain = fidelity if fidelity.object_aberration is not None else replace(fidelity, memory=1)
    # a sample has the first few of the condenser's sources, which lie on its inner ring
    plain = replace(plain, sources=min(fidelity.sources, ALIKE))
    filled = _filled(volume) if propagation.holds_by_content else None
    parts = volume.delta.dtype, volume.absorption, volume.background, microscope, acquisition
    sources = len(microscope.sources(fidelity.sources)[1])

    def make() -> Sample:
        sample = VolumeSample(volume, microscope, acquisition, fidelity, levels, learned=wanted)
        return Sample(sample.run, sample.scale)

    kind = volume.grid, signature(parts), wanted, plain, levels, filled
    gradient = torch.is_grad_enabled() and (wanted or is_learned(parts))
    return _Room(kind, make, sources, volume.delta.device, gradient, propagation.small_batches)


def _filled(volume: Volume) -> int:
    """Eighths of the array's pixels in which there is something."""
    there = (volume.delta.detach() != 0).any(0)
    return round(8 * float(there.sum()) / there.numel())
