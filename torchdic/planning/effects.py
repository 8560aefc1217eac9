"""What each effect of a scene is worth: the error of leaving it out, and its share of the work."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchdic.errors import SidewaysError, TurnedRaysError, UnstableError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition
from torchdic.planning.comparisons import BENT, STRAIGHT, TRUTH
from torchdic.planning.cost import work
from torchdic.planning.image_error import relative
from torchdic.planning.ladders import Choice, Side
from torchdic.planning.pilots import MOST_UNSTABLE, Scene
from torchdic.specimen.volume import Volume

# Rays cost so much that they see a smaller window, at few directions and in few steps.
RAY_WINDOW, RAY_SOURCES, RAY_STEPS = 32, 3, 8


def counted(number: int, noun: str) -> str:
    """A number of things: 1 slab, 2 slabs."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


@dataclass(frozen=True)
class Effect:
    """An effect, and what it is worth.

    needed: whether leaving it out alone would break the tolerance. error: of the images if it is left out, estimated.
    cost: share of the run's work that would be saved without it. basis: where the estimate comes from, "pilot", "bound"
    (the error is at most this) or "absent" (the scene doesn't declare it). note: what was compared, or chosen.
    """

    name: str
    needed: bool
    error: float
    cost: float
    basis: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class Climbed:
    """What the ladders found: a pilot of few sources and its coarse slabs, the truth's images in it, the choices."""

    pilot: Scene
    coarse: Fidelity
    truth: Tensor
    ways: Sequence[Choice]
    counts: Sequence[Choice]
    sides: Sequence[Side]


def effects(scene: Scene, climbed: Climbed, fidelity: Fidelity, tolerance: float) -> tuple[Effect, ...]:
    """Every effect's worth to a scene that is computed at a fidelity."""
    pilot, coarse, truth, counts, sides = (
        climbed.pilot,
        climbed.coarse,
        climbed.truth,
        climbed.counts,
        climbed.sides,
    )
    whole = work(fidelity, scene.volume, scene.microscope, scene.acquisition)

    def saved(other: Fidelity, less: Scene = scene) -> float:
        return max(0.0, 1 - work(other, less.volume, less.microscope, less.acquisition) / whole)

    def effect(name: str, error: float, note: str, cost: float = 0.0, basis: str = "pilot") -> Effect:
        return Effect(name, error > tolerance, error, cost, basis, note)

    def against_truth(images: Tensor) -> float:
        return relative(images, truth)

    found = _optics(climbed, tolerance, effect)
    found[0] = replace(found[0], cost=saved(replace(fidelity, propagation=STRAIGHT)))

    K = fidelity.sources
    if len(counts) == 1 and counts[0].fidelity.sources == K:
        note = f"the condenser's own {counted(K, 'direction')}"
        found.append(Effect("partial coherence", K > 1, 0.0, 0.0, "absent", note))
    else:
        fewest = counts[0].fidelity.sources
        note = f"{counted(fewest, 'source')} in place of {K}"
        cost = saved(replace(fidelity, sources=fewest))
        found.append(effect("partial coherence", against_truth(counts[0].lacks), note, cost))

    steps, images = _fewest_slabs(pilot)
    note = f"{counted(steps, 'slab')} in place of several" + ("; fewer make energy" if steps > 1 else "")
    lost = against_truth(images - pilot(replace(coarse, order=2)))
    found.append(effect("steps", lost, note, saved(replace(fidelity, steps=1))))

    base = pilot(coarse)
    paraxial = against_truth(pilot(replace(coarse, defocus="paraxial")) - base)
    found.append(effect("defocus", paraxial, "paraxial in place of exact"))
    if sides[-1].padding > 0:
        found.append(effect("sides", sides[0].error(K), "no padding", saved(replace(fidelity, padding=0))))
    else:
        found.append(_absent("sides"))

    def without(name: str, less: Scene, full: Scene) -> Effect:
        try:
            images = less(coarse)
        except UnstableError:
            return effect(name, 1.0, "left out, light can't go on", saved(fidelity, full), basis="bound")
        return effect(name, relative(images - base, base), "left out", saved(fidelity, full))

    microscope, volume = scene.microscope, scene.volume
    if microscope.polarisation is None:
        found.append(_absent("polarisation"))
    else:
        found.append(without("polarisation", *(_changed(s, polarisation=None) for s in (pilot, scene))))
    if volume.absorption is None:
        found.append(_absent("absorption"))
    else:
        found.append(without("absorption", *(_clear(s) for s in (pilot, scene))))
    if microscope.spectrum is not None:
        nominal = microscope.wavelength  # the pilot's differs
        one = (_changed(s, spectrum=None, wavelength=nominal) for s in (pilot, scene))
        found.append(without("spectrum", *one))
    camera = microscope.camera
    if camera is None:
        found.append(_absent("camera"))
    elif camera.pixel_size is None:
        found.append(Effect("camera", False, 0.0, 0.0, "bound", "its noise is added to a noiseless image"))
    else:
        sharp = _changed(pilot, camera=None)(coarse)
        grid = pilot.volume.grid
        blurred = _through_pixels(sharp, grid, camera.pixel_spacing((grid.spacing[1], grid.spacing[2])))
        found.append(effect("camera", relative(blurred - sharp, blurred), "pixels that see no area"))
    return tuple(found)


def _absent(name: str) -> Effect:
    return Effect(name, False, 0.0, 0.0, "absent")


def _changed(scene: Scene, **parts: float | None) -> Scene:
    return replace(scene, microscope=replace(scene.microscope, **parts))


def _clear(scene: Scene) -> Scene:
    volume = scene.volume
    return replace(scene, volume=Volume(volume.grid, volume.delta, volume.background))


def _fewest_slabs(pilot: Scene) -> tuple[int, Tensor]:
    """The fewest slabs, of 1, 2, 4, …, that carry the light, and their images."""
    steps = 1
    while True:
        try:
            return steps, pilot(Fidelity(TRUTH, steps=steps))
        except UnstableError:
            if steps >= MOST_UNSTABLE * pilot.slices:
                raise
        steps *= 2


def _through_pixels(images: Tensor, grid: Grid, pixel: tuple[float, float]) -> Tensor:
    """Images averaged over a pixel's area at each voxel."""
    fy, fx = grid.frequencies(dtype=images.dtype, device=images.device)
    window = torch.sinc(fy * pixel[0]) * torch.sinc(fx * pixel[1])
    return torch.fft.ifft2(torch.fft.fft2(images) * window).real


def _optics(climbed: Climbed, tolerance: float, effect: Callable[..., Effect]) -> list[Effect]:
    """What each rung between straight rays and waves adds; bounds where projection is good enough or rays fail."""
    names = "bending", "amplitude", "diffraction", "object aberration"
    note = "all that projection lacks"
    finest = next(way for way in climbed.ways if way.fidelity.propagation == TRUTH)
    projection = next((way for way in climbed.ways if way.fidelity.propagation == STRAIGHT), None)
    if projection is None:
        return [effect(name, 1.0, "light along straight rays can't go on toward +z", basis="bound") for name in names]
    straight = relative(projection.lacks, climbed.truth)
    if straight <= tolerance / 2:
        return [effect(name, straight, note, basis="bound") for name in names]
    acquisition = climbed.pilot.acquisition
    ends = [acquisition.focus[0], acquisition.focus[-1]]
    # a camera's pixels may not fit into so small a window
    small = _changed(replace(climbed.pilot, acquisition=Acquisition(acquisition.prisms[:1], ends)), camera=None)
    small = small.window(RAY_WINDOW).lit(RAY_SOURCES)
    steps = min(small.slices, RAY_STEPS)
    rays = Fidelity(BENT, steps=steps)
    try:
        wave = small(finest.fidelity)
        projected = small(Fidelity(STRAIGHT))
        bent = small(replace(rays, amplitude=False))
        carried = small(rays)
    except (TurnedRaysError, SidewaysError, UnstableError) as error:
        return [effect(name, straight, f"{note}; {error}", basis="bound") for name in names]
    found = [
        effect("bending", relative(bent - projected, wave), "bent rays against straight ones"),
        effect("amplitude", relative(carried - bent, wave), "rays with and without it"),
        effect("diffraction", relative(wave - carried, wave), "the wave against rays"),
    ]
    try:
        own = small(Fidelity(STRAIGHT, object_aberration="linear", steps=steps))
    except ValueError as error:  # too strong a lens
        return [*found, effect(names[-1], straight, f"{note}; {error}", basis="bound")]
    seen = "in straight rays; the wave has it already"
    return [*found, effect(names[-1], relative(own - projected, wave), seen)]
