"""What an effect is worth in a scene: one function for each effect, all of the signature `Measure`.

Each computes a small image, a pilot, with the effect and without it. Where that isn't possible, because light can't
cross the specimen without the effect, it states a bound instead.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchdic.errors import UnstableError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition
from torchdic.planning.comparisons import BENT, CANNOT_CROSS, STRAIGHT, TRUTH
from torchdic.planning.image_error import relative
from torchdic.planning.ladders import Climbed
from torchdic.planning.pilots import MOST_UNSTABLE, Scene

# Bent rays cost so much that they are computed in a smaller window (voxels), from few sources and in few steps.
RAY_WINDOW, RAY_SOURCES, RAY_STEPS = 32, 3, 8


@dataclass(frozen=True)
class Worth:
    """What an effect is worth; see `torchdic.Effect` for error, note, cost and basis.

    needed: None where the error and the tolerance decide it.
    """

    error: float
    note: str = ""
    cost: float = 0.0
    basis: str = "pilot"
    needed: bool | None = None


ABSENT = Worth(0.0, basis="absent")
"""The worth of an effect that the scene doesn't have."""


@dataclass(frozen=True, eq=False)
class PlannedScene:
    """A scene, what the ladders found about it, and the fidelity that was planned for a tolerance."""

    scene: Scene
    climbed: Climbed
    fidelity: Fidelity
    tolerance: float

    def error(self, difference: Tensor) -> float:
        """The error of the pilot's images that differ from the truth by so much."""
        return relative(difference, self.climbed.truth)

    def saved(self, other: Fidelity, scene: Scene | None = None) -> float:
        """The part of the work that is saved with another fidelity, or in a scene with less in it."""
        less = self.scene if scene is None else scene
        return max(0.0, 1 - less.work(other) / self.scene.work(self.fidelity))

    @cached_property
    def base(self) -> Tensor:
        """The pilot's images in its coarse slabs, with which an effect is compared where slabs don't matter."""
        return self.climbed.pilot(self.climbed.coarse)

    @cached_property
    def ray_images(self) -> "RayImages | Worth":
        """Images by rays and by the wave in a small window; a bound where they aren't needed or can't be computed.

        They aren't needed where straight rays already stay within half the tolerance.
        """
        climbed = self.climbed
        projection = next((way for way in climbed.ways if way.fidelity.propagation == STRAIGHT), None)
        if projection is None:
            return Worth(1.0, "light along straight rays can't go on toward +z", basis="bound")
        bound = Worth(self.error(projection.lacks), "all that projection lacks", basis="bound")
        if bound.error <= self.tolerance / 2:
            return bound
        finest = next(way for way in climbed.ways if way.fidelity.propagation == TRUTH)
        try:
            return RayImages.of(climbed.pilot, finest.fidelity, bound)
        except CANNOT_CROSS as error:
            return replace(bound, note=f"{bound.note}; {error}")


@dataclass(frozen=True, eq=False)
class RayImages:
    """Images of a small window that tell apart what rays and waves contain, (prism, focus, y, x).

    window: the scene that they show.
    steps: of the bent rays.
    straight, bent, carried, wave: by straight rays, by bent ones without their amplitude, by bent ones with it, and by
        the wave.
    bound: the error of all that straight rays lack.
    """

    window: Scene
    steps: int
    straight: Tensor
    bent: Tensor
    carried: Tensor
    wave: Tensor
    bound: Worth

    @classmethod
    def of(cls, pilot: Scene, finest: Fidelity, bound: Worth) -> "RayImages":
        """Compute them in a part of a pilot, the wave with its finest slabs; raises one of CANNOT_CROSS."""
        focus = pilot.acquisition.focus
        seen = Acquisition(pilot.acquisition.prisms[:1], [focus[0], focus[-1]])
        # a camera's pixels may not fit into so small a window
        window = replace(pilot, acquisition=seen).changed(camera=None).window(RAY_WINDOW).lit(RAY_SOURCES)
        steps = min(window.slices, RAY_STEPS)
        bent = Fidelity(BENT, steps=steps)
        return cls(
            window,
            steps,
            wave=window(finest),
            straight=window(Fidelity(STRAIGHT)),
            bent=window(replace(bent, amplitude=False)),
            carried=window(bent),
            bound=bound,
        )

    def error(self, difference: Tensor) -> float:
        """The error of images that differ from the wave's by so much."""
        return relative(difference, self.wave)


Measure = Callable[[PlannedScene], Worth | None]
"""Finds an effect's worth in a scene: ABSENT where the scene doesn't have it, None where the table then has no row."""


def ray_step(difference: Callable[[RayImages], Tensor], note: str) -> Callable[[PlannedScene], Worth]:
    """A function that compares two images by rays or waves; where there are none, it states their bound."""

    def measured(planned: PlannedScene) -> Worth:
        rays = planned.ray_images
        return rays if isinstance(rays, Worth) else Worth(rays.error(difference(rays)), note)

    return measured


def straight_rays(planned: PlannedScene) -> Worth:
    """Rays that go straight on in place of bent ones."""
    found = ray_step(lambda rays: rays.bent - rays.straight, "bent rays against straight ones")(planned)
    return replace(found, cost=planned.saved(replace(planned.fidelity, propagation=STRAIGHT)))


def object_aberration(planned: PlannedScene) -> Worth:
    """The specimen's own defocus of each object point, added to straight rays."""
    rays = planned.ray_images
    if isinstance(rays, Worth):
        return rays
    try:
        own = rays.window(Fidelity(STRAIGHT, object_aberration="linear", steps=rays.steps))
    except ValueError as error:  # too strong a lens
        return replace(rays.bound, note=f"{rays.bound.note}; {error}")
    return Worth(rays.error(own - rays.straight), "in straight rays; the wave has it already")


def sources(planned: PlannedScene) -> Worth:
    """The fewest directions of light in place of the planned number."""
    number, counts = planned.fidelity.sources, planned.climbed.counts
    fewest = counts[0].fidelity.sources
    if len(counts) == 1 and fewest == number:
        note = f"the condenser's own {counted(number, 'direction')}"
        return replace(ABSENT, note=note, needed=number > 1)
    note = f"{counted(fewest, 'source')} in place of {number}"
    return Worth(planned.error(counts[0].lacks), note, planned.saved(replace(planned.fidelity, sources=fewest)))


def single_slab(planned: PlannedScene) -> Worth:
    """One slab in place of several, or the fewest that carry the light."""
    pilot, coarse = planned.climbed.pilot, planned.climbed.coarse
    steps, images = _fewest_slabs(pilot)
    note = f"{counted(steps, 'slab')} in place of several" + ("; fewer make energy" if steps > 1 else "")
    lost = planned.error(images - pilot(replace(coarse, order=2)))
    return Worth(lost, note, planned.saved(replace(planned.fidelity, steps=1)))


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


def paraxial_defocus(planned: PlannedScene) -> Worth:
    """The paraxial form of the defocus in place of the exact one."""
    paraxial = planned.climbed.pilot(replace(planned.climbed.coarse, defocus="paraxial"))
    return Worth(planned.error(paraxial - planned.base), "paraxial in place of exact")


def sides(planned: PlannedScene) -> Worth:
    """No padding in place of the widest that was tried."""
    tried = planned.climbed.sides
    if tried[-1].padding == 0:
        return ABSENT
    fidelity = planned.fidelity
    return Worth(tried[0].error(fidelity.sources), "no padding", planned.saved(replace(fidelity, padding=0)))


def left_out(
    declared: Callable[[Scene], bool],
    without: Callable[[Scene, PlannedScene], Scene],
    otherwise: Worth | None = ABSENT,
) -> Measure:
    """A function that leaves out a part of a scene which not every scene has.

    declared: whether a scene has it.
    without: the whole scene, or a pilot of it, with this part left out.
    otherwise: the worth where a scene doesn't have it.
    """

    def measured(planned: PlannedScene) -> Worth | None:
        if not declared(planned.scene):
            return otherwise
        pilot = without(planned.climbed.pilot, planned)
        saved = planned.saved(planned.fidelity, without(planned.scene, planned))
        try:
            images = pilot(planned.climbed.coarse)
        except UnstableError:
            return Worth(1.0, "left out, light can't go on", saved, "bound")
        return Worth(relative(images - planned.base, planned.base), "left out", saved)

    return measured


def camera_pixels(planned: PlannedScene) -> Worth:
    """Pixels that see a point in place of those that see their whole area; a camera's noise isn't part of an image."""
    camera, pilot = planned.scene.microscope.camera, planned.climbed.pilot
    if camera is None:
        return ABSENT
    if camera.pixel_size is None:
        return Worth(0.0, "its noise is added to a noiseless image", basis="bound")
    sharp = pilot.changed(camera=None)(planned.climbed.coarse)
    grid = pilot.volume.grid
    blurred = _through_pixels(sharp, grid, camera.pixel_spacing((grid.spacing[1], grid.spacing[2])))
    return Worth(relative(blurred - sharp, blurred), "pixels that see no area")


def _through_pixels(images: Tensor, grid: Grid, pixel: tuple[float, float]) -> Tensor:
    """Images averaged over the area of a pixel, µm (y, x), around each voxel."""
    fy, fx = grid.frequencies(dtype=images.dtype, device=images.device)
    window = torch.sinc(fy * pixel[0]) * torch.sinc(fx * pixel[1])
    return torch.fft.ifft2(torch.fft.fft2(images) * window).real


def counted(number: int, noun: str) -> str:
    """A number of things: 1 slab, 2 slabs."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
