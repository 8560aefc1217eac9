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
cone, the linear pair Q = ∂x/∂p_s, P = ∂p/∂p_s carried along the axial ray; with g = n∇⊥n and G = ½∇⊥∇⊥n²,
    Q' = (P + p kᵀ)/p_z,    P' = (G Q + g kᵀ)/p_z,    k = (Pᵀp − Qᵀg)/p_z²,    Q = 0, P = I at the point
(Hamilton's variational equations of H = −p_z), and the radii of curvature R = n0 T⁻¹ Q P⁻¹ T⁻¹, where
T⁻¹ = I + (cosθ − 1) p̂p̂ᵀ turns from the plane z = const into the axial ray's frame.

A lens is far: κ differs from 1/L by little, and by nothing at infinity. So both ways find M = R(I + cR)⁻¹, c = 1/L the
inverse of the lens's distance along the axial ray from the last face, which stays finite there: κ = c(I − cM), and with
m = ½ tr M the sharp plane is f = z_e − cosθ·m/(1 − cm).
"""

import math
from dataclasses import dataclass
from typing import get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.fidelity import ADAPTIVE, AberrationMethod, Fidelity, Interpolation
from torchdic.memory.batches import recompute, slabs
from torchdic.plane_waves import axial_momentum
from torchdic.rays.solver import TABLEAUX, equal_steps
from torchdic.specimen.interpolation import SliceSampler, spline_coefficients, spline_taps, window
from torchdic.specimen.volume import Volume

CAREFUL = Fidelity("rays", interpolation="cubic")

# Rays of a cone: rings at these fractions of its half angle, with so many rays each, in opposite pairs (no coma).
RINGS = (0.5, 1.0)

AZIMUTHS = 8

# Values per ray and step that autograd keeps for the backward pass of a ray, and of one that carries the linear pair.
# (`torchdic.rays` starts at the first face; object points lie inside.)
KEPT_BY_RAY: dict[Interpolation, int] = {"linear": 110, "cubic": 460}

KEPT_BY_PAIR = 1000


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
    # components first: what follows is spent on sums over pairs otherwise
    position, p0 = (v.to(volume.delta).movedim(-1, 0) for v in torch.broadcast_tensors(points, momentum))

    if half_angle is None:
        leaving = _cross(volume, plane, position, p0, fidelity, pair=True)
        p = p0 + leaving.momentum
        cosine = _cosine(p, n0)
        nearness = cosine / (lens - face)
        return Wavefront(plane, face, cosine, nearness, _linear_radius(leaving, p, n0, cosine, nearness))
    cone = _cone(p0, n0, half_angle)
    leaving = _cross(volume, plane, position[:, None], cone, fidelity, pair=False)
    cosine = _cosine((cone + leaving.momentum)[:, 0], n0)
    nearness = cosine / (lens - face)
    return Wavefront(plane, face, cosine, nearness, _cone_radius(leaving, cone, n0, face - plane, nearness))


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


# --- from the object point to the last face --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Leaving:
    """At the last face: δx and δp (2, …) and W (…) as of `rays`, and, of the linear pair, Q and P (2, 2, …)."""

    position: Tensor
    momentum: Tensor
    opd: Tensor
    q: Tensor | None
    p: Tensor | None


class _CurvedSampler(SliceSampler):
    """A cubic spline with its second derivatives."""

    def curvature(self, z: float, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """∂²/∂y², ∂²/∂y∂x and ∂²/∂x² (1/µm²) at depth z and positions (y, x) in µm."""
        field = self.plane(z)
        (ny, nx), (dy, dx) = field.shape, self.grid.spacing[1:]
        iy, ix = self._indices(y, x)
        (rows, wy, sy), (columns, wx, sx) = spline_taps(iy, ny), spline_taps(ix, nx)
        patch = field.reshape(-1)[rows[..., :, None] * nx + columns[..., None, :]]
        along_x = (patch * wx[..., None, :]).sum(-1)
        slope_x = (patch * sx[..., None, :]).sum(-1)
        bend_x = (patch * _bends(ix, nx)[..., None, :]).sum(-1)
        yy, yx, xx = ((v * w).sum(-1) for v, w in ((along_x, _bends(iy, ny)), (slope_x, sy), (bend_x, wy)))
        return yy / (dy * dy), yx / (dy * dx), xx / (dx * dx)


def _bends(index: Tensor, n: int) -> Tensor:
    """Second derivatives of the weights of a fractional index's four neighbours; 0 beyond the outermost centres."""
    along = index.clamp(0, n - 1)
    t = along - along.detach().floor().clamp(max=max(n - 2, 0))
    return torch.stack((1 - t, 3 * t - 2, 1 - 3 * t, t), -1) * (along == index)[..., None]


def _cross(
    volume: Volume, plane: float, position: Tensor, momentum: Tensor, fidelity: Fidelity, *, pair: bool
) -> _Leaving:
    """Rays from depth `plane` to the last face: positions and momenta (2, …), which broadcast."""
    grid, n0, face = volume.grid, volume.background, volume.grid.extent[0] / 2
    field = spline_coefficients(volume.delta) if fidelity.interpolation == "cubic" else volume.delta
    slices = field.unbind(0)
    pz0 = axial_momentum(n0, momentum.movedim(0, -1))
    v = momentum / pz0

    def cross(first: int, last: int, state: Tensor) -> Tensor:
        near = window(grid, float(depths[first]), float(depths[last]), fidelity.interpolation)
        sampler = _CurvedSampler(grid, slices[near], fidelity.interpolation, near.start)

        def slope(z: float, state: Tensor) -> Tensor:
            dx, dp = state[:2], state[2:4]
            y, x = position + v * (z - plane) + dx
            delta, gradient_y, gradient_x = sampler.sample(z, y, x)
            gradient = torch.stack((gradient_y, gradient_x))
            n, p = n0 + delta, momentum + dp
            pz = (n * n - p.square().sum(0)).sqrt()
            contrast = delta * (2 * n0 + delta)
            q = (contrast - (dp * (p + momentum)).sum(0)) / (pz + pz0)
            g = n * gradient
            opd = (contrast + dp.square().sum(0) + q * q) / (2 * pz)
            change = [(dp - v * q) / pz, g / pz, opd[None]]
            if pair:
                Q, P = state[5:9].unflatten(0, (2, 2)), state[9:].unflatten(0, (2, 2))
                yy, yx, xx = sampler.curvature(z, y, x)
                bend = n * torch.stack((yy, yx, yx, xx)).unflatten(0, (2, 2)) + gradient[:, None] * gradient[None]
                k = ((p[:, None] * P).sum(0) - (g[:, None] * Q).sum(0)) / (pz * pz)
                change += [((P + p[:, None] * k) / pz).flatten(0, 1)]
                change += [(((bend[:, :, None] * Q[None]).sum(1) + g[:, None] * k) / pz).flatten(0, 1)]
            return torch.cat(change)

        return equal_steps(slope, state, depths[first : last + 1], fidelity.solver)

    ray = torch.broadcast_tensors(position, momentum)[0].shape[1:]
    state = position.new_zeros(13 if pair else 5, *ray)
    if pair:
        state[9] = state[12] = 1.0
    whole = fidelity.steps or grid.shape[0]
    # a plane one rounding error above a step's end must not cost another step
    steps = math.ceil(whole * (face - plane) / grid.extent[0] - 1e-9)
    depths = plane + (face - plane) * torch.arange(steps + 1, dtype=state.dtype) / max(steps, 1)
    depths[-1] = face
    kept = steps * (KEPT_BY_PAIR if pair else KEPT_BY_RAY[fidelity.interpolation])
    crowded = kept * state[0].numel() * state.element_size() > fidelity.memory
    for first, last in slabs(steps, split=crowded) if steps else ():
        state = recompute(cross, first, last, state, when=crowded)
    # an axial momentum that is not real in the specimen, or in the background behind it
    stopped = ~torch.isfinite(state[4] + axial_momentum(n0, (momentum + state[2:4]).movedim(0, -1)))
    if bool(stopped.any()):
        raise ValueError(
            f"{int(stopped.sum())} of {stopped.numel()} rays can't go on toward +z: "
            "the index falls to their transverse momentum"
        )
    Q, P = (state[5:9].unflatten(0, (2, 2)), state[9:].unflatten(0, (2, 2))) if pair else (None, None)
    return _Leaving(state[:2], state[2:4], state[4], Q, P)


# --- from the last face to the curvature at the lens -----------------------------------------------------------------


def _cosine(p: Tensor, n0: Tensor) -> Tensor:
    """Cosθ in the background of rays of momentum p (2, …)."""
    return axial_momentum(n0, p.movedim(0, -1)) / n0


def _tilt(direction: Tensor, cosine: Tensor) -> Tensor:
    """T⁻¹ = I + (cosθ − 1) p̂p̂ᵀ, (…, 2, 2), without p̂, which a ray along z does not have."""
    outer = direction[:, None] * direction[None] / (1 + cosine)
    return torch.eye(2).to(direction) - outer.movedim((0, 1), (-2, -1))


def _linear_radius(leaving: _Leaving, p: Tensor, n0: Tensor, cosine: Tensor, nearness: Tensor) -> Tensor:
    """M = R(I + cR)⁻¹ = n0 T⁻¹ Q (P + c n0 T⁻² Q)⁻¹ T⁻¹ from the linear pair."""
    assert leaving.q is not None
    assert leaving.p is not None
    Q, P = (m.movedim((0, 1), (-2, -1)) for m in (leaving.q, leaving.p))
    tilt = _tilt(p / n0, cosine)
    spread = P + nearness[..., None, None] * n0 * (tilt @ tilt @ Q)
    (a, b), (c, d) = (row.unbind(-1) for row in spread.unbind(-2))
    adjugate = torch.stack((d, -b, -c, a), -1).unflatten(-1, (2, 2))
    return n0 * (tilt @ Q @ adjugate @ tilt) / (a * d - b * c)[..., None, None]


def _cone(p0: Tensor, n0: Tensor, half_angle: float) -> Tensor:
    """Momenta (2, 1 + ray, …) of a cone in the background around p0 (2, …), which comes first."""
    direction, cosine = p0 / n0, _cosine(p0, n0)
    steepest = math.degrees(float(cosine.detach().min().acos())) if cosine.numel() else 0.0
    if not steepest + math.degrees(half_angle) < 90:
        raise ValueError(
            f"a cone of {math.degrees(half_angle):.4g}° around a ray at {steepest:.4g}° from z reaches 90°: "
            "its rays would not go toward +z"
        )
    angle = half_angle * torch.tensor(RINGS, dtype=torch.float64).repeat_interleave(AZIMUTHS)
    azimuth = 2 * math.pi / AZIMUTHS * torch.arange(AZIMUTHS, dtype=torch.float64).repeat(len(RINGS))
    # the rings turned against each other see more azimuths
    azimuth = azimuth + math.pi / AZIMUTHS * torch.arange(len(RINGS)).repeat_interleave(AZIMUTHS)
    across = (angle.sin() * torch.stack((azimuth.sin(), azimuth.cos()))).to(p0)
    turned = (_tilt(direction, cosine) @ across).movedim((-2, -1), (0, 1))
    along = angle.cos().to(p0).reshape(-1, *[1] * cosine.dim())
    return torch.cat((p0[:, None], n0 * (along * direction[:, None] + turned)), 1)


def _cone_radius(leaving: _Leaving, cone: Tensor, n0: Tensor, length: float, nearness: Tensor) -> Tensor:
    """M by the fit of the module's head, with u, v in units of the lens's distance L.

    d: unit directions, the axial one first; s = d − d_a. Seen from the axial ray's end, a ray reaches its phase at
    e + sL, and the sphere through there that is normal to the axial ray has the radius L + h,
        h = (c|e|² + 2e·d)/(|s|² − 2c e·d_a).
    """
    p = cone + leaving.momentum
    direction, cosine = p / n0, _cosine(p, n0)
    d, axial = direction[:, 1:], direction[:, :1]
    dz, axial_z = cosine[1:], cosine[:1]
    s = d - axial
    sz = -(s * (d + axial)).sum(0) / (dz + axial_z)
    # ∫n ds, from W and the unperturbed ray's n0²·length/p_z0; in µm of the background
    start = _cosine(cone, n0)
    path = leaving.opd / n0 + length / start + (cone * leaving.position).sum(0) / n0
    behind = path[:1] - path[1:]
    landing = leaving.position + cone * (length / n0 / start)
    e = landing[:, 1:] - landing[:, :1] + d * behind
    ez = dz * behind

    c = nearness
    along = (e * axial).sum(0) + ez * axial_z
    s2, e2 = s.square().sum(0) + sz * sz, e.square().sum(0) + ez * ez
    h = (c * e2 + 2 * ((e * d).sum(0) + ez * dz)) / (s2 - 2 * c * along)
    across, across_z = s + c * e, sz + c * ez
    tilt = _tilt(axial[:, 0], axial_z[0]).movedim((-2, -1), (0, 1))
    u, v = (tilt[:, :, None] * across[None]).sum(1) - axial * across_z
    # least squares, scaled so that its normal matrix is of order 1
    size = (u * u + v * v).detach().amax(0)
    basis = torch.stack((u * u, 2 * u * v, v * v), -1) / size[..., None]
    target = (u * u + v * v) / size * h / (1 + c * h)
    normal = (basis[..., :, None] * basis[..., None, :]).sum(0)
    right = (basis * target[..., None]).sum(0)
    uu, uv, vv = torch.linalg.solve_ex(normal, right)[0].unbind(-1)
    return torch.stack((uu, uv, uv, vv), -1).unflatten(-1, (2, 2))
