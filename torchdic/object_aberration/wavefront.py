"""The specimen's own aberration: where the lens finds each object point (Kagalwala & Kanade, section 3.3).

An object point sends its light through the rest of the specimen to the lens. One of its rays is called the axial ray.
Around it, at the lens, the surface of equal phase has the mean curvature H. The lens law images a point sharply if this
curvature is H0 = cosθ/(z_L − f), where f is the plane of focus, z_L the lens and θ the axial ray's angle behind the
specimen. So the point is sharp at the f with H = H0, and its effective defocus is δ = f − z_s = z_L − cosθ/H − z_s. It
is 0 in a homogeneous medium. Under a plate of thickness t and index n it is the apparent shift t(1 − n0/n).

H is found in two ways.

"cone": a cone of rays is traced from the point. With (u, v) across the axial ray, w the depth along it and ρ² = u² +
v², the surface of equal phase is fitted by
    2wρ²/(ρ² + w²) = κ11 u² + 2 κ12 uv + κ22 v²,    H = ½ tr κ.
For a sphere this is exact at any angle (the radius of a parabola would err by R·half²/4).

"linear": the limit of a narrow cone. The linear pair Q = ∂x/∂p_s, P = ∂p/∂p_s is carried along the axial ray
(`torchdic.rays.pair`). The radii of curvature are R = n0 T⁻¹ Q P⁻¹ T⁻¹, where T⁻¹ = I + (cosθ − 1) p̂p̂ᵀ turns from the
plane z = const into the axial ray's frame.

A lens is far away: κ differs little from 1/L, and not at all at infinity. Here c = 1/L is the inverse of the lens's
distance from the last face along the axial ray. Both ways therefore compute M = R(I + cR)⁻¹, which stays finite for a
lens at infinity. Then κ = c(I − cM), and with m = ½ tr M the sharp plane is f = z_e − cosθ·m/(1 − cm), where z_e is the
last face.
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

# How carefully rays are traced. Only the fidelity's solver, steps, interpolation and memory are used.
CAREFUL = replace(STANDARD, interpolation="cubic")


@dataclass(frozen=True, eq=False)
class Wavefront:
    """The wave from each object point as the lens sees it around the axial ray.

    plane: depth z_s of the object points in µm.
    face: depth z_e of the volume's last face in µm.
    cosine: (…), cosθ of the axial ray behind the specimen.
    nearness: (…), c = cosθ/(z_L − face) in 1/µm, 0 for a lens at infinity.
    radius: (…, 2, 2) in µm, M = R(I + cR)⁻¹ with the radii of curvature R at the last face. Its axes are (y, x) after
        the shortest turn from z to the axial ray.
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
        """The plane of focus in which the point is sharp, f = z_L − cosθ/H, (…) in µm."""
        m = self._mean_radius
        return self.face - self.cosine * m / (1 - self.nearness * m)

    @property
    def defocus(self) -> Float[Tensor, " *point"]:
        """δ = f − z_s, (…) in µm: how much nearer to the lens the point seems than it is."""
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
    """The specimen's effective defocus δ in µm of object points at depth `plane`.

    The arguments are those of `wavefront`. δ has the shape (y, x) for one direction and the voxel centres, otherwise
    that of points and momentum broadcast. It is positive if the point seems nearer to the lens than it is. It is
    differentiable in the volume.
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

    volume: the specimen.
    plane: depth of the object points in µm.
    momentum: (…, 2), n·(transverse direction) of the axial ray at the object point. None is along z.
    fidelity: its solver, steps, interpolation and memory are used.
    points: (…, 2), (y, x) in µm. None is the voxel centres.
    method: "linear" is the limit of a narrow cone. "cone" traces a cone of half_angle, and its result approaches that
        limit with the square of the angle.
    half_angle: in rad, in the background. For a condenser's aperture it is asin(NA_c/n0).
    lens: depth z_L of the lens in µm, behind the volume. The default is infinity, for which H⁻¹ − L becomes the mean
        radius of curvature.

    A cone's rounding error grows as eps·extent/half_angle², so narrow cones need float64. δ is without bound where the
    light leaves collimated.

    Raises ValueError for a plane outside the volume, a lens inside it, an adaptive solver, linear interpolation with
    method "linear", a half_angle that is missing or has no use, a cone that reaches 90° from the axis, and rays that
    can't go on toward +z.
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
