"""The specimen's own aberration: where the lens finds each object point (Kagalwala & Kanade, section 3.3).

An object point sends its light through the rest of the specimen. At the lens, around one ray of it, the axial one,
equal phase is a surface of mean curvature H, where the lens law images sharply what has H0 = cosθ/(z_L − f): f is the
plane of focus, z_L the lens, θ the axial ray's angle behind the specimen. Where H = H0 the point is sharp, so its
effective defocus is δ = f − z_s = z_L − cosθ/H − z_s. It is 0 in a homogeneous medium; under a plate of thickness t
and index n it is the apparent shift t(1 − n0/n).

H is found in two ways. "cone": a cone of rays is traced from the point, and with (u, v) across the axial ray and the
depth w along it, ρ² = u² + v², the surface of equal phase is fitted by
    2wρ²/(ρ² + w²) = κ11 u² + 2 κ12 uv + κ22 v²,    H = ½ tr κ,
which for a sphere is exact at any angle (a parabola's radius would err by R·half²/4). "linear": the limit of a narrow
cone, the linear pair Q = ∂x/∂p_s, P = ∂p/∂p_s carried along the axial ray (`torchdic.rays.pair`), and the radii of
curvature R = n0 T⁻¹ Q P⁻¹ T⁻¹, where T⁻¹ = I + (cosθ − 1) p̂p̂ᵀ turns from the plane z = const into the axial
ray's frame.

A lens is far: κ differs from 1/L by little, and by nothing at infinity. So both ways find M = R(I + cR)⁻¹, c = 1/L the
inverse of the lens's distance along the axial ray from the last face, which stays finite there: κ = c(I − cM), and with
m = ½ tr M the sharp plane is f = z_e − cosθ·m/(1 − cm).
"""

import math
from dataclasses import dataclass, replace
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import ADAPTIVE, AberrationMethod, Fidelity
from torchdic.object_aberration.radius import cone_around, cone_radius, cosine_behind, linear_radius
from torchdic.propagation.presets import STANDARD
from torchdic.rays.pair import linear_pair
from torchdic.rays.solver import TABLEAUX
from torchdic.rays.trace import Rays, deviation
from torchdic.specimen.volume import Volume

# How carefully rays are traced: of a fidelity solver, steps, interpolation and memory are read.
CAREFUL = replace(STANDARD, interpolation="cubic")


@dataclass(frozen=True, eq=False)
class Wavefront:
    """The wave from each object point as the lens sees it around the axial ray.

    plane: depth z_s of the object points in µm. face: depth of the volume's last face in µm. cosine: (…), cosθ of the
    axial ray behind the specimen. nearness: (…), c = cosθ/(z_L − face) in 1/µm, 0 for a lens at infinity.
    radius: (…, 2, 2) in µm, M = R(I + cR)⁻¹, R the radii of curvature at the last face; axes (y, x) turned with the
    shortest turn from z to the axial ray.
    """

    plane: float
    face: float
    cosine: Float[Tensor, " *point"]
    nearness: Float[Tensor, " *point"]
    radius: Float[Tensor, "*point 2 2"]

    @property
    def curvature(self) -> Float[Tensor, "*point 2 2"]:
        """κ = c(I − cM) at the lens, (…, 2, 2) in 1/µm, positive for a wave that spreads."""
        c = self.nearness[..., None, None]
        return c * (torch.eye(2).to(self.radius) - c * self.radius)

    @property
    def mean_curvature(self) -> Float[Tensor, " *point"]:
        """H = ½ tr κ at the lens, (…) in 1/µm; the lens law images H0 = cosθ/(z_L − f) sharply."""
        return self.nearness * (1 - self.nearness * self._mean_radius)

    @property
    def sharp_plane(self) -> Float[Tensor, " *point"]:
        """Plane of focus that makes the point sharp, f = z_L − cosθ/H, (…) in µm."""
        m = self._mean_radius
        return self.face - self.cosine * m / (1 - self.nearness * m)

    @property
    def defocus(self) -> Float[Tensor, " *point"]:
        """δ = f − z_s, (…) in µm: how much nearer to the lens than it is the point seems."""
        return self.sharp_plane - self.plane

    @property
    def _mean_radius(self) -> Tensor:
        return (self.radius[..., 0, 0] + self.radius[..., 1, 1]) / 2


def effective_defocus(
    volume: Volume,
    plane: float,
    momentum: Float[Tensor, "*#point 2"] | None = None,
    fidelity: Fidelity = CAREFUL,
    *,
    points: Float[Tensor, "*#point 2"] | None = None,
    method: AberrationMethod = "linear",
    half_angle: float | None = None,
    lens: float = math.inf,
) -> Float[Tensor, " *point"]:
    """The specimen's effective defocus δ in µm of object points at depth `plane`; arguments as of `wavefront`.

    Shape (y, x) for one direction and the voxel centres, else that of points and momentum broadcast. Positive where the
    point seems nearer to the lens than it is. Differentiable in the volume.
    """
    seen = wavefront(volume, plane, momentum, fidelity, points=points, method=method, half_angle=half_angle, lens=lens)
    return seen.defocus


def wavefront(
    volume: Volume,
    plane: float,
    momentum: Float[Tensor, "*#point 2"] | None = None,
    fidelity: Fidelity = CAREFUL,
    *,
    points: Float[Tensor, "*#point 2"] | None = None,
    method: AberrationMethod = "linear",
    half_angle: float | None = None,
    lens: float = math.inf,
) -> Wavefront:
    """The wave from object points at depth `plane` (µm, within the volume) as the lens sees it.

    momentum: (…, 2), n·(transverse direction) of the axial ray at the object point; None is along z. points: (…, 2),
    (y, x) in µm; None are the voxel centres. method: "linear" is the limit of a narrow cone; "cone" traces one of
    half_angle (rad, in the background: asin(NA_c/n0) for a condenser's aperture), and approaches it with the square of
    the angle. lens: depth z_L in µm of the lens, behind the volume; at infinity, the default, H⁻¹ − L becomes the mean
    radius of curvature.

    A cone's rounding grows as eps·extent/half_angle²: narrow ones want float64. δ is unbounded where the light leaves
    collimated. Of `fidelity` solver, steps, interpolation and memory are read.

    Raises ValueError for a plane outside the volume, a lens inside it, an adaptive solver, linear interpolation with
    method "linear", half_angle missing or without a use, a cone that reaches 90° from the axis, and where rays can't go
    on toward +z.
    """
    _check(volume, plane, fidelity, method, half_angle, lens)
    grid, n0 = volume.grid, volume.background
    face = grid.extent[0] / 2
    if points is None:
        y, x = (grid.coordinates(axis, dtype=n0.dtype, device=n0.device) for axis in (1, 2))
        points = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1)
    if momentum is None:
        momentum = points.new_zeros(2)
    position, p0 = (v.to(volume.delta) for v in torch.broadcast_tensors(points, momentum))
    clear = Volume(grid, volume.delta, n0).sampled(fidelity.interpolation)  # absorption bends no ray
    if half_angle is None:
        pair = linear_pair(clear, _launched(position, p0), fidelity, plane)
        p = (p0 + pair.ray.momentum).movedim(-1, 0)
        cosine = _cosine_behind(p, n0)
        nearness = cosine / (lens - face)
        return Wavefront(plane, face, cosine, nearness, linear_radius(pair, p, n0, cosine, nearness))
    # the axial ray comes first
    cone = cone_around(p0.movedim(-1, 0), n0, half_angle)
    leaving = deviation(clear, _launched(position, cone.movedim(0, -1)), fidelity, start=plane)
    cosine = _cosine_behind(cone + leaving.momentum.movedim(-1, 0), n0)[0]
    nearness = cosine / (lens - face)
    return Wavefront(plane, face, cosine, nearness, cone_radius(leaving, cone, n0, face - plane, nearness))


def _launched(position: Tensor, momentum: Tensor) -> Rays:
    return Rays(position.expand_as(momentum), momentum, momentum.new_zeros(momentum.shape[:-1]))


def _cosine_behind(p: Tensor, n0: Tensor) -> Tensor:
    """Cosθ in the background behind the specimen. Raises TurnedRaysError for rays that the medium traps."""
    cosine = cosine_behind(p, n0)
    trapped = ~torch.isfinite(cosine)
    if bool(trapped.any()):
        raise TurnedRaysError.of(trapped, "in the medium behind the volume")
    return cosine


def _check(
    volume: Volume, plane: float, fidelity: Fidelity, method: AberrationMethod, half_angle: float | None, lens: float
) -> None:
    face = volume.grid.extent[0] / 2
    if not -face <= plane <= face:
        raise ValueError(f"object plane {plane} µm lies outside the volume, which fills {-face:g} … {face:g} µm")
    if not lens > face:
        raise ValueError(f"lens at {lens} µm must lie behind the volume, whose last face is at {face:g} µm")
    if fidelity.solver in ADAPTIVE:
        raise ValueError(
            f"solver {fidelity.solver!r} adapts its steps; curvature takes equal ones: {', '.join(TABLEAUX)}"
        )
    if method not in get_args(AberrationMethod):
        raise ValueError(f"method {method!r} must be one of {', '.join(map(repr, get_args(AberrationMethod)))}")
    if method == "linear":
        if half_angle is not None:
            raise ValueError(f'half_angle {half_angle} rad has no use in method "linear", a cone of no width')
        if fidelity.interpolation == "linear":
            raise ValueError('method "linear" needs second derivatives of the index: interpolation must be "cubic"')
    elif half_angle is None or not 0 < half_angle < math.pi / 2:
        raise ValueError(f'half_angle {half_angle} rad must be above 0 and below π/2 in method "cone"')
