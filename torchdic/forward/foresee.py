"""Memory foreseen: what the computation of an image will hold at once, and whether there is room for it.

Each stage says what it holds in values per source and pixel (`torchdic.recompute.Demand`); here they become bytes. Of
several sources a batch holds, where a gradient is wanted,

    B·pixels·(kept by propagation and imaging + at most beside it),

and the next batch nothing of it if it is computed again in the backward pass. Beside the batches there are the padded
volume, a spline's coefficients, the images, and what of the volume's gradient is there when a batch begins.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace

import torch
from torch import Tensor

from torchdic.fidelity import STANDARD, Fidelity
from torchdic.forward.demand import demand_of_imaging
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.memory.batches import Demand
from torchdic.memory.batches import slabs as slab_ranges
from torchdic.memory.free import check_room, free_bytes
from torchdic.object_aberration.levels import Levels, demand_of_map, kept_by_levels, object_levels
from torchdic.propagation.bent_rays import demand_of_rays, reference_plane
from torchdic.propagation.projection import demand_of_projection
from torchdic.propagation.wave import demand_of_wave
from torchdic.specimen.volume import Volume

# Bytes that a batch on the CPU may hold where nothing is kept for a gradient: its arrays stay in the caches, up to 1.4
# times as fast (fields of 192² pixels, 50 sources) or more (rays at 256² pixels, 13 sources).
CACHED = 32 << 20


@dataclass(frozen=True)
class Foreseen:
    """What an image holds at once, in bytes of tensors beyond the volume, and how that was brought about.

    peak: at most, the backward pass included where a gradient is wanted. least: as little as it can be brought to, by
    single sources whose steps are computed again; peak where the budget is smaller. sources: in a batch. slabs: whether
    each batch's steps are computed again, slab by slab, in the backward pass.
    """

    peak: int
    least: int
    sources: int
    slabs: bool = False


def foreseen(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity = STANDARD,
    *,
    gradient: bool | None = None,
) -> Foreseen:
    """What `image` of the same arguments will hold at once, found without computing it; see `Foreseen`.

    gradient: whether one is wanted, to the volume at least; None is as `image` would find it, by what requires grad. A
    fidelity's object_aberration, on whose strength the memory depends, is found for it. Of an adaptive solver the steps
    are unknown: one a slice is assumed.
    """
    levels = 0
    if fidelity.object_aberration is not None:
        with torch.no_grad():
            plane = reference_plane(volume, fidelity)
            found = [levels_of(volume, plane, part, fidelity) for part, _ in microscope.colours()]
            levels = max(len(part.defocus) for part in found)
    return _foreseen(volume, microscope, acquisition, fidelity, levels, gradient)


def allotted(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, levels: int = 0
) -> Foreseen:
    """How `image` computes within its budget and what is free; levels: of an object_aberration.

    Raises ShortOfMemoryError where even single sources, their steps computed again, want more than is free.
    """
    free = free_bytes(volume.delta.device)
    fidelity = _within(fidelity, free)
    found = _foreseen(volume, microscope, acquisition, fidelity, levels)
    shape = "×".join(map(str, volume.grid.shape))
    what = (
        f"{len(acquisition.prisms)} prism settings × {len(acquisition.focus)} focus planes of {shape} voxels by "
        f'"{fidelity.propagation}"'
    )
    check_room(found.least, free, what)
    return found


def allotted_to_fields(
    transmission: Tensor,
    grid: Grid,
    background: Tensor,
    sources: int,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
) -> Foreseen:
    """`allotted` for `image_field`: fields (y, x) or (source, y, x) that are there already; grid: with the padding."""
    free = free_bytes(transmission.device)
    wanted = torch.is_grad_enabled()
    own = wanted and transmission.requires_grad
    setting = wanted and learned((background, microscope, acquisition))
    # padded, and its spectrum; a gradient of each
    aside = (2 + 2 * own) * 2 * (sources if transmission.ndim == 3 else 1)
    imaging = demand_of_imaging(grid, microscope, acquisition, learned=setting)
    images = len(acquisition.prisms) * len(acquisition.focus)
    scene = _Scene(
        crossing=Demand(0, 0, 0), imaging=imaging, sources=sources, aside=aside, images=images, learned=own or setting
    )
    _, ny, nx = grid.shape
    each = ny * nx * transmission.real.element_size()
    found = _fitted(scene, each, _within(fidelity, free).memory, transmission.device)
    check_room(found.least, free, f"{len(acquisition.prisms)} × {len(acquisition.focus)} images of {ny}×{nx} pixels")
    return found


def levels_of(volume: Volume, plane: float, microscope: Microscope, fidelity: Fidelity) -> Levels:
    """The levels of a fidelity's object_aberration in light of one wavelength."""
    momentum, _ = microscope.sources(fidelity.sources, dtype=volume.delta.dtype, device=volume.delta.device)
    parts = microscope.wavelength, microscope.objective, microscope.condenser
    return object_levels(volume, plane, *parts, momentum, fidelity)


def learned(part: object) -> bool:
    """Whether a tensor anywhere in a dataclass, sequence or mapping requires grad."""
    if isinstance(part, Tensor):
        return part.requires_grad
    if isinstance(part, Mapping):
        return any(learned(value) for value in part.values())
    if isinstance(part, list | tuple):
        return any(learned(value) for value in part)
    if is_dataclass(part):
        return any(learned(getattr(part, field.name)) for field in fields(part))
    return False


# --- the estimate ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scene:
    """What the estimate reads. Values are per pixel, those of a Demand per source too.

    aside: beside the batches. before: at most, before or after them. slices: of each field whose gradient is wanted.
    images: prisms × focus planes. learned: whether a gradient is wanted at all, crosses: whether one goes through the
    specimen. bent: whether rays do.
    """

    crossing: Demand
    imaging: Demand
    sources: int
    images: int
    learned: bool
    crosses: bool = False
    bent: bool = False
    components: int = 1
    colours: int = 1
    slices: int = 0
    aside: float = 0
    before: float = 0

    def values(self, batch: int, *, slabs: bool) -> float:
        """Values per pixel held at most, in batches of so many sources."""
        crossing, imaging, several = self.crossing, self.imaging, batch < self.sources
        spectrum, images = 2 * self.components, (1 + several) * self.images
        if not self.learned:
            crossed = images - self.images + max(batch * crossing.alone, crossing.once)
            imaged = images + imaging.shared + batch * (spectrum + imaging.alone)
            return self.aside + max(crossed, imaged, images + self.images, imaging.once, self.before)
        images += self.images
        imaged = max(imaging.alone, imaging.kept + imaging.working)
        if not self.crosses:
            crossed = images + max(batch * crossing.alone, crossing.once)
            others = 0 if several else (self.colours - 1) * batch * (spectrum + imaging.kept)
            imaged = images + imaging.shared + batch * (spectrum + imaged) + others
            return self.aside + max(crossed, imaged, imaging.once, self.before)
        steps, longest, carried = crossing.steps, crossing.steps, 0.0
        if slabs:
            ranges = list(slab_ranges(steps, split=True))
            longest, carried = max(last - first for first, last in ranges), len(ranges) * crossing.carried
        shared = longest * crossing.shared
        held = batch * (carried if slabs else steps * crossing.step) + (0 if slabs else shared)
        others = (self.colours - 1) * (held + batch * (crossing.kept + imaging.kept))
        found = max(
            images + imaging.shared + held + batch * (crossing.kept + max(crossing.working, imaged)),
            images + held + crossing.once,
            # the last slab in the backward pass, beside the gradients of what lies behind it
            batch * (carried + longest * crossing.step + crossing.back)
            + shared
            + slabs * (1 - longest / steps) * self.slices,
        )
        if several:
            return self.aside + max(found + self.slices, 3 * self.slices, imaging.once, self.before)
        return self.aside + max(found + others, 2 * self.slices, imaging.once, self.before)


def _scene(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
    momentum: Tensor,
    levels: int,
    gradient: bool | None,
) -> _Scene:
    parts = (volume.delta, volume.absorption, volume.background, momentum)
    fields = 1 + (volume.absorption is not None)
    own = sum(part is not None and part.requires_grad for part in parts[:2])
    setting = learned((microscope, acquisition))
    if gradient is None:
        wanted = torch.is_grad_enabled()
        crosses = wanted and any(part is not None and part.requires_grad for part in parts)
    else:
        wanted, crosses, own = gradient, gradient, max(own, int(gradient))
    turned = microscope.turns_polarisation and fidelity.propagation == "rays"
    components = 2 if turned else 1
    if fidelity.propagation == "projection":
        crossing = demand_of_projection(volume, fidelity)
    elif fidelity.propagation == "rays":
        crossing = demand_of_rays(volume, fidelity, turned=turned)
    else:
        crossing = demand_of_wave(volume, momentum, fidelity)
    slices = volume.grid.shape[0]
    grid = volume.grid.widened(fidelity.padding, fidelity.padding)
    pixels = math.prod(grid.shape[1:])
    # the mean depth is found in float64, a spline along one axis after the other
    before = 0.0
    if fidelity.propagation != "wave" and fidelity.reference_plane is None:
        wide = 0 if volume.delta.dtype == torch.float64 else torch.float64.itemsize / volume.delta.element_size()
        before = slices * (1 + wide) * math.prod(volume.grid.shape[1:]) / pixels
    if fidelity.interpolation == "cubic" and fidelity.propagation != "wave":
        before = max(before, 3 * slices)
    aside = (
        fields
        * slices
        * ((fidelity.padding > 0) + (fidelity.interpolation == "cubic" and fidelity.propagation != "wave"))
    )
    if levels:
        crossing = replace(
            crossing,
            alone=max(crossing.alone, 10 * components),
            kept=crossing.kept + components * kept_by_levels(levels),
            working=max(crossing.working, 8 * components),
        )
        aside += levels * (5 if crosses else 1)
        lens = demand_of_map(volume, reference_plane(volume, fidelity), fidelity)
        if not crosses:
            before = max(before, lens.alone)
        elif lens.whole * pixels * volume.delta.element_size() <= fidelity.memory:
            aside += lens.whole
        else:
            ranges = list(slab_ranges(lens.steps, split=True))
            aside += lens.carried * len(ranges)
            before = lens.kept + lens.step * max(last - first for first, last in ranges)
    imaging = demand_of_imaging(grid, microscope, acquisition, components, learned=wanted and setting)
    images, colours = len(acquisition.prisms) * len(acquisition.focus), len(microscope.colours())
    aside += (colours - 1) * images * math.prod(volume.grid.shape[1:]) / pixels
    return _Scene(
        crossing=crossing,
        imaging=imaging,
        sources=len(momentum),
        images=images,
        learned=crosses or (wanted and setting),
        crosses=crosses,
        bent=fidelity.propagation == "rays",
        components=components,
        colours=colours,
        slices=own * slices,
        aside=aside,
        before=before,
    )


def _foreseen(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
    levels: int = 0,
    gradient: bool | None = None,
) -> Foreseen:
    momentum, _ = microscope.sources(fidelity.sources, dtype=volume.delta.dtype, device=volume.delta.device)
    scene = _scene(volume, microscope, acquisition, fidelity, momentum, levels, gradient)
    _, ny, nx = volume.grid.widened(fidelity.padding, fidelity.padding).shape
    return _fitted(scene, ny * nx * volume.delta.element_size(), fidelity.memory, volume.delta.device)


def _within(fidelity: Fidelity, free: int | None) -> Fidelity:
    """The fidelity with a budget of what is free, where that is less."""
    return fidelity if free is None else replace(fidelity, memory=max(1, min(fidelity.memory, free)))


def _fitted(scene: _Scene, each: int, budget: int, device: torch.device) -> Foreseen:
    """As few batches as fit into a budget in bytes; each: bytes of a value per pixel."""
    if not scene.learned and device.type == "cpu":
        budget = min(budget, CACHED)

    def peak(batch: int, *, slabs: bool = False) -> int:
        return math.ceil(scene.values(batch, slabs=slabs) * each)

    # all at once; their steps in slabs (not of rays, faster in small batches); batches of equal size; single sources,
    # whose steps are in slabs if need be
    everything = scene.sources
    ways = [(everything, False)] + ([] if scene.bent else [(everything, True)])
    ways += [(math.ceil(everything / n), False) for n in range(2, everything + 1)]
    ways.append((1, True))
    peaks = {
        (batch, slabs): peak(batch, slabs=slabs) for batch, slabs in dict.fromkeys(ways) if scene.crosses or not slabs
    }
    least = min(peaks.values())
    return next(
        Foreseen(held, least, batch, slabs) for (batch, slabs), held in peaks.items() if held <= max(budget, least)
    )
