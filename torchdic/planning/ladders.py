"""What each choice of a fidelity lacks: of sources, of ways to cross the specimen, and of sides.

Each of the three is tried on its own, from the coarsest choice up to where the image stands still: a ladder. What a
choice lacks is kept as an image and not as a number, because the errors of two choices may cancel or add up.
"""

import contextlib
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from torchdic.errors import UnstableError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.planning.comparisons import CANNOT_CROSS, TRUTH
from torchdic.planning.cost import crossing, directions
from torchdic.planning.image_error import relative
from torchdic.planning.pilots import MOST, MOST_UNSTABLE, Scene
from torchdic.propagation.base import propagations
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# The part of the tolerance that the error of a pilot may reach. The rest is left for what a pilot doesn't see: all of
# the volume outside its window, and most focus planes.
PILOT_SHARE = 0.6

# Numbers of sources to try. They are those of the condenser's quadrature, K rings of 2K, each as good as its number can
# be within a pupil.
COUNTS = (1, 8, 18, 32, 50, 72, 128, 200, 392)

# Sources of the images that tell how wide the sides must be.
AT_SIDES = 8

# Reach of a lens's own blur, in wavelengths over NA. The tail that a pupil's sharp edge leaves falls off slowly.
BLUR = 12.0

Order = Literal[1, 2]


@dataclass(frozen=True, eq=False)
class Choice:
    """One way to compute an image, and how far it falls short.

    lacks: its images less those of the best choice tried.
    beyond: the error that the best choice may still have.
    """

    fidelity: Fidelity
    lacks: Tensor
    beyond: float = 0.0


@dataclass(frozen=True)
class Side:
    """An amount of padding, and the error of the light that still comes back in at the opposite side.

    padding: in voxels.
    steady: the part of the error that any number of sources has.
    fringes: the part that averages out over sources, as the root of their number; that of AT_SIDES sources.
    """

    padding: int
    steady: float
    fringes: float

    def error(self, sources: int) -> float:
        """The error of images that are lit by so many sources."""
        return math.hypot(self.steady, self.fringes * math.sqrt(AT_SIDES / max(sources, AT_SIDES)))


@dataclass(frozen=True, eq=False)
class Climbed:
    """What the three ladders found.

    pilot: the small scene with few sources in which ways to cross the specimen were compared.
    coarse: slabs that serve questions which aren't about slabs.
    truth: the pilot's converged images, with all of the condenser's sources.
    ways, counts, sides: the choices tried.
    """

    pilot: Scene
    coarse: Fidelity
    truth: Tensor
    ways: Sequence[Choice]
    counts: Sequence[Choice]
    sides: Sequence[Side]


def climb(scene: Scene, pilot: Scene, coarse: Fidelity, tolerance: float) -> Climbed:
    """Climb the three ladders of a scene; `coarse` slabs serve the questions that aren't about slabs."""
    counts, dense = source_ladder(pilot, coarse, tolerance)
    few = sparse(pilot, counts, dense)
    ways, truth = way_ladder(few, tolerance)
    if counts:
        # all sources in place of few change the true image by what they change in the coarse one
        truth = truth + dense - few(coarse)
    else:
        counts = [Choice(replace(coarse, sources=directions(scene.microscope, 1)), torch.zeros_like(truth))]
    whole = replace(scene, microscope=pilot.microscope, acquisition=pilot.acquisition)
    return Climbed(few, coarse, truth, ways, counts, side_ladder(whole, coarse, tolerance))


def source_ladder(pilot: Scene, coarse: Fidelity, tolerance: float) -> tuple[list[Choice], Tensor]:
    """Numbers of sources with the images that they lack, up to where the coarse image stands still, and that image.

    There are no choices where there is no condenser, where it names its own points, or where its NA is 0.
    """
    condenser = pilot.microscope.condenser
    if condenser is None or condenser.points is not None or condenser.na == 0:
        return [], pilot(coarse)
    counts = [n for n in COUNTS if condenser.inner_na is None or n > 1]
    images: list[Tensor] = []
    beyond = 0.0
    for n, count in enumerate(counts):
        images.append(pilot(replace(coarse, sources=count)))
        if count < 18 or n < 2:
            continue  # images of fewer sources may agree by chance
        change, before = (relative(images[i] - images[i - 1], images[-1]) for i in (n, n - 1))
        # where a pupil's sharp edge cuts the sources off the error falls as 1/K, within the pupil faster: the geometric
        # mean of that and of what was seen is used
        fall = counts[n - 1] / count
        if counts[n - 2] > 1:
            fall = min(math.sqrt(fall * change / max(before, 1e-300)), 0.9)
        # the errors of two numbers of sources are independent: their squares add up to the square of the change
        beyond = change * fall / math.hypot(1, fall)
        if beyond <= PILOT_SHARE / 2 * tolerance:
            break
    seen = zip(counts, images, strict=False)
    return [Choice(replace(coarse, sources=count), i - images[-1], beyond) for count, i in seen], images[-1]


def sparse(pilot: Scene, counts: list[Choice], dense: Tensor) -> Scene:
    """The pilot with as few sources as suffice to tell ways of crossing the specimen apart."""
    enough = (c.fidelity.sources for c in counts if relative(c.lacks, dense) <= 0.1)
    return pilot.lit(min(max(next(enough, 18), 8), 18))


def way_ladder(pilot: Scene, tolerance: float) -> tuple[list[Choice], Tensor]:
    """Ways to cross the specimen with the images that they lack, and the wave's converged images.

    Raises UnstableError where no two numbers of slabs carry the light.
    """
    most, truth = _converged(pilot, tolerance)
    return [*_planned_ways(pilot, truth), *_slab_ways(pilot, most, truth, tolerance)], truth


def _slabs(pilot: Scene, steps: int, order: Order = 2) -> Tensor:
    """The wave's images in so many slabs; images of nan where they don't carry the light.

    Raises UnstableError where even as many slabs as are tried at most don't, in the second order.
    """
    try:
        return pilot(Fidelity(TRUTH, steps=steps, order=order))
    except UnstableError:
        if order == 2 and steps >= MOST_UNSTABLE * pilot.slices:
            raise
        return pilot.nothing()


def _converged(pilot: Scene, tolerance: float) -> tuple[int, Tensor]:
    """The number of slabs from which on the image stands still, and the image of infinitely many.

    Slabs are doubled until then. Their error is of second order, so that the images of two numbers of slabs tell the
    third (Richardson's extrapolation).
    """
    fine = max(pilot.slices, 2)
    ladder = [-(-fine // 2), fine, 2 * fine]  # slabs that merge slices tell nothing of those that divide them
    while True:
        coarser, middle, finest = (_slabs(pilot, m) for m in ladder[-3:])
        last, before = relative(finest - middle, finest), relative(middle - coarser, finest)
        if math.isfinite(last):
            # between first order, at edges, and the split step's second
            ratio = min(max(1.5, before / max(last, 1e-300)), 4.0) if math.isfinite(before) else 1.5
            if last / (ratio - 1) <= PILOT_SHARE / 2 * tolerance or ladder[-1] >= MOST * pilot.slices:
                return ladder[-1], finest + (finest - middle) / (ratio - 1)
        ladder.append(2 * ladder[-1])


def _planned_ways(pilot: Scene, truth: Tensor) -> list[Choice]:
    """The fidelities that propagations offer to the planner, but for those whose light can't cross the specimen."""
    ways = []
    for fidelity in (f for propagation in propagations() for f in propagation.planned()):
        with contextlib.suppress(*CANNOT_CROSS):
            ways.append(Choice(fidelity, pilot(fidelity) - truth))
    return ways


def _slab_ways(pilot: Scene, most: int, truth: Tensor, tolerance: float) -> list[Choice]:
    """The wave in each order, in `most` slabs and then half as many again and again, while the error is acceptable."""
    ways: list[Choice] = []
    dearest = math.inf  # from this work on the second order serves better than the first
    orders: tuple[Order, ...] = 2, 1
    for order in orders:
        steps = most
        while steps > 1 and crossing(Fidelity(TRUTH, steps=steps, order=order), pilot.volume) >= dearest:
            steps = -(-steps // 2)
        while True:
            fidelity = Fidelity(TRUTH, steps=steps, order=order)
            lacks = _slabs(pilot, steps, order) - truth
            if not bool(torch.isfinite(lacks).all()):
                break
            ways.append(Choice(fidelity, lacks))
            error = relative(lacks, truth)
            if order == 2 and error <= PILOT_SHARE / 8 * tolerance:
                dearest = crossing(fidelity, pilot.volume)
            if steps == 1 or error > 4 * tolerance:
                break
            steps = -(-steps // 2)
    return ways


def side_ladder(scene: Scene, coarse: Fidelity, tolerance: float) -> list[Side]:
    """Amounts of padding, from none to the one from which on no recorded light comes back."""
    needed = needed_padding(scene)
    if needed == 0:
        return [Side(0, 0.0, 0.0)]
    shape = scene.volume.grid.shape[1:]
    half, width = (_fast(-(-needed // part), shape) for part in (2, 1))
    parts = scene.lit(AT_SIDES).halves()
    widest = [part(replace(coarse, padding=width)) for part in parts]
    truth = sum(widest, start=torch.zeros_like(widest[0])) / len(parts)

    def lost(width: int) -> Side:
        one, *other = (part(replace(coarse, padding=width)) - w for part, w in zip(parts, widest, strict=True))
        if not other:
            return Side(width, relative(one, truth), 0.0)
        # two halves of the sources differ by as much as all of them differ from twice as many
        error, fringes = relative((one + other[0]) / 2, truth), relative((one - other[0]) / 2, truth)
        return Side(width, math.sqrt(max(error**2 - fringes**2, 0.0)), fringes)

    narrower = [lost(0)]
    if narrower[0].error(1) > PILOT_SHARE / 4 * tolerance and half < width:  # otherwise none is needed
        narrower.append(lost(half))
    # the blur's tail falls off slowly: a third of the error remains beyond the widest padding, and all of it where too
    # few sources average out its rings
    part = 3 if len(parts) > 1 and directions(scene.microscope, AT_SIDES) >= AT_SIDES else 1
    steady, fringes = narrower[-1].steady / part, narrower[-1].fringes / part
    return [*(Side(s.padding, s.steady + steady, s.fringes + fringes) for s in narrower), Side(width, steady, fringes)]


def _fast(padding: int, shape: tuple[int, ...]) -> int:
    """The least padding from this one on that makes the lengths of the FFTs fast, products of small primes.

    Other lengths take up to five times as long.
    """
    for wider in range(padding, padding + 16):
        if all(next_fast_len(n + 2 * wider) == n + 2 * wider for n in shape):
            return wider
    return padding


def needed_padding(scene: Scene) -> int:
    """Voxels of padding on each side that keep recorded light from coming back; 0 where the specimen reaches a side."""
    volume, microscope, acquisition = scene.volume, scene.microscope, scene.acquisition
    grid, filled = volume.grid, _spans(volume)
    if filled is None or min(gaps := _gaps(grid, filled)) == 0:
        return 0
    depths = [grid.centre(0, i) for i in filled[0]]
    distance = max(abs(number(z) - d) for z, d in itertools.product(acquisition.focus, depths))
    n0 = number(volume.background)
    sine = min((n0 if microscope.objective is None else microscope.objective.reach(n0)) / n0, 0.95)
    shear = max((abs(number(s)) for p in acquisition.prisms if p is not None for s in p.shear), default=0.0)
    reach = distance * sine / math.sqrt(1 - sine**2) + shear + BLUR * microscope.wavelength / (n0 * sine)
    beyond = max(reach / grid.spacing[a] - gap for a, gap in zip((1, 2), gaps, strict=True))
    return min(max(0, math.ceil(beyond / 2)), max(grid.shape[1:]) // 2)


def reaches_a_side(volume: Volume) -> bool:
    """Whether the outermost voxels along y or x hold a part of the specimen: padding would then change the scene."""
    filled = _spans(volume)
    return filled is not None and min(_gaps(volume.grid, filled)) == 0


def _spans(volume: Volume) -> list[tuple[int, int]] | None:
    """The first and last voxel that the specimen fills, along z, y and x; None where the volume is empty."""
    strength = volume.delta.abs()
    if volume.absorption is not None:
        strength = strength + volume.absorption
    there = strength > 1e-3 * strength.max()
    if not bool(there.any()):
        return None
    found = []
    for axis in range(3):
        filled = there.any(dim=tuple(a for a in range(3) if a != axis)).nonzero()
        found.append((int(filled[0]), int(filled[-1])))
    return found


def _gaps(grid: Grid, filled: list[tuple[int, int]]) -> list[int]:
    """Empty voxels between the specimen and the nearer side of the volume, along y and x."""
    return [min(filled[a][0], grid.shape[a] - 1 - filled[a][1]) for a in (1, 2)]
