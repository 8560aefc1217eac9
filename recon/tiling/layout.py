"""Where the tiles of a field lie, and how much each counts at a place.

All tiles have the same size. Neighbours overlap; towards a cut a tile's weight falls to 0 before its border, where its
images don't tell enough of the volume, and the neighbour's rises. The weights of all tiles are 1 together everywhere.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic import Grid

# Share of an overlap, in its middle, over which one tile's weight rises and the other's falls.
RAMP = 0.25

# A tile's voxels and its pixels may have centres that differ by this part of a voxel.
ALIGNED = 0.05
# How many voxels and pixels from the wanted ones better aligned ones are looked for.
SEARCHED = 32


@dataclass(frozen=True)
class Span:
    """A tile along one axis. pixels: in the images. voxels: of the field behind them."""

    pixels: slice
    voxels: slice


@dataclass(frozen=True)
class Axis:
    """One axis of a field, cut into tiles.

    voxels: of the field. pixels: of its images, which have the same centre. ratio: voxels in a pixel. size: pixels of
    a tile. count: voxels of a tile. overlap: least of two neighbours, in pixels.
    Raises ValueError where an overlap isn't less than half of a tile that is a part of the field.
    """

    voxels: int
    pixels: int
    ratio: float
    size: int
    count: int
    overlap: int

    def __post_init__(self) -> None:
        if self.size < self.pixels and not 0 <= 2 * self.overlap < self.size:
            raise ValueError(f"tiles of {self.size} pixels can't overlap by {self.overlap}: it must be less than half")

    @classmethod
    def cut(cls, voxels: int, pixels: int, ratio: float, side: int, overlap: int) -> "Axis":
        """An axis cut into tiles of at most `side` voxels, or a few less, such that pixels and voxels lie alike.

        Raises ValueError where the side is below `least`.
        """
        least = cls.least(ratio, overlap)
        if side >= voxels:
            return cls(voxels, pixels, ratio, pixels, voxels, overlap)
        if side < least:
            raise ValueError(f"tiles of {side} voxels can't overlap by {overlap} pixels: of {least} they can")

        def made(count: int) -> "Axis":
            return cls(voxels, pixels, ratio, int(count / ratio + 1e-6), count, overlap)

        counts = range(side, max(side - SEARCHED, least) - 1, -1)
        return min((made(count) for count in counts), key=lambda axis: max(axis.away(0), ALIGNED))

    @staticmethod
    def least(ratio: float, overlap: int) -> int:
        """Voxels of the smallest tile that has more pixels than two overlaps. ratio, overlap: as above."""
        return math.ceil((2 * overlap + 1) * ratio)

    @cached_property
    def spans(self) -> tuple[Span, ...]:
        """The tiles, evenly spaced as nearly as pixels and voxels lie alike."""
        firsts, last, most = [0], self.pixels - self.size, self.size - self.overlap
        while (first := firsts[-1]) < last:
            number = math.ceil((last - first) / most)
            firsts.append(last if number == 1 else self._aligned(first, first + (last - first) / number))
        return tuple(self._span(first) for first in firsts)

    def centre(self, first: float) -> float:
        """The first voxel, as a fraction, of a tile with this first pixel."""
        return (self.voxels - self.count) / 2 + (first - (self.pixels - self.size) / 2) * self.ratio

    def away(self, first: int) -> float:
        """How far a tile's voxels lie from its pixels, in voxels."""
        return abs(self.centre(first) - round(self.centre(first)))

    def _aligned(self, before: int, wanted: float) -> int:
        """The first pixel nearest to a wanted one, of those that lie alike. before: that of the tile before."""
        near = range(max(before + 1, round(wanted) - SEARCHED), before + self.size - self.overlap + 1)
        return min(near, key=lambda pixel: (max(self.away(pixel), ALIGNED), abs(pixel - wanted)))

    def _span(self, first: int) -> Span:
        voxel = round(self.centre(first))
        return Span(slice(first, first + self.size), slice(voxel, voxel + self.count))

    def weights_of_pixels(self) -> Float[Tensor, "tile pixel"]:
        """How much each tile counts at each pixel, float64."""
        return self._weights(torch.arange(self.pixels, dtype=torch.float64))

    def counting(self, tile: int) -> slice:
        """The pixels of a tile, from its first, at which it counts at all. tile: its number along the axis."""
        span = self.spans[tile].pixels
        places = torch.nonzero(self.weights_of_pixels()[tile, span] > 0).flatten()
        return slice(int(places[0]), int(places[-1]) + 1)

    def weights_of_voxels(self) -> Float[Tensor, "tile voxel"]:
        """How much each tile counts at each voxel of the field, float64; outer tiles count as far as its ends."""
        voxel = torch.arange(self.voxels, dtype=torch.float64)
        return self._weights((voxel - (self.voxels - 1) / 2) / self.ratio + (self.pixels - 1) / 2)

    def _weights(self, places: Float[Tensor, " place"]) -> Float[Tensor, "tile place"]:
        """The tiles' weights at places in pixels."""
        places = places + 0.5
        rows = torch.ones(len(self.spans), len(places), dtype=torch.float64)
        for tile, (before, after) in enumerate(pairwise(self.spans)):
            overlap = before.pixels.stop - after.pixels.start
            middle, half = after.pixels.start + overlap / 2, max(RAMP * overlap, 1.0) / 2
            rising = ((places - middle + half) / (2 * half)).clamp(0, 1)
            rows[tile + 1] *= rising
            rows[tile] *= 1 - rising
        return rows / rows.sum(0)


@dataclass(frozen=True)
class Tile:
    """One tile of a field: its number, counted from 0, its place (row, column) among the tiles, and what it covers."""

    number: int
    place: tuple[int, int]
    rows: Span
    columns: Span

    def __str__(self) -> str:
        """Its row and column among the tiles, counted from 1."""
        return "-".join(str(number + 1) for number in self.place)


@dataclass(frozen=True)
class Layout:
    """The tiles of a field.

    along_y, along_x: the axes' cuts. side: voxels along a side at most. margin: voxels of each tile beyond its images.
    """

    along_y: Axis
    along_x: Axis
    side: int
    margin: int

    @classmethod
    def of(cls, field: Grid, pixels: Grid, side: int, margin: int, overlap: int) -> "Layout":
        """Tiles of at most `side` voxels along y and x, which overlap by `overlap` voxels at least.

        field, pixels: the voxels behind the images, and the images' pixels. margin: as above.
        Raises ValueError where the side is below `least_side`.
        """
        along_y, along_x = (
            Axis.cut(field.shape[axis], pixels.shape[axis], ratio, side, math.ceil(overlap / ratio))
            for axis, ratio in zip((1, 2), _ratios(field, pixels), strict=True)
        )
        return cls(along_y, along_x, side, margin)

    @staticmethod
    def least_side(field: Grid, pixels: Grid, overlap: int) -> int:
        """Voxels along a side of the smallest tiles that can overlap so. field, pixels, overlap: as of `of`."""
        return max(Axis.least(ratio, math.ceil(overlap / ratio)) for ratio in _ratios(field, pixels))

    def __len__(self) -> int:
        return len(self.along_y.spans) * len(self.along_x.spans)

    def __iter__(self) -> Iterator[Tile]:
        for row, rows in enumerate(self.along_y.spans):
            for column, columns in enumerate(self.along_x.spans):
                yield Tile(row * len(self.along_x.spans) + column, (row, column), rows, columns)


def _ratios(field: Grid, pixels: Grid) -> list[float]:
    """Voxels in a pixel along y and x."""
    return [p / d for p, d in zip(pixels.spacing[1:], field.spacing[1:], strict=True)]
