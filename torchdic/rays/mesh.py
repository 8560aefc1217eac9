"""The rays of a source as a mesh of triangles, and the pixels on which each triangle lands."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from torchdic.errors import SidewaysError
from torchdic.grid import Grid
from torchdic.scalar import scalar

# Rows and columns of rays traced on each side outside the array, because rays may be bent into it.
SURROUND = 2

# Array widths by which the outermost rays may be displaced. Farther out, the index that they cross is unknown.
FARTHEST = 2


class Mesh:
    """The rays of a source as a mesh of triangles, two to a cell, wide enough to cover the array.

    grid: of the array.
    displacement: of the rays on the plane where they land, (source, y, x, 2) in µm.
    Raises SidewaysError if the outermost rays are displaced by more than FARTHEST array widths.
    """

    def __init__(self, grid: Grid, displacement: Tensor) -> None:
        device = displacement.device
        self.shape = grid.shape[1:]
        self.spacing = torch.stack([scalar(d, displacement) for d in grid.spacing[1:]])
        my, mx = displacement.shape[1:3]
        # beyond the traced margin rays are displaced as at its rim, because the index is constant there
        rim = torch.ones(my, mx, dtype=torch.bool, device=device)
        rim[1:-1, 1:-1] = False
        farthest = float((displacement.detach()[:, rim] / self.spacing).abs().max())
        if farthest > FARTHEST * max(my, mx):
            raise SidewaysError(
                f"rays leave sideways: at the array's sides they are displaced by up to {farthest:.0f} voxels, more "
                f"than {FARTHEST} times the {max(my, mx)} that are traced; a wider or thinner volume, or a "
                "reference_plane nearer to the specimen, may help"
            )
        extra = max(0, math.ceil(farthest) + 1 - SURROUND)
        self._rows = torch.arange(-extra, my + extra, device=device)
        self._columns = torch.arange(-extra, mx + extra, device=device)
        self.home = torch.cartesian_prod(self._rows, self._columns) - SURROUND
        vertex = torch.arange(len(self.home), device=device).reshape(my + 2 * extra, mx + 2 * extra)
        a, b, c, d = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
        self.triangles = torch.stack((torch.stack((a, b, c), -1), torch.stack((d, c, b), -1)), 2).reshape(-1, 3)
        self._extra, self._size = extra, (my, mx)

    def flat(self, values: Tensor) -> Tensor:
        """Values at all vertices, (source, vertex, …), from those of the traced rays, (source, y, x, …)."""
        if self._extra:
            values = values[:, self._rows.clamp(0, self._size[0] - 1)][:, :, self._columns.clamp(0, self._size[1] - 1)]
        return values.flatten(1, 2)

    def of_triangles(self, values: Tensor) -> Tensor:
        """Values at all triangles, (source, triangle), from those of the traced cells.

        values: (source, row, column, 2), for both triangles of each traced cell and of one ring of cells around them.
        Cells beyond the ring take the values of the ring.
        """
        rows, columns = (
            i[:-1].clamp(-1, n - 1) + 1 for i, n in zip((self._rows, self._columns), self._size, strict=True)
        )
        return values[:, rows][:, :, columns].flatten(1)

    def edges(self, displacement: Tensor) -> Tensor:
        """Two edges of each triangle in µm, (source, triangle, 2, 2). displacement: of the rays in µm."""
        corner = (self.home * self.spacing + self.flat(displacement))[:, self.triangles]
        return corner[:, :, 1:] - corner[:, :, :1]

    def covered(self, displacement: Tensor) -> "Pairs":
        """All pairs of a triangle and a pixel inside it. displacement: of the rays in µm.

        A pixel on an edge belongs to one of the two triangles. The side on which it lies is computed from the edge's
        vertices in the mesh's order, so both triangles find the same number.
        """
        # source by source, to save memory: up to four pairs are tried for each that is kept
        found = [self._covered_by_one(part) for part in self.home + self.flat(displacement) / self.spacing]
        triangles, pixels = zip(*found, strict=True)
        source = torch.cat([torch.full_like(triangle, i) for i, triangle in enumerate(triangles)])
        return Pairs(source, torch.cat(triangles), torch.cat(pixels))

    def _covered_by_one(self, moved: Float[Tensor, "vertex 2"]) -> tuple[Tensor, Tensor]:
        """`covered` of one source: triangle (n,), pixel (n, 2). moved: its vertices in fractional pixels."""
        corner = moved[self.triangles]
        low = corner.amin(1).ceil().clamp_min(0)
        last_row, last_column = corner.amax(1).floor().unbind(1)
        ny, nx = self.shape
        high = torch.stack((last_row.clamp_max(ny - 1), last_column.clamp_max(nx - 1)), 1)
        extent = (high - low + 1).clamp_min(0).long()
        count = extent.prod(-1)
        triangle = torch.repeat_interleave(torch.arange(len(count), device=moved.device), count)
        within = torch.arange(len(triangle), device=moved.device) - (count.cumsum(0) - count)[triangle]
        width = extent[triangle, 1]
        offset = torch.stack((within // width, within % width), -1)
        pixel = low[triangle].long() + offset

        vertex = self.triangles[triangle]
        inside = torch.ones(len(triangle), dtype=torch.bool, device=moved.device)
        orientation = cross(*(corner[:, 1:] - corner[:, :1]).unbind(1))[triangle] > 0
        for first, second in ((0, 1), (1, 2), (2, 0)):
            one, other = vertex[:, first], vertex[:, second]
            start, end = moved[torch.minimum(one, other)], moved[torch.maximum(one, other)]
            # taken from the nearer end: from the other one, rounding would hide a ray that lands almost on the pixel
            direct = (pixel - start).square().sum(-1) <= (pixel - end).square().sum(-1)
            arm = pixel - torch.where(direct[:, None], start, end)
            left = torch.where(direct, 1, -1) * cross(torch.where(direct[:, None], end - start, start - end), arm) >= 0
            inside &= (left == (one < other)) == orientation
        held = inside.nonzero()[:, 0]
        return triangle[held], pixel[held]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of a triangle and a pixel (y, x) inside it, in the mesh of a source."""

    source: Int[Tensor, " pair"]
    triangle: Int[Tensor, " pair"]
    pixel: Int[Tensor, "pair 2"]

    def summed(self, values: Shaped[Tensor, " pair"], sources: int, grid: Grid) -> Shaped[Tensor, "source y x"]:
        """The sum of the pairs' values at each pixel of each source, (source, y, x)."""
        ny, nx = grid.shape[1:]
        target = (self.source * ny + self.pixel[:, 0]) * nx + self.pixel[:, 1]
        field = values.new_zeros(sources * ny * nx).index_add(0, target, values)
        return field.reshape(sources, ny, nx)


def crossed_caustics(leaving: Tensor, landed: Tensor) -> Tensor:
    """The number of caustics between two planes with only the background between them, (source, triangle).

    leaving, landed: two edges of each triangle on the first plane and on the second, (source, triangle, 2, 2) in µm.
    """
    start, stop = cross(*leaving.unbind(2)), cross(*landed.unbind(2))
    # the area on the way is a parabola in the fraction s of the way: start + slope·s + bend·s²
    change = landed - leaving
    bend = cross(*change.unbind(2))
    slope = stop - start - bend
    turning = torch.where(bend == 0, torch.inf, -slope / (2 * bend))
    lowest = start + slope * turning / 2
    # rays are normals of a wavefront, so the parabola's zeros are real; at a symmetric focus they coincide
    twice = (start * stop > 0) & (turning > 0) & (turning < 1) & (lowest * start < 1e-4 * start.square())
    return (start * stop < 0).to(start) + 2 * twice.to(start)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross product of vectors (y, x), positive from +x towards +y."""
    return a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1]
