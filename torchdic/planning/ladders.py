"""What each choice of a fidelity lacks: sources, ways across the specimen and sides, each climbed on its own.

What a choice lacks is an image, not a number, because the errors of two choices may cancel or add up.
"""

import contextlib
import itertools
import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from torchdic.errors import TurnedRaysError, UnstableError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.planning.comparisons import TRUTH
from torchdic.planning.cost import directions
from torchdic.planning.image_error import relative
from torchdic.planning.pilots import MOST, MOST_UNSTABLE, Scene
from torchdic.propagation.base import propagations
from torchdic.propagation.wave import SLAB
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# What a pilot predicts must stay below this part of the tolerance: the rest is for what a window and few planes miss.
PREDICTED = 0.6

# Sources of the condenser's quadrature, K rings of 2K: each is as good as its number can be within a pupil.
COUNTS = (1, 8, 18, 32, 50, 72, 128, 200, 392)

# Sources that see the sides.
AT_SIDES = 8

# Reach of a lens's own blur in wavelengths over NA: the tail that a pupil's edge leaves falls off slowly.
BLUR = 12.0


@dataclass(frozen=True, eq=False)
class Choice:
    """One way to compute, the images by which it falls short of the best one tried, and what that one may lack."""

    fidelity: Fidelity
    lacks: Tensor
    beyond: float = 0.0


@dataclass(frozen=True)
class Side:
    """Padding in voxels, and the error of light that comes back on the other side: steady, and fringes of AT_SIDES.

    Fringes of many sources average out, as the root of their number.
    """

    padding: int
    steady: float
    fringes: float

    def error(self, sources: int) -> float:
        """Of images that so many sources light."""
        return math.hypot(self.steady, self.fringes * math.sqrt(AT_SIDES / max(sources, AT_SIDES)))


def source_ladder(pilot: Scene, coarse: Fidelity, tolerance: float) -> tuple[list[Choice], Tensor]:
    """Numbers of sources with what they lack, up to where the coarse image stands still, and that image.

    No choices where the condenser leaves none.
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
            continue  # fewer may agree by chance
        change, before = (relative(images[i] - images[i - 1], images[-1]) for i in (n, n - 1))
        # behind a sharp pupil the error falls as 1/K, within it faster: by about what both say
        fall = counts[n - 1] / count
        if counts[n - 2] > 1:
            fall = min(math.sqrt(fall * change / max(before, 1e-300)), 0.9)
        # errors of two numbers have little in common, so that their squares add up to the change's
        beyond = change * fall / math.hypot(1, fall)
        if beyond <= PREDICTED / 2 * tolerance:
            break
    seen = zip(counts, images, strict=False)
    return [Choice(replace(coarse, sources=count), i - images[-1], beyond) for count, i in seen], images[-1]


def sparse(pilot: Scene, counts: list[Choice], dense: Tensor) -> Scene:
    """The pilot with as few sources as tell its ways of crossing the specimen apart."""
    enough = (c.fidelity.sources for c in counts if relative(c.lacks, dense) <= 0.1)
    return pilot.lit(min(max(next(enough, 18), 8), 18))


def way_ladder(pilot: Scene, tolerance: float) -> tuple[list[Choice], Tensor]:
    """Ways to cross the specimen with the images that they lack, and the wave's converged image.

    Slabs are doubled until the image stands still; their error is second order, so that two runs tell the third
    (Richardson). Raises UnstableError where no two runs are stable.
    """

    def crossed(steps: int, order: Literal[1, 2] = 2) -> Tensor:
        try:
            return pilot(Fidelity(TRUTH, steps=steps, order=order))
        except UnstableError:
            if order == 2 and steps >= MOST_UNSTABLE * pilot.slices:
                raise
            return pilot.nothing()

    fine = max(pilot.slices, 2)
    ladder = [-(-fine // 2), fine, 2 * fine]  # slabs that merge slices tell nothing of those that divide them
    while True:
        coarser, middle, finest = (crossed(m) for m in ladder[-3:])
        last, before = relative(finest - middle, finest), relative(middle - coarser, finest)
        if math.isfinite(last):
            # between first order, at edges, and the split step's second
            ratio = min(max(1.5, before / max(last, 1e-300)), 4.0) if math.isfinite(before) else 1.5
            if last / (ratio - 1) <= PREDICTED / 2 * tolerance or ladder[-1] >= MOST * pilot.slices:
                break
        ladder.append(2 * ladder[-1])
    truth = finest + (finest - middle) / (ratio - 1)

    ways: list[Choice] = []
    for fidelity in (f for propagation in propagations() for f in propagation.planned()):
        with contextlib.suppress(TurnedRaysError):  # where straight rays can't go on, waves may
            ways.append(Choice(fidelity, pilot(fidelity) - truth))
    orders: tuple[Literal[1, 2], ...] = 2, 1
    dearest = math.inf  # beyond this work the second order serves better
    for order in orders:
        steps = ladder[-1]
        while SLAB[order] * steps >= dearest:
            steps = -(-steps // 2)
        while steps >= 1:
            lacks = crossed(steps, order) - truth
            if not bool(torch.isfinite(lacks).all()):
                break
            ways.append(Choice(Fidelity(TRUTH, steps=steps, order=order), lacks))
            error = relative(lacks, truth)
            if order == 2 and error <= PREDICTED / 8 * tolerance:
                dearest = SLAB[2] * steps
            if steps == 1 or error > 4 * tolerance:
                break
            steps = -(-steps // 2)
    return ways, truth


def side_ladder(scene: Scene, coarse: Fidelity, tolerance: float) -> list[Side]:
    """Paddings, up to where no recorded light comes back."""
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
        # where two halves of the sources differ, so do all from twice as many
        error, fringes = relative((one + other[0]) / 2, truth), relative((one - other[0]) / 2, truth)
        return Side(width, math.sqrt(max(error**2 - fringes**2, 0.0)), fringes)

    narrower = [lost(0)]
    if narrower[0].error(1) > PREDICTED / 4 * tolerance and half < width:  # or none is needed
        narrower.append(lost(half))
    # the blur's tail falls off slowly: so much lies beyond the widest, and more where no sources average its rings
    part = 3 if len(parts) > 1 and directions(scene.microscope, AT_SIDES) >= AT_SIDES else 1
    steady, fringes = narrower[-1].steady / part, narrower[-1].fringes / part
    return [*(Side(s.padding, s.steady + steady, s.fringes + fringes) for s in narrower), Side(width, steady, fringes)]


def _fast(padding: int, shape: tuple[int, ...]) -> int:
    """The least padding from this one on that leaves lengths of few small factors: others take up to five times."""
    for wider in range(padding, padding + 16):
        if all(next_fast_len(n + 2 * wider) == n + 2 * wider for n in shape):
            return wider
    return padding


def needed_padding(scene: Scene) -> int:
    """Voxels on each side beyond which no recorded light comes back; 0 where the specimen reaches a side."""
    volume, microscope, acquisition = scene.volume, scene.microscope, scene.acquisition
    grid, filled = volume.grid, _spans(volume)
    if filled is None or min(gaps := _gaps(grid, filled)) == 0:
        return 0
    depths = [grid.centre(0, i) for i in filled[0]]
    distance = max(abs(number(z) - d) for z, d in itertools.product(acquisition.focus, depths))
    n0 = number(volume.background)
    sine = min((n0 if microscope.objective is None else microscope.objective.na) / n0, 0.95)
    shear = max((abs(number(s)) for p in acquisition.prisms if p is not None for s in p.shear), default=0.0)
    reach = distance * sine / math.sqrt(1 - sine**2) + shear + BLUR * microscope.wavelength / (n0 * sine)
    beyond = max(reach / grid.spacing[a] - gap for a, gap in zip((1, 2), gaps, strict=True))
    return min(max(0, math.ceil(beyond / 2)), max(grid.shape[1:]) // 2)


def reaches_a_side(volume: Volume) -> bool:
    """Whether there is something in the outermost voxels along y or x, so that a padded array is another scene."""
    filled = _spans(volume)
    return filled is not None and min(_gaps(volume.grid, filled)) == 0


def _spans(volume: Volume) -> list[tuple[int, int]] | None:
    """The first and last voxel along z, y and x of what is in a volume; None of an empty one."""
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
    """Empty voxels between what is in a volume and its nearer side, along y and x."""
    return [min(filled[a][0], grid.shape[a] - 1 - filled[a][1]) for a in (1, 2)]
