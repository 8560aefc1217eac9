"""Whether a field is cut into tiles, and how large they are: as large as the memory allows."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from recon.config.schema import Config, ConfigError
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem
from recon.misfit.base import Misfit
from recon.recording.cut_field import margin_beyond
from recon.run.room import check_room_for_descent, held_beside_images
from recon.tiling.layout import Layout
from recon.tiling.part import without_margin
from torchdic import ShortOfMemoryError, foreseen
from torchdic.memory.free import check_room, free_bytes

# Margins by which neighbours overlap: blended in the middle of it, a tile counts from three quarters of one on.
OVERLAP = 2

# Voxels of a margin at least. A specimen's edge is wider than a voxel.
LEAST_MARGIN = 4

# Tiles of fewer voxels along a side, beyond the overlaps on both sides, gain little field for their size.
LEAST_CORE = 8

# Share of the free memory that tiles may take where no fidelity says how much.
SHARE = 0.5


@dataclass(frozen=True)
class Cut:
    """How a field is cut. layout: of its tiles. memory: bytes that a tile's images may take."""

    layout: Layout
    memory: int

    def problem(self, whole: Problem) -> Problem:
        """The problem of the field as its tiles are made of it. whole: as it would be fitted without them."""
        return _with_memory(without_margin(whole), self.memory)


def cut_of(
    config: Config,
    problem: Problem,
    misfit: Callable[[Tensor], Misfit],
    budget: int | None,
    remembered: tuple[int, int] | None = None,
) -> Cut | None:
    """How a field is cut into tiles; None where it is fitted whole.

    config: spelled out. problem: of the whole field. misfit: makes the problem's from data. budget: bytes that a tile's
    descent may take where the configuration gives them; None is half of what is free. remembered: side and memory of
    tiles that are gone on with; None begins anew.
    Raises ConfigError for tiles that are too small; ShortOfMemoryError where the field has no room and isn't to be cut,
    or its tiles have none.
    """
    tiles, margin, memory = config.reconstruction.tiles, margin_of_tiles(config), _memory(problem)
    if remembered is not None:
        return Cut(_layout(problem, remembered[0], margin), remembered[1])
    longest = max(problem.setup.field.shape[1:])
    small = isinstance(tiles, int) and tiles < longest
    try:
        check_room_for_descent(problem, misfit)
    except ShortOfMemoryError:
        if not small and (tiles != "auto" or least_side(problem, margin) >= longest):
            raise
        side, memory = _with_room(problem, misfit, margin, budget, tiles if isinstance(tiles, int) else None)
        if side >= longest:  # such tiles are no part of the field
            raise
        return Cut(_layout(problem, side, margin), memory)
    return Cut(_layout(problem, tiles, margin), memory) if small and isinstance(tiles, int) else None


def margin_of_tiles(config: Config) -> int:
    """Voxels of a tile beyond its images on each side: the configuration's, or as far as light goes to the side.

    That is half the depth of the volume at most: light steeper than 45° is little, and would leave no room for images.
    """
    given = config.reconstruction.margin
    if isinstance(given, int) and given > 0:
        return given
    grid = config.volume.grid
    steepest = math.ceil(grid.extent[0] / 2 / min(grid.spacing[1:]))
    return max(min(margin_beyond(grid, config.microscope, config.volume.background), steepest), LEAST_MARGIN)


def _layout(problem: Problem, side: int, margin: int) -> Layout:
    """Tiles of a side. Raises ConfigError where they are too small for their overlaps."""
    least = least_side(problem, margin)
    if side < least:
        raise ConfigError(
            f"reconstruction.tiles: {side} voxels are too few: light goes {margin} voxels to the side (margin), and "
            f"neighbours overlap by {OVERLAP} margins; tiles of {least} voxels or more"
        )
    return Layout.of(problem.setup.field, problem.setup.pixels, side, margin, OVERLAP * margin)


def least_side(problem: Problem, margin: int) -> int:
    """Voxels along a side of the smallest tiles: pixels of several voxels may ask for more of them."""
    setup = problem.setup
    return max(2 * OVERLAP * margin + LEAST_CORE, Layout.least_side(setup.field, setup.pixels, OVERLAP * margin))


def _with_room(
    problem: Problem, misfit: Callable[[Tensor], Misfit], margin: int, budget: int | None, side: int | None
) -> tuple[int, int]:
    """The side of the largest tiles in a budget of bytes, or a given one, and the bytes that their images may take.

    Where the largest are no smaller than the field, their room isn't looked at. Raises ShortOfMemoryError where tiles
    of the given side, or the smallest, have no room.
    """
    setup, free = problem.setup, free_bytes(problem.misfit.data.device)
    assert free is not None  # else there was no lack of it
    if budget is None or budget > free:  # so much can't be had
        budget = int(SHARE * free)
    images = min(_memory(problem), budget // 2)
    problem = _with_memory(problem, images)
    fidelity, columns = problem.fidelity.coarse, math.prod(setup.volume.grid.shape[1:])
    beside = held_beside_images(problem, misfit, fidelity) / columns
    one = foreseen(setup.volume, setup.microscope, setup.acquisition, fidelity, gradient=True).least / columns
    if side is None:
        largest = int(math.sqrt(min((budget - images) / beside, images / one))) - 2 * margin
        side = max(largest, least_side(problem, margin))
        if side >= max(setup.field.shape[1:]):
            return side, images
    wanted = math.ceil((beside + one) * (side + 2 * margin) ** 2)
    check_room(wanted, free, f"Tiles of {side} voxels and {margin} more on each side")
    return side, images


def _memory(problem: Problem) -> int:
    """Bytes that a problem's images may take."""
    return problem.fidelity.coarse.memory


def _with_memory(problem: Problem, memory: int) -> Problem:
    """The problem whose images may take so many bytes."""
    known = problem.fidelity
    if not isinstance(known, GivenFidelity):
        return problem
    return replace(problem, fidelity=replace(known, fidelity=replace(known.fidelity, memory=memory)))
