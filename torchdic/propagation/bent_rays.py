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

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.memory.batches import Demand, indices
from torchdic.plane_waves import axial_momentum
from torchdic.rays.caustics import tubes_that_may_fold
from torchdic.rays.mesh import MARGIN, Mesh, cross, crossed_caustics
from torchdic.rays.trace import Deviation, deviation, kept_by_rays, launch, steps_of
from torchdic.specimen.volume import Volume

# Least tube area relative to the unperturbed one: a caustic is bright but finite.
LEAST_TUBE = 1e-3


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
    mesh = Mesh(grid, landed.position)

    with torch.no_grad():
        source, triangle, pixel = mesh.covered(landed.position)
        crossed = crossed_caustics(mesh.edges(leaving.position), mesh.edges(landed.position))
        # a caustic costs a quarter of a wave where it is passed forward, and the way back to the plane gives it back
        quarters = -crossed if plane > grid.extent[0] / 2 else crossed
        if tubes is not None:
            quarters = quarters - mesh.of_triangles(tubes.passed())
        caustic = (math.pi / 2) * quarters[source, triangle]

    def corners(values: Tensor) -> Tensor:
        return mesh.flat(values)[source[:, None], mesh.triangles[triangle]]

    offset = (pixel[:, None] - mesh.home[mesh.triangles[triangle]]) * mesh.spacing - corners(landed.position)
    opposite = cross(offset.roll(-1, 1), offset.roll(-2, 1))
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
