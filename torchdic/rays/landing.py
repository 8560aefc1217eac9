"""Bent rays -> a complex field on the grid, at a reference plane inside the specimen.

Exit rays are extended straight back, in the background, to a plane where the wavefront is smooth and displacements
are small. There the mesh of rays is rasterised, triangle by triangle; where it folds, the field is the sum over its
branches.
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

# Least tube area relative to the unperturbed one: a caustic is bright but finite.
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

    Inside a triangle of the mesh the OPD is Σ w_i [W_i + ½ δp_i·(X − x_i)] with barycentric weights w_i, third order in
    the mesh, and the amplitude is √(p_z0/(p_z·|det ∂x_r/∂x0|)), which conserves energy.

    wavelength: in vacuum, µm. momentum: n·sinθ (y, x) of each source's direction. polarised: whether rays carry their
    polarisation. The field then has two components, along +x and +y of each ray's local frame for light that comes in
    along +x: (cos τ, sin τ) times the envelope (see `torchdic.rays.trace`). Otherwise it has one. slabs: see
    `deviation`.
    Raises TurnedRaysError for rays that can't go on toward +z in the volume or behind it, and SidewaysError for rays
    that come from too far beyond the volume's sides.
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


def _tube(landed: Deviation, momentum: Tensor, volume: SampledVolume) -> Tensor:
    """The cross-section of each ray's tube over its unperturbed one, (source, y, x); its inverse is the intensity."""
    n0, p0 = volume.background, momentum[:, None, None, :]
    slant = axial_momentum(n0, p0 + landed.momentum) / axial_momentum(n0, p0)
    return tube_area(landed.position, volume.grid) * slant


def _caustics_passed(mesh: Mesh, leaving: Deviation, landed: Deviation, tubes: Tubes | None, *, behind: bool) -> Tensor:
    """Caustics behind each triangle, (source, triangle), negative where light passed them on its way forward.

    A caustic costs a quarter of a wave where it is passed forward; the way back to the plane gives it back. behind:
    whether the plane lies behind the volume.
    """
    crossed = crossed_caustics(mesh.edges(leaving.position), mesh.edges(landed.position))
    quarters = -crossed if behind else crossed
    return quarters if tubes is None else quarters - mesh.of_triangles(tubes.passed())


class _Inside:
    """Values between a triangle's corners, at each pixel that lies inside it.

    weight: the corners' barycentric weights, (pair, 3). area: of the triangle in µm², (pair,).
    """

    def __init__(self, mesh: Mesh, pairs: Pairs, displacement: Tensor) -> None:
        self._mesh, self._source, self._vertices = mesh, pairs.source[:, None], mesh.triangles[pairs.triangle]
        home = (pairs.pixel[:, None] - mesh.home[self._vertices]) * mesh.spacing
        self._offset = home - self.corners(displacement)
        opposite = cross(self._offset.roll(-1, 1), self._offset.roll(-2, 1))
        self.area = opposite.sum(-1)
        self.weight = opposite / self.area[:, None]

    def corners(self, values: Tensor) -> Tensor:
        """Values (source, y, x, …) of the rays at the corners, (pair, 3, …)."""
        return self._mesh.flat(values)[self._source, self._vertices]

    def slopes(self, momentum: Tensor) -> Tensor:
        """δp·(X − x) of each corner at x, (pair, 3)."""
        return (self.corners(momentum) * self._offset).sum(-1)

    def mean(self, values: Tensor) -> Tensor:
        """Values of the rays, linear between the corners, (pair,)."""
        return (self.weight * self.corners(values)).sum(-1)

    def amplitude(self, tube: Tensor, grid: Grid) -> Tensor:
        """The inverse root of a tube's cross-section, (pair,)."""
        flat = self.area / (grid.spacing[1] * grid.spacing[2])
        smooth = self.mean(tube)
        # beside a fold the interpolated area may vanish or change sign inside a triangle whose own does not
        smooth = torch.where(smooth / flat > 0.25, smooth, flat)
        return smooth.abs().clamp_min(LEAST_TUBE).rsqrt()
