"""Bent rays -> a complex field on the grid, at a reference plane inside the specimen.

Exit rays are extended straight back, in the background, to a plane where the wavefront is smooth and displacements
are small. There the mesh of rays is rasterised, triangle by triangle; where it folds, the field is the sum over its
branches.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.caustics import tubes_that_may_fold
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.rays import Deviation, TurnedRaysError, axial_momentum, deviation, kept_by_rays, launch, steps_of
from torchdic.recompute import Demand, indices
from torchdic.scalar import scalar
from torchdic.volume import Volume

# Rows and columns of rays traced around the array, from where rays may be bent into it.
MARGIN = 2
# Least tube area relative to the unperturbed one: a caustic is bright but finite.
LEAST_TUBE = 1e-3
# Array widths by which the outermost rays may be displaced: from farther away none knows the index that it crossed.
FARTHEST = 2


class SidewaysError(ValueError):
    """Rays that leave the volume sideways: one line with how far they are displaced, and what they may be."""


def ray_field(
    volume: Volume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    plane: float,
    fidelity: Fidelity,
    fields: Sequence[Float[Tensor, "z y x"]] | None = None,
    *,
    turned: bool = False,
) -> Complex[Tensor, "source *component y x"]:
    """Each source's envelope at depth `plane` (µm), from rays traced through the volume.

    Inside a triangle of the mesh the OPD is Σ w_i [W_i + ½ δp_i·(X − x_i)] with barycentric weights w_i, third order in
    the mesh, and the amplitude is √(p_z0/(p_z·|det ∂x_r/∂x0|)), which conserves energy.

    fields: `Volume.sampled`, where it serves several calls. turned: whether rays carry their polarisation. The field is
    then (source, 2, y, x), its components along +x and +y of each ray's local frame for light that comes in along +x:
    (cos τ, sin τ) times the envelope (see `torchdic.rays`).
    Raises TurnedRaysError for rays that can't go on toward +z in the volume or behind it, and SidewaysError for rays
    that come from too far beyond the volume's sides.
    """
    grid, n0 = volume.grid, volume.background
    p0 = momentum[:, None, None, :]
    fields = fields or volume.sampled(fidelity.interpolation)
    tubes = tubes_that_may_fold(volume, momentum, fidelity, fields)
    rays = launch(grid, momentum, n0, plane, MARGIN)
    leaving = deviation(volume, rays, fidelity, fields, turn=turned, watch=tubes)
    landed = extend(leaving, p0, n0, plane - grid.extent[0] / 2)
    trapped = ~torch.isfinite(landed.opd.detach())
    if bool(trapped.any()):
        raise TurnedRaysError.of(trapped, "in the medium behind the volume")
    tube = None
    if fidelity.amplitude:
        slant = axial_momentum(n0, p0 + landed.momentum) / axial_momentum(n0, p0)
        tube = tube_area(landed.position, grid) * slant
    mesh = _Mesh(grid, landed.position)

    with torch.no_grad():
        source, triangle, pixel = mesh.covered(landed.position)
        crossed = _crossed(mesh.edges(leaving.position), mesh.edges(landed.position))
        # a caustic costs a quarter of a wave where it is passed forward, and the way back to the plane gives it back
        quarters = -crossed if plane > grid.extent[0] / 2 else crossed
        if tubes is not None:
            quarters = quarters - mesh.of_triangles(tubes.passed())
        caustic = (math.pi / 2) * quarters[source, triangle]

    def corners(values: Tensor) -> Tensor:
        return mesh.flat(values)[source[:, None], mesh.triangles[triangle]]

    offset = (pixel[:, None] - mesh.home[mesh.triangles[triangle]]) * mesh.spacing - corners(landed.position)
    opposite = _cross(offset.roll(-1, 1), offset.roll(-2, 1))
    area = opposite.sum(-1)
    weight = opposite / area[:, None]
    opd = (weight * (corners(landed.opd) + 0.5 * (corners(landed.momentum) * offset).sum(-1))).sum(-1)

    k0 = 2 * math.pi / wavelength
    amplitude = torch.ones_like(opd)
    if tube is not None:
        flat = area / (grid.spacing[1] * grid.spacing[2])
        smooth = (weight * corners(tube)).sum(-1)
        # beside a fold the interpolated area may vanish or change sign inside a triangle whose own does not
        smooth = torch.where(smooth / flat > 0.25, smooth, flat)
        amplitude = smooth.abs().clamp_min(LEAST_TUBE).rsqrt()
    if landed.absorbed is not None:
        amplitude = amplitude * torch.exp(-k0 * (weight * corners(landed.absorbed)).sum(-1))
    branches = torch.polar(amplitude, k0 * opd + caustic)

    ny, nx = grid.shape[1:]
    target = (source * ny + pixel[:, 0]) * nx + pixel[:, 1]

    def summed(branches: Tensor) -> Tensor:
        field = branches.new_zeros(len(momentum) * ny * nx).index_add(0, target, branches)
        return field.reshape(len(momentum), ny, nx)

    if landed.turn is None:
        return summed(branches)
    turn = (weight * corners(landed.turn)).sum(-1)
    return torch.stack((summed(branches * turn.cos()), summed(branches * turn.sin())), 1)


def demand_of_rays(volume: Volume, fidelity: Fidelity, *, turned: bool = False) -> Demand:
    """What `ray_field` holds; measured by `python benchmarks/memory.py`."""
    absorbs, index = volume.absorption is not None, indices(volume.delta.dtype)
    _, ny, nx = volume.grid.shape
    # of the padded array
    area = (ny + 2 * fidelity.padding) * (nx + 2 * fidelity.padding)
    sides = 2 * (fidelity.padding + MARGIN)
    rays = (ny + sides) * (nx + sides) / area
    steps = steps_of(volume.grid, fidelity)
    step = kept_by_rays(volume.grid, fidelity, absorbs=absorbs) / steps
    cubic = fidelity.interpolation == "cubic"
    back = 190 + 20 * index if cubic else 60
    forth = 120 + 25 * index if cubic else 80
    # where rays go straight on, each corner of the two triangles beside a pixel falls on a pixel: 8 pairs instead of 2
    empty = 1 - float((volume.delta.detach() != 0).any(0).sum()) / area
    once = 10 + 12 * index + (10 + 15 * index) * (2 + 6 * empty)
    kept = 77 + 12.5 * index + 11 * absorbs + 18 * turned - 20 * (not fidelity.amplitude)
    return Demand(
        rays * max(forth, 81 + 14 * absorbs + 13 * turned),
        rays * kept,
        rays * max(18, forth - kept),
        steps,
        rays * step,
        rays * back,
        rays * 2 * (5 + absorbs + turned),
        once=rays * once,
    )


def reference_plane(volume: Volume, fidelity: Fidelity) -> float:
    """Depth in µm to which the field behind a volume is referred: a wave's is the last face."""
    if fidelity.propagation == "wave":
        return volume.grid.extent[0] / 2
    return volume.mean_plane() if fidelity.reference_plane is None else fidelity.reference_plane


def extend(rays: Deviation, p0: Tensor, n0: Tensor, distance: float) -> Deviation:
    """Rays carried on in the homogeneous background by `distance` (µm) along z; a negative one takes them back."""
    dp, pz0 = rays.momentum, axial_momentum(n0, p0)
    p = p0 + dp
    pz = axial_momentum(n0, p)
    q = -(dp * (p + p0)).sum(-1) / (pz + pz0)
    slope = (dp - p0 * (q / pz0)[..., None]) / pz[..., None]
    lengthening = (dp.square().sum(-1) + q * q) / (2 * pz)
    return Deviation(rays.position + distance * slope, dp, rays.opd + distance * lengthening, rays.absorbed, rays.turn)


def tube_area(displacement: Float[Tensor, "source y x 2"], grid: Grid) -> Float[Tensor, "source y x"]:
    """Det ∂x_r/∂x0, second order in the mesh: a ray tube's signed area over its unperturbed one."""
    (yy, yx), (xy, xx) = (
        torch.gradient(displacement[..., axis], spacing=grid.spacing[1:], dim=[1, 2]) for axis in (0, 1)
    )
    return (1 + yy) * (1 + xx) - yx * xy


class _Mesh:
    """The rays of a source as a mesh of triangles, two to a cell, wide enough to cover the array."""

    def __init__(self, grid: Grid, displacement: Tensor) -> None:
        device = displacement.device
        self.shape = grid.shape[1:]
        self.spacing = torch.stack([scalar(d, displacement) for d in grid.spacing[1:]])
        my, mx = displacement.shape[1:3]
        # beyond the traced margin rays are displaced as at its rim, where the index is constant across it
        rim = torch.ones(my, mx, dtype=torch.bool, device=device)
        rim[1:-1, 1:-1] = False
        farthest = float((displacement.detach()[:, rim] / self.spacing).abs().max())
        if farthest > FARTHEST * max(my, mx):
            raise SidewaysError(
                f"rays leave sideways: at the array's sides they are displaced by up to {farthest:.0f} voxels, more "
                f"than {FARTHEST} times the {max(my, mx)} that are traced; a wider or thinner volume, or a "
                "reference_plane nearer to the specimen, may help"
            )
        extra = max(0, math.ceil(farthest) + 1 - MARGIN)
        self._rows = torch.arange(-extra, my + extra, device=device)
        self._columns = torch.arange(-extra, mx + extra, device=device)
        self.home = torch.cartesian_prod(self._rows, self._columns) - MARGIN
        vertex = torch.arange(len(self.home), device=device).reshape(my + 2 * extra, mx + 2 * extra)
        a, b, c, d = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
        self.triangles = torch.stack((torch.stack((a, b, c), -1), torch.stack((d, c, b), -1)), 2).reshape(-1, 3)
        self._extra, self._size = extra, (my, mx)

    def flat(self, values: Tensor) -> Tensor:
        """Values at the traced vertices (source, y, x, …) as (source, vertex, …), the outer ones included."""
        if self._extra:
            values = values[:, self._rows.clamp(0, self._size[0] - 1)][:, :, self._columns.clamp(0, self._size[1] - 1)]
        return values.flatten(1, 2)

    def of_triangles(self, values: Tensor) -> Tensor:
        """Values of both triangles of each traced cell, and of those in a ring around, as (source, triangle).

        values: (source, row, column, 2). All cells beyond the ring are as those in it.
        """
        rows, columns = (
            i[:-1].clamp(-1, n - 1) + 1 for i, n in zip((self._rows, self._columns), self._size, strict=True)
        )
        return values[:, rows][:, :, columns].flatten(1)

    def edges(self, displacement: Tensor) -> Tensor:
        """Two edges of each triangle, (source, triangle, 2, 2) in µm, where rays are displaced so far."""
        corner = (self.home * self.spacing + self.flat(displacement))[:, self.triangles]
        return corner[:, :, 1:] - corner[:, :, :1]

    def covered(self, displacement: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """All pairs of a triangle and a pixel inside it: source (n,), triangle (n,) and pixel (n, 2).

        A pixel on an edge belongs to one of the two triangles: an edge's side is computed from its vertices in the
        mesh's order, so both see the same number.
        """
        # source by source: there are up to four pairs for each that holds
        found = [self._covered_by_one(part) for part in self.home + self.flat(displacement) / self.spacing]
        triangles, pixels = zip(*found, strict=True)
        source = torch.cat([torch.full_like(triangle, i) for i, triangle in enumerate(triangles)])
        return source, torch.cat(triangles), torch.cat(pixels)

    def _covered_by_one(self, moved: Float[Tensor, "vertex 2"]) -> tuple[Tensor, Tensor]:
        """`covered` of one source, whose vertices have been moved to fractional pixels: triangle (n,), pixel (n, 2)."""
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
        orientation = _cross(*(corner[:, 1:] - corner[:, :1]).unbind(1))[triangle] > 0
        for first, second in ((0, 1), (1, 2), (2, 0)):
            one, other = vertex[:, first], vertex[:, second]
            start, end = moved[torch.minimum(one, other)], moved[torch.maximum(one, other)]
            # taken from the nearer end: a ray that lands almost on a pixel would drown in the rounding of the other
            direct = (pixel - start).square().sum(-1) <= (pixel - end).square().sum(-1)
            arm = pixel - torch.where(direct[:, None], start, end)
            left = torch.where(direct, 1, -1) * _cross(torch.where(direct[:, None], end - start, start - end), arm) >= 0
            inside &= (left == (one < other)) == orientation
        held = inside.nonzero()[:, 0]
        return triangle[held], pixel[held]


def _crossed(leaving: Tensor, landed: Tensor) -> Tensor:
    """How many caustics lie between two planes with nothing but the background between them, (source, triangle).

    Both meshes are given by two edges of each triangle, (source, triangle, 2, 2).
    """
    start, stop = _cross(*leaving.unbind(2)), _cross(*landed.unbind(2))
    # the area on the way is a parabola in the fraction s of the way: start + slope·s + bend·s²
    change = landed - leaving
    bend = _cross(*change.unbind(2))
    slope = stop - start - bend
    turning = torch.where(bend == 0, torch.inf, -slope / (2 * bend))
    lowest = start + slope * turning / 2
    # rays are normals of a wavefront, so the parabola's zeros are real; at a symmetric focus they are one
    twice = (start * stop > 0) & (turning > 0) & (turning < 1) & (lowest * start < 1e-4 * start.square())
    return (start * stop < 0).to(start) + 2 * twice.to(start)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    # vectors (y, x); positive from +x towards +y
    return a[..., 1] * b[..., 0] - a[..., 0] * b[..., 1]
