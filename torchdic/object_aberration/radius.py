"""The wave's radii of curvature in the axial ray's frame, from the rays that leave the last face.

The first axis of momenta and directions holds their components (y, x).
"""

import math

import torch
from torch import Tensor

from torchdic.plane_waves import axial_momentum
from torchdic.rays.pair import LinearPair
from torchdic.rays.trace import Deviation

# Rays of a cone: rings at these fractions of its half angle, with this many rays each, in opposite pairs (no coma).
RINGS, AZIMUTHS = (0.5, 1.0), 8


def cosine_behind(p: Tensor, n0: Tensor) -> Tensor:
    """Cosθ in the background for rays of momentum p (2, …)."""
    return axial_momentum(n0, p.movedim(0, -1)) / n0


def tilt(direction: Tensor, cosine: Tensor) -> Tensor:
    """T⁻¹ = I + (cosθ − 1) p̂p̂ᵀ, (…, 2, 2), computed without p̂, which a ray along z does not have."""
    outer = direction[:, None] * direction[None] / (1 + cosine)
    return torch.eye(2).to(direction) - outer.movedim((0, 1), (-2, -1))


def linear_radius(leaving: LinearPair, p: Tensor, n0: Tensor, cosine: Tensor, nearness: Tensor) -> Tensor:
    """M = R(I + cR)⁻¹ = n0 T⁻¹ Q (P + c n0 T⁻² Q)⁻¹ T⁻¹ from the linear pair, (…, 2, 2) in µm.

    leaving: the pair at the last face.
    p: the axial rays' momenta there, (2, …).
    n0: index of the background.
    cosine: cosθ of the axial rays.
    nearness: c in 1/µm.
    """
    Q, P, T = leaving.q, leaving.p, tilt(p / n0, cosine)
    spread = P + nearness[..., None, None] * n0 * (T @ T @ Q)
    (a, b), (c, d) = (row.unbind(-1) for row in spread.unbind(-2))
    adjugate = torch.stack((d, -b, -c, a), -1).unflatten(-1, (2, 2))
    return n0 * (T @ Q @ adjugate @ T) / (a * d - b * c)[..., None, None]


def cone_around(p0: Tensor, n0: Tensor, half_angle: float) -> Tensor:
    """Momenta (2, 1 + ray, …) of a cone of rays in the background. The axial ray comes first.

    p0: momenta of the axial rays, (2, …).
    n0: index of the background.
    half_angle: of the cone, in rad.
    Raises ValueError if the cone reaches 90° from z.
    """
    direction, cosine = p0 / n0, cosine_behind(p0, n0)
    steepest = math.degrees(float(cosine.detach().min().acos())) if cosine.numel() else 0.0
    if not steepest + math.degrees(half_angle) < 90:
        raise ValueError(
            f"a cone of {math.degrees(half_angle):.4g}° around a ray at {steepest:.4g}° from z reaches 90°: "
            "its rays would not go toward +z"
        )
    angle = half_angle * torch.tensor(RINGS, dtype=torch.float64).repeat_interleave(AZIMUTHS)
    azimuth = 2 * math.pi / AZIMUTHS * torch.arange(AZIMUTHS, dtype=torch.float64).repeat(len(RINGS))
    # the rings are turned against each other, so that together they have more azimuths
    azimuth = azimuth + math.pi / AZIMUTHS * torch.arange(len(RINGS)).repeat_interleave(AZIMUTHS)
    across = (angle.sin() * torch.stack((azimuth.sin(), azimuth.cos()))).to(p0)
    turned = (tilt(direction, cosine) @ across).movedim((-2, -1), (0, 1))
    along = angle.cos().to(p0).reshape(-1, *[1] * cosine.dim())
    return torch.cat((p0[:, None], n0 * (along * direction[:, None] + turned)), 1)


def cone_radius(leaving: Deviation, cone: Tensor, n0: Tensor, length: float, nearness: Tensor) -> Tensor:
    """M by the fit of `torchdic.object_aberration.wavefront`, (…, 2, 2) in µm.

    u, v are in units of the lens's distance L.
    leaving: the cone's rays at the last face.
    cone: their momenta at the start; the axial ray comes first.
    n0: index of the background.
    length: from the object points to the last face along z, µm.
    nearness: c in 1/µm.
    Let d be the unit directions, d_a the axial one, and s = d − d_a. Seen from the axial ray's end, a ray reaches the
    same phase at e + sL. The sphere through this point that is normal to the axial ray has the radius L + h with
        h = (c|e|² + 2e·d)/(|s|² − 2c e·d_a).
    """
    displacement, deflection = (v.movedim(-1, 0) for v in (leaving.position, leaving.momentum))
    p = cone + deflection
    direction, cosine = p / n0, cosine_behind(p, n0)
    d, axial = direction[:, 1:], direction[:, :1]
    dz, axial_z = cosine[1:], cosine[:1]
    s = d - axial
    sz = -(s * (d + axial)).sum(0) / (dz + axial_z)
    # ∫n ds, from W and the unperturbed ray's n0²·length/p_z0; in µm of the background
    start = cosine_behind(cone, n0)
    path = leaving.opd / n0 + length / start + (cone * displacement).sum(0) / n0
    behind = path[:1] - path[1:]
    landing = displacement + cone * (length / n0 / start)
    e = landing[:, 1:] - landing[:, :1] + d * behind
    ez = dz * behind

    c = nearness
    along = (e * axial).sum(0) + ez * axial_z
    s2, e2 = s.square().sum(0) + sz * sz, e.square().sum(0) + ez * ez
    h = (c * e2 + 2 * ((e * d).sum(0) + ez * dz)) / (s2 - 2 * c * along)
    across, across_z = s + c * e, sz + c * ez
    T = tilt(axial[:, 0], axial_z[0]).movedim((-2, -1), (0, 1))
    u, v = (T[:, :, None] * across[None]).sum(1) - axial * across_z
    # least squares, scaled so that its normal matrix is of order 1
    size = (u * u + v * v).detach().amax(0)
    basis = torch.stack((u * u, 2 * u * v, v * v), -1) / size[..., None]
    target = (u * u + v * v) / size * h / (1 + c * h)
    normal = (basis[..., :, None] * basis[..., None, :]).sum(0)
    right = (basis * target[..., None]).sum(0)
    uu, uv, vv = torch.linalg.solve_ex(normal, right)[0].unbind(-1)
    return torch.stack((uu, uv, uv, vv), -1).unflatten(-1, (2, 2))
