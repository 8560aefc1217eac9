"""The part of a stack that is enough for short fits: around its strongest structure, a few planes, coarser slices."""

import math
from dataclasses import dataclass, replace

import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from recon.fit.setup import Setup, empty_medium
from recon.misfit.base import spatial_variance
from torchdic import Acquisition, Grid, Microscope
from torchdic.scalar import number

# Pixels along a side, planes and slices of a part at most.
PIXELS, PLANES, SLICES = 56, 5, 20


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a stack.

    data: (prism, focus, y, x), relative to the empty bright field. mask: the pixels that count; None is all.
    planes: which of the stack's, from 0. corner: (y, x) of its first pixel in the stack. grid: of its volume.
    """

    data: Float[Tensor, "prism focus y x"]
    mask: Bool[Tensor, "prism focus y x"] | None
    planes: tuple[int, ...]
    corner: tuple[int, int]
    grid: Grid

    def sliced(self, slices: int) -> "Part":
        """The same with so many slices at most."""
        shape, spacing = self.grid.shape, self.grid.spacing
        number_of = min(shape[0], slices)
        return replace(self, grid=Grid((number_of, *shape[1:]), (self.grid.extent[0] / number_of, *spacing[1:])))

    def setup(
        self, background: float | Tensor, microscope: Microscope, acquisition: Acquisition, margin: int = 0
    ) -> Setup:
        """An empty volume before the part of an acquisition of the whole stack's planes.

        margin: voxels by which it is wider than the part on each side.
        """
        focus = [acquisition.focus[plane] for plane in self.planes]
        medium = empty_medium(self.grid.widened(margin, margin), number(background), self.data)
        return Setup(medium, microscope, replace(acquisition, focus=focus), margin=margin)


def part_of(
    data: Float[Tensor, "prism focus y x"],
    mask: Bool[Tensor, "prism focus y x"] | None,
    grid: Grid,
    pixels: int = PIXELS,
    planes: int = PLANES,
    slices: int = SLICES,
) -> Part:
    """The part of a stack around its strongest structure.

    data, mask: as in `Part`. grid: of the whole volume, whose (y, x) voxels are the pixels.
    pixels, planes, slices: at most. The planes are evenly spaced, the first and the last among them.
    """
    chosen = _evenly(data.shape[1], planes)
    strength = ((data - data.mean((2, 3), keepdim=True)).square() / spatial_variance(data)[:, None, None, None]).mean(1)
    if mask is not None:
        strength = strength * mask.any(1)
    size = [min(pixels, n) for n in data.shape[2:]]
    held = F.avg_pool2d(strength.mean(0)[None, None], size, stride=1)[0, 0]
    # among places that hold as much, the one in the middle of them: a specimen may be smaller than the part
    best = (held > held.max() * (1 - 1e-3)).nonzero().double().mean(0).round().long().tolist()
    if held[best[0], best[1]] < held.max() / 2:
        best = list(divmod(int(held.argmax()), held.shape[1]))
    within = (..., slice(best[0], best[0] + size[0]), slice(best[1], best[1] + size[1]))
    depth = grid.extent[0]
    nz = min(grid.shape[0], slices)
    return Part(
        data[:, chosen][within].contiguous(),
        None if mask is None else mask[:, chosen][within].contiguous(),
        tuple(chosen),
        (best[0], best[1]),
        Grid((nz, size[0], size[1]), (depth / nz, *grid.spacing[1:])),
    )


def _evenly(stack: int, most: int) -> list[int]:
    """Which planes of a stack, from 0."""
    if stack <= most:
        return list(range(stack))
    return [math.floor(i * (stack - 1) / (most - 1) + 0.5) for i in range(most)]
