"""The right-hand side of the ray ODE (see `torchdic.rays`), and its derivative written out by hand.

Autograd would keep every intermediate value: some 27 for each ray and evaluation where the index is linear, 115 where
it is a cubic spline. By hand the backward pass needs the ray's state alone, and samples the index once more. With
p = p0 + δp, n = n0 + Δn, v = p0/p_z0 and r = 1/p_z the slopes are

    δy' = r (δp_y − v_y q),    δp_y' = r n ∂n/∂y,    W' = r (B + |δp|² + q²)/2,
    ∫κ ds: r n κ,    τ' = r (p_x ∂n/∂y − p_y ∂n/∂x)/(n + p_z),

and q, which is formed without cancellation, has the derivative of p_z − p_z0.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.sampling import SliceSampler


@dataclass(frozen=True, eq=False)
class RayEquation:
    """The ODE of many rays at once, in a state of δy, δx, δp_y, δp_x, W, ∫κ ds if light is absorbed, τ if `turn`.

    straight: (7, …), the unperturbed rays' y and x on the first face, v_y, v_x, p_y, p_x and p_z. background: n0, 0-d.
    index, absorption: Δn and κ. face: depth of the first face in µm. Its methods build no graph.
    """

    straight: Float[Tensor, "7 *ray"]
    background: Float[Tensor, ""]
    index: SliceSampler
    absorption: SliceSampler | None
    face: float
    turn: bool

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All that a solution may be differentiated in: straight, background, slices of Δn, slices of κ."""
        kappa = () if self.absorption is None else self.absorption.slices
        return (self.straight, self.background, *self.index.slices, *kappa)

    def start(self) -> Float[Tensor, "component *ray"]:
        """The state on the first face."""
        components = 5 + (self.absorption is not None) + self.turn
        return self.straight.new_zeros(components, *self.straight.shape[1:])

    def slopes(self, z: float, state: Float[Tensor, "component *ray"]) -> Float[Tensor, "component *ray"]:
        """d(state)/dz at depth z."""
        (dpy, dpx), (vy, vx) = state[2:4], self.straight[2:4]
        y, x = self._positions(z, state)
        delta, gy, gx = self.index.sample(z, y, x)
        n, py, px, pz, r, q, path = self._momenta(state, delta)
        bend = n * r
        slopes = torch.empty_like(state)
        torch.addcmul(dpy, vy, q, value=-1, out=slopes[0]).mul_(r)
        torch.addcmul(dpx, vx, q, value=-1, out=slopes[1]).mul_(r)
        torch.mul(gy, bend, out=slopes[2])
        torch.mul(gx, bend, out=slopes[3])
        torch.mul(path, r, out=slopes[4])
        if self.absorption is not None:
            torch.mul(self.absorption.value(z, y, x), bend, out=slopes[5])
        if self.turn:
            torch.mul(px, gy, out=slopes[-1]).addcmul_(py, gx, value=-1).mul_(r).div_(n + pz)
        return slopes

    def pull_back(self, z: float, state: Tensor, slopes_bar: Tensor) -> "Pulled":
        """The loss's derivatives in what `slopes` was made from, given its derivative in the slopes.

        A name that ends in _bar is the loss's derivative in that value.
        """
        (dpy, dpx), (vy, vx) = state[2:4], self.straight[2:4]
        place = [v.requires_grad_() for v in self._positions(z, state)]
        planes = [s.plane(z).requires_grad_() for s in (self.index, self.absorption) if s is not None]
        with torch.enable_grad():
            sampled = [*self.index.sample_plane(planes[0], *place)]
            if self.absorption is not None:
                sampled.append(self.absorption.value_plane(planes[1], *place))
        delta, gy, gx, *kappa = (v.detach() for v in sampled)
        n, py, px, pz, r, q, path = self._momenta(state, delta)

        out = slopes_bar * r
        gy_bar, gx_bar = n * out[2], n * out[3]
        n_bar = (gy * out[2]).addcmul_(gx, out[3])
        # of r, by itself and within p_z: −r² of its own
        r_bar = (n * n_bar).addcmul_(path, out[4]).addcmul_(dpy, out[0]).addcmul_(dpx, out[1])
        drift = (vy * out[0]).addcmul_(vx, out[1])
        r_bar.addcmul_(drift, q, value=-1)
        q_bar = (q * out[4]).sub_(drift)
        kappa_bar = []
        if self.absorption is not None:
            kappa_bar.append(n * out[5])
            n_bar.addcmul_(kappa[0], out[5])
            r_bar.addcmul_(kappa[0], kappa_bar[0])
        pz_bar = q_bar.clone()
        py_bar, px_bar = torch.zeros_like(py), torch.zeros_like(px)
        if self.turn:
            turn_bar = out[-1] / (n + pz)
            area = (px * gy).addcmul_(py, gx, value=-1).mul_(turn_bar)
            r_bar.add_(area)
            area.div_(n + pz)
            n_bar.sub_(area)
            pz_bar.sub_(area)
            px_bar.addcmul_(gy, turn_bar)
            py_bar.addcmul_(gx, turn_bar, value=-1)
            gy_bar.addcmul_(px, turn_bar)
            gx_bar.addcmul_(py, turn_bar, value=-1)
        pz_bar.addcmul_(r_bar, r, value=-1).mul_(r)
        n_bar.addcmul_(n, out[4]).addcmul_(n, pz_bar)
        py_bar.addcmul_(py, pz_bar, value=-1)
        px_bar.addcmul_(px, pz_bar, value=-1)

        y_bar, x_bar, *planes_bar = torch.autograd.grad(sampled, [*place, *planes], [n_bar, gy_bar, gx_bar, *kappa_bar])
        state_bar = torch.zeros_like(state)
        state_bar[0], state_bar[1] = y_bar, x_bar
        torch.addcmul(py_bar, dpy, out[4], out=state_bar[2]).add_(out[0])
        torch.addcmul(px_bar, dpx, out[4], out=state_bar[3]).add_(out[1])
        v_bar = torch.mul(state_bar[:2], z - self.face).addcmul_(out[:2], q, value=-1)
        straight_bar = torch.cat((state_bar[:2], v_bar, torch.stack((py_bar, px_bar, -q_bar))))
        background_bar = n_bar.sum() - self.background * out[4].sum()
        return Pulled(state_bar, straight_bar, background_bar, planes_bar)

    def _positions(self, z: float, state: Tensor) -> tuple[Tensor, Tensor]:
        y, x = torch.add(self.straight[:2], self.straight[2:4], alpha=z - self.face).add_(state[:2])
        return y, x

    def _momenta(self, state: Tensor, delta: Tensor) -> "_Momenta":
        dpy, dpx = state[2:4]
        py0, px0, pz0 = self.straight[4:]
        n, py, px = delta + self.background, dpy + py0, dpx + px0
        pz = (n * n).addcmul_(py, py, value=-1).addcmul_(px, px, value=-1).sqrt_()
        contrast = delta * (n + self.background)
        q = contrast.addcmul(dpy, py + py0, value=-1).addcmul_(dpx, px + px0, value=-1).div_(pz + pz0)
        path = contrast.addcmul_(dpy, dpy).addcmul_(dpx, dpx).addcmul_(q, q).mul_(0.5)
        return _Momenta(n, py, px, pz, pz.reciprocal(), q, path)


class Pulled(NamedTuple):
    """The loss's derivatives in the state, the unperturbed rays, n0, and the planes of Δn and (if any) of κ."""

    state: Tensor
    straight: Tensor
    background: Tensor
    planes: list[Tensor]


class _Momenta(NamedTuple):
    n: Tensor
    py: Tensor
    px: Tensor
    pz: Tensor
    r: Tensor
    q: Tensor
    # (B + |δp|² + q²)/2
    path: Tensor
