"""From bent rays to a complex field on the grid, at a reference plane inside the specimen.

The rays that leave the volume are extended straight back, in the background, to a plane where the wavefront is smooth
and displacements are small. There the mesh of rays is rasterised, triangle by triangle. Where the mesh folds, the field
is the sum over its branches.
"""

import math

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.plane_waves import axial_momentum
from torchdic.rays.caustics import Tubes, tubes_that_may_fold
from torchdic.rays.mesh import SURROUND, Mesh, Pairs, cross, crossed_caustics
from torchdic.rays.trace import Deviation, deviation, launch
from torchdic.specimen.volume import SampledVolume

# Smallest tube area relative to the unperturbed one, which keeps the brightness of a caustic finite.
LEAST_TUBE = 1e-3


def ray_field(
    volume: SampledVolume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    plane: float,
    fidelity: Fidelity,
    *,
    polarised: bool = False,
    slabs: bool | None = None,
) -> Complex[Tensor, "source component y x"]:
    """Each source's envelope at depth `plane` (µm), from rays traced through the volume.

    Inside a triangle of the mesh the OPD is Σ w_i [W_i + ½ δp_i·(X − x_i)] with barycentric weights w_i, which is of
    third order in the mesh. The amplitude is √(p_z0/(p_z·|det ∂x_r/∂x0|)), which conserves energy.

    volume: sampled.
    wavelength: in vacuum, µm.
    momentum: n·sinθ (y, x) of each source's direction, (source, 2).
    plane: depth of the reference plane in µm.
    fidelity: as for `torchdic.rays.trace.trace`, and its amplitude.
    polarised: whether rays carry their polarisation. If so, the field has two components, along +x and +y of each ray's
        local frame: for light that comes in polarised along +x they are (cos τ, sin τ) times the envelope (see
        `torchdic.rays.trace`). Otherwise the field has one component.
    slabs: see `deviation`.
    Raises TurnedRaysError if rays can't go on toward +z in the volume or behind it, and SidewaysError if rays come from
    too far beyond the volume's sides.
    """
    grid, n0 = volume.grid, volume.background
    tubes = tubes_that_may_fold(volume, momentum)
    rays = launch(grid, momentum, n0, plane, SURROUND)
    leaving = deviation(volume, rays, fidelity, turn=polarised, watch=tubes, slabs=slabs)
    landed = extend(leaving, momentum[:, None, None, :], n0, plane - grid.extent[0] / 2)
    trapped = ~torch.isfinite(landed.opd.detach())
    if bool(trapped.any()):
        raise TurnedRaysError.of(trapped, "in the medium behind the volume")
    tube = _tube(landed, momentum, volume) if fidelity.amplitude else None
    mesh = Mesh(grid, landed.position)
    with torch.no_grad():
        pairs = mesh.covered(landed.position)
        quarters = _caustics_passed(mesh, leaving, landed, tubes, behind=plane > grid.extent[0] / 2)
        caustic = (math.pi / 2) * quarters[pairs.source, pairs.triangle]

    inside = _Inside(mesh, pairs, landed.position)
    k0 = 2 * math.pi / wavelength
    opd = (inside.weight * (inside.corners(landed.opd) + 0.5 * inside.slopes(landed.momentum))).sum(-1)
    amplitude = torch.ones_like(opd) if tube is None else inside.amplitude(tube, grid)
    if landed.absorbed is not None:
        amplitude = amplitude * torch.exp(-k0 * inside.mean(landed.absorbed))
    branches = torch.polar(amplitude, k0 * opd + caustic)
    if landed.turn is None:
        return pairs.summed(branches, len(momentum), grid)[:, None]
    turn = inside.mean(landed.turn)
    parts = [pairs.summed(branches * part, len(momentum), grid) for part in (turn.cos(), turn.sin())]
    return torch.stack(parts, 1)


def extend(rays: Deviation, p0: Tensor, n0: Tensor, distance: float) -> Deviation:
    """Rays extended in the homogeneous background by `distance` (µm) along z. A negative distance takes them back.

    p0: momentum of the unperturbed rays (…, 2).
    n0: index of the background.
    """
    dp, pz0 = rays.momentum, axial_momentum(n0, p0)
    p = p0 + dp
    pz = axial_momentum(n0, p)
    q = -(dp * (p + p0)).sum(-1) / (pz + pz0)
    slope = (dp - p0 * (q / pz0)[..., None]) / pz[..., None]
    lengthening = (dp.square().sum(-1) + q * q) / (2 * pz)
    return Deviation(rays.position + distance * slope, dp, rays.opd + distance * lengthening, rays.absorbed, rays.turn)


def tube_area(displacement: Float[Tensor, "source y x 2"], grid: Grid) -> Float[Tensor, "source y x"]:
    """Det ∂x_r/∂x0, second order in the mesh: the signed area of a ray tube over its unperturbed area."""
    (yy, yx), (xy, xx) = (
        torch.gradient(displacement[..., axis], spacing=grid.spacing[1:], dim=[1, 2]) for axis in (0, 1)
    )
    return (1 + yy) * (1 + xx) - yx * xy


def _tube(landed: Deviation, momentum: Tensor, volume: SampledVolume) -> Tensor:
    """The cross-section of each ray's tube over its unperturbed one, (source, y, x). The intensity is its inverse."""
    n0, p0 = volume.background, momentum[:, None, None, :]
    slant = axial_momentum(n0, p0 + landed.momentum) / axial_momentum(n0, p0)
    return tube_area(landed.position, volume.grid) * slant


def _caustics_passed(mesh: Mesh, leaving: Deviation, landed: Deviation, tubes: Tubes | None, *, behind: bool) -> Tensor:
    """The phase that caustics add to each triangle, in quarters of a wave, (source, triangle).

    Each caustic that light passes forward takes a quarter. Each caustic passed on the way back to the plane adds one.
    behind: whether the plane lies behind the volume, so that rays go forward to it.
    """
    crossed = crossed_caustics(mesh.edges(leaving.position), mesh.edges(landed.position))
    quarters = -crossed if behind else crossed
    return quarters if tubes is None else quarters - mesh.of_triangles(tubes.passed())


class _Inside:
    """Interpolation between a triangle's corners, at each pixel that lies inside it.

    weight: the corners' barycentric weights, (pair, 3).
    area: of the triangle in µm², (pair,).
    """

    def __init__(self, mesh: Mesh, pairs: Pairs, displacement: Tensor) -> None:
        self._mesh, self._source, self._vertices = mesh, pairs.source[:, None], mesh.triangles[pairs.triangle]
        home = (pairs.pixel[:, None] - mesh.home[self._vertices]) * mesh.spacing
        self._offset = home - self.corners(displacement)
        opposite = cross(self._offset.roll(-1, 1), self._offset.roll(-2, 1))
        self.area = opposite.sum(-1)
        self.weight = opposite / self.area[:, None]

    def corners(self, values: Tensor) -> Tensor:
        """The values of the rays at the corners, (pair, 3, …). values: (source, y, x, …)."""
        return self._mesh.flat(values)[self._source, self._vertices]

    def slopes(self, momentum: Tensor) -> Tensor:
        """δp·(X − x) for each corner at x, (pair, 3)."""
        return (self.corners(momentum) * self._offset).sum(-1)

    def mean(self, values: Tensor) -> Tensor:
        """The rays' values, interpolated linearly between the corners, (pair,)."""
        return (self.weight * self.corners(values)).sum(-1)

    def amplitude(self, tube: Tensor, grid: Grid) -> Tensor:
        """One over the root of a tube's cross-section, (pair,)."""
        flat = self.area / (grid.spacing[1] * grid.spacing[2])
        smooth = self.mean(tube)
        # beside a fold the interpolated area may vanish or change sign, although the triangle's own area does not
        smooth = torch.where(smooth / flat > 0.25, smooth, flat)
        return smooth.abs().clamp_min(LEAST_TUBE).rsqrt()
