"""The right-hand side of the ray ODE (see `torchdic.rays.trace`), and its derivative written out by hand.

Autograd would keep every intermediate value: about 27 for each ray and evaluation with linear interpolation of the
index, and 115 with a cubic spline. The derivative written by hand needs only where a ray was and what it met there.
With p = p0 + δp, n = n0 + Δn, v = p0/p_z0 and r = 1/p_z the slopes are

    δy' = r (δp_y − v_y q),    δp_y' = r n ∂n/∂y,    W' = r (B + |δp|² + q²)/2,
    ∫κ ds: r n κ,    τ' = r (p_x ∂n/∂y − p_y ∂n/∂x)/(n + p_z).

Here q = (p_z² − p_z0²)/(p_z + p_z0), which equals p_z − p_z0. Its numerator is computed as B − δp·(δp + 2p0), without
cancellation. W, ∫κ ds and τ are sums along the ray: no slope depends on them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.specimen.interpolation import SliceSampler

# A state begins with the moving components δy, δx, δp_y, δp_x. The sums along the ray follow.
MOVING = 4


@dataclass(frozen=True, eq=False)
class RayEquation:
    """The ODE of many rays at once.

    The state holds δy, δx, δp_y, δp_x and W, then ∫κ ds if light is absorbed, then τ if `turn`.

    straight: (7, …), the unperturbed rays' y and x on the plane where they start, v_y, v_x, p_y, p_x and p_z.
    background: n0, 0-d.
    index, absorption: samplers of Δn and κ.
    face: depth in µm of the plane where the rays start.
    turn: whether τ is computed.
    Call its methods under torch.no_grad().
    """

    straight: Float[Tensor, "7 *ray"]
    background: Float[Tensor, ""]
    index: SliceSampler
    absorption: SliceSampler | None
    face: float
    turn: bool

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All tensors by which a solution may be differentiated: straight, background, slices of Δn, slices of κ."""
        kappa = () if self.absorption is None else self.absorption.slices
        return (self.straight, self.background, *self.index.slices, *kappa)

    @cached_property
    def _unperturbed(self) -> "_Unperturbed":
        return _Unperturbed(self.straight[:2], self.straight[2:4], self.straight[4:6], self.straight[6])

    def meet(self, z: float, moving: Float[Tensor, "4 *ray"]) -> "Met":
        """What rays meet at depth z (µm). moving: their δy, δx, δp_y, δp_x."""
        y, x = self._positions(z, moving)
        kappa = None if self.absorption is None else self.absorption.value(z, y, x)
        return self.momenta(moving, self.index.sample(z, y, x), kappa)

    def momenta(
        self, moving: Float[Tensor, "4 *ray"], index: Float[Tensor, "3 *ray"], kappa: Float[Tensor, " *ray"] | None
    ) -> "Met":
        """Like `meet`, from samples taken before. index: Δn, ∂n/∂y, ∂n/∂x. kappa: κ, or None."""
        _, _, p0, pz0 = self._unperturbed
        delta, dp = index[0], moving[2:]
        dp_y, dp_x = dp.unbind()
        path = (delta + 2 * self.background).mul_(delta)
        rise, other = torch.add(dp, p0, alpha=2).mul_(dp).unbind()
        torch.sub(path, rise, out=rise).sub_(other)
        pz = torch.addcmul(rise, pz0, pz0).sqrt_()
        q = rise.div_(pz + pz0)
        path.addcmul_(dp_y, dp_y).addcmul_(dp_x, dp_x).addcmul_(q, q)
        return Met(moving, dp, index, kappa, delta + self.background, pz, pz.reciprocal(), q, path)

    def moves(self, met: "Met", out: Float[Tensor, "4 *ray"] | None = None) -> Float[Tensor, "4 *ray"]:
        """The slopes of δy, δx, δp_y and δp_x, written into `out` if it is given."""
        slopes = torch.empty_like(met.moving) if out is None else out
        of_place, of_momentum = slopes.split(2)
        torch.addcmul(met.dp, self._unperturbed.v, met.q, value=-1, out=of_place).mul_(met.r)
        torch.mul(met.sampled[1:], met.n * met.r, out=of_momentum)
        return slopes

    def slopes(self, met: "Met") -> Float[Tensor, "component *ray"]:
        """d(state)/dz."""
        components = MOVING + 1 + (met.kappa is not None) + self.turn
        slopes = met.n.new_empty(components, *met.n.shape)
        self.moves(met, out=slopes[:MOVING])
        sums = iter(slopes[MOVING:])
        torch.mul(met.path, met.r, out=next(sums)).mul_(0.5)
        if met.kappa is not None:
            torch.mul(met.kappa, met.n, out=next(sums)).mul_(met.r)
        if self.turn:
            torch.mul(self._swept(met), met.r, out=next(sums))
        return slopes

    def pull_back(
        self,
        z: float,
        met: "Met",
        moves_bar: Tensor,
        sums_bar: Tensor,
        sampled_bar: Tensor | None = None,
        h: float = 1.0,
    ) -> "Pulled":
        """The loss's derivatives with respect to what was met at depth z.

        A name that ends in _bar is the loss's derivative with respect to that value.
        moves_bar: of the result of `moves`. It is overwritten.
        sums_bar: of the sums, to which the slopes contribute h times.
        sampled_bar: of what was sampled, where the loss depends on it in other ways too.
        """
        bars = self._pull_back_slopes(met, moves_bar, sums_bar, h)
        y, x = self._positions(z, met.moving)
        index_bar = bars.sampled if sampled_bar is None else bars.sampled + sampled_bar
        place_bar, index_plane_bar = self.index.pull_back(z, y, x, index_bar)
        planes_bar = [index_plane_bar]
        if self.absorption is not None and bars.kappa is not None:
            further, kappa_plane_bar = self.absorption.pull_back_value(z, y, x, bars.kappa)
            place_bar.add_(further)
            planes_bar.append(kappa_plane_bar)
        moving_bar = torch.empty_like(met.moving)
        of_place, of_momentum = moving_bar.split(2)
        of_place.copy_(place_bar)
        torch.addcmul(bars.p, met.dp, bars.path, out=of_momentum).add_(bars.drift)
        straight_bar = background_bar = None
        if self.straight.requires_grad:
            v_bar = torch.mul(place_bar, z - self.face).addcmul_(bars.drift, met.q, value=-1)
            straight_bar = torch.cat((place_bar, v_bar, bars.p, bars.less_q[None]))
        if self.background.requires_grad:
            background_bar = bars.sampled[0].sum() - self.background * bars.path.sum()
        return Pulled(moving_bar, straight_bar, background_bar, planes_bar)

    def _pull_back_slopes(self, met: "Met", moves_bar: Tensor, sums_bar: Tensor, h: float) -> "_SlopesPulled":
        """The loss's derivatives with respect to what the slopes are made of; see `pull_back`."""
        _, gy, gx = met.sampled.unbind()
        n, pz, r, q, dp, (_, v, p0, _) = met.n, met.pz, met.r, met.q, met.dp, self._unperturbed
        place_out, momentum_out = moves_bar.mul_(r).split(2)
        path_bar = torch.mul(sums_bar[0], r).mul_(h)
        index_bar = torch.empty_like(met.sampled)
        n_bar = torch.mul(gy, momentum_out[0], out=index_bar[0]).addcmul_(gx, momentum_out[1])
        gradient_bar = torch.mul(n, momentum_out, out=index_bar[1:])
        # with respect to r = 1/p_z, whose derivative with respect to p_z is −r²
        y_out, x_out = place_out.unbind()
        r_bar = (n * n_bar).addcmul_(met.path, path_bar, value=0.5).addcmul_(dp[0], y_out).addcmul_(dp[1], x_out)
        drift = (v[0] * y_out).addcmul_(v[1], x_out)
        r_bar.addcmul_(drift, q, value=-1)
        # with respect to −q and to −p_z
        less_q_bar = drift.addcmul_(q, path_bar, value=-1)
        kappa_bar = None
        if met.kappa is not None:
            kappa_out = torch.mul(sums_bar[1], r).mul_(h)
            kappa_bar = n * kappa_out
            n_bar.addcmul_(met.kappa, kappa_out)
            r_bar.addcmul_(met.kappa, kappa_bar)
        less_pz_bar = less_q_bar.clone() if self.straight.requires_grad else less_q_bar
        p, turned_bar = dp + p0, None
        if self.turn:
            turn_bar = torch.mul(sums_bar[-1], r).mul_(h).div_(n + pz)
            swept = self._swept(met).mul_(turn_bar)
            less_pz_bar.add_(swept)
            n_bar.sub_(swept)
            r_bar.addcmul_(swept, n + pz)
            turned_bar = torch.stack((-gx, gy)).mul_(turn_bar)
            gradient_bar[0].addcmul_(p[1], turn_bar)
            gradient_bar[1].addcmul_(p[0], turn_bar, value=-1)
        less_pz_bar.addcmul_(r_bar, r).mul_(r)
        n_bar.addcmul_(n, path_bar).addcmul_(n, less_pz_bar, value=-1)
        p_bar = p.mul_(less_pz_bar)
        if turned_bar is not None:
            p_bar.add_(turned_bar)
        return _SlopesPulled(index_bar, kappa_bar, p_bar, less_q_bar, path_bar, place_out)

    def _positions(self, z: float, moving: Tensor) -> tuple[Tensor, Tensor]:
        place, v, _, _ = self._unperturbed
        y, x = torch.add(place, v, alpha=z - self.face).add_(moving[:2]).unbind()
        return y, x

    def _swept(self, met: "Met") -> Tensor:
        """τ' p_z."""
        p = met.dp + self._unperturbed.p
        return (p[1] * met.sampled[1]).addcmul_(p[0], met.sampled[2], value=-1).div_(met.n + met.pz)


class _Unperturbed(NamedTuple):
    """The straight rays' (y, x) where they start, (v_y, v_x), (p_y, p_x) and p_z."""

    place: Tensor
    v: Tensor
    p: Tensor
    pz: Tensor


class Met(NamedTuple):
    """Rays and what they meet at one depth."""

    # δy, δx, δp_y, δp_x
    moving: Tensor
    # δp_y, δp_x
    dp: Tensor
    # Δn, ∂n/∂y, ∂n/∂x
    sampled: Tensor
    kappa: Tensor | None
    n: Tensor
    pz: Tensor
    r: Tensor
    q: Tensor
    # B + |δp|² + q²
    path: Tensor


class _SlopesPulled(NamedTuple):
    """The loss's derivatives with respect to what the slopes are made of.

    sampled: Δn (so also n) and its slopes. kappa: κ, if light is absorbed. p: the momentum. less_q: −q. path:
    B + |δp|² + q². drift: δy' and δx', each times r.
    """

    sampled: Tensor
    kappa: Tensor | None
    p: Tensor
    less_q: Tensor
    path: Tensor
    drift: Tensor


class Pulled(NamedTuple):
    """The loss's derivatives with respect to what a slope depends on.

    moving, straight, background: those of the moving components, the unperturbed rays and n0.
    planes: those of the planes of Δn and, if light is absorbed, of κ.
    A derivative is None if its tensor is not learned.
    """

    moving: Tensor
    straight: Tensor | None
    background: Tensor | None
    planes: list[Tensor | None]
