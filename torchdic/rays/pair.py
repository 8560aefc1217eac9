"""The linear pair: how a ray's position and momentum change with its momentum at the start.

With Q = ∂x/∂p_s, P = ∂p/∂p_s, g = n∇⊥n and G = ½∇⊥∇⊥n², Hamilton's variational equations of H = −p_z are

    Q' = (P + p kᵀ)/p_z,    P' = (G Q + g kᵀ)/p_z,    k = (Pᵀp − Qᵀg)/p_z²,    Q = 0, P = I at the start.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.rays.equation import MOVING, RayEquation
from torchdic.rays.solver import equal_steps, slopes
from torchdic.rays.trace import Deviation, Flight, Rays, fly
from torchdic.specimen.interpolation import SliceSampler, spline_taps
from torchdic.specimen.volume import SampledVolume

# A state begins with the ray's δy, δx, δp_y, δp_x and W. The elements of Q and P follow.
RAY = MOVING + 1


@dataclass(frozen=True, eq=False)
class LinearPair:
    """A ray at the volume's last face, and the linear pair along it.

    ray: its deviation.
    q, p: Q in µm and P, (…, 2, 2), axes (y, x).
    """

    ray: Deviation
    q: Float[Tensor, "*ray 2 2"]
    p: Float[Tensor, "*ray 2 2"]


def linear_pair(volume: SampledVolume, rays: Rays, fidelity: Fidelity, start: float) -> LinearPair:
    """The linear pair at the volume's last face.

    volume: sampled by a cubic spline, which has second derivatives.
    rays: where they start; only position and momentum are used.
    fidelity: its solver (one of equal steps), steps and memory are used.
    start: depth in µm at which the rays start.
    Raises TurnedRaysError as `deviation` does.
    """
    position, momentum = torch.broadcast_tensors(rays.position, rays.momentum)
    flight = _PairFlight(volume, position, momentum, fidelity, start=start)
    state = fly(flight, fidelity.memory)
    pair = state[RAY:].reshape(2, 2, 2, *flight.shape)
    q, p = (part.movedim((0, 1), (-2, -1)) for part in pair)
    return LinearPair(flight.deviation(state), q, p)


class _PairFlight(Flight):
    """Rays on their way through a volume, each with its linear pair."""

    def beginning(self) -> Tensor:
        """The state at the start: no deviation, Q = 0 and P = I."""
        state = torch.cat((super().beginning(), self.straight.new_zeros(8, *self.straight.shape[1:])))
        state[RAY + 4] = state[RAY + 7] = 1.0
        return state

    def advance(self, first: int, last: int, state: Tensor) -> Tensor:
        """The state after steps first … last − 1."""
        equation, depths = self.equation(first, last)
        index = equation.index
        sampler = _CurvedSampler(index.grid, index.slices, index.interpolation, index.first)

        def change(z: float, state: Tensor) -> Tensor:
            of_ray, sampled = slopes(equation, z, state[:RAY])
            return torch.cat((of_ray, _pair_slopes(equation, sampler, z, state, sampled)))

        return equal_steps(change, state, depths, self.fidelity.solver)


def _pair_slopes(equation: RayEquation, sampler: "_CurvedSampler", z: float, state: Tensor, sampled: Tensor) -> Tensor:
    """Q' and P' of the module's head, (8, …); sampled: Δn and its derivatives where the rays are."""
    straight, gradient = equation.straight, sampled[1:]
    y, x = straight[:2] + (z - equation.face) * straight[2:4] + state[:2]
    yy, yx, xx = sampler.curvature(z, y, x)
    n, p = equation.background + sampled[0], straight[4:6] + state[2:MOVING]
    pz = (n * n - p.square().sum(0)).sqrt()
    g = n * gradient
    bend = n * torch.stack((yy, yx, yx, xx)).unflatten(0, (2, 2)) + gradient[:, None] * gradient[None]
    Q, P = (part.unflatten(0, (2, 2)) for part in state[RAY:].split(4))
    k = ((p[:, None] * P).sum(0) - (g[:, None] * Q).sum(0)) / (pz * pz)
    of_place = (P + p[:, None] * k) / pz
    of_momentum = ((bend[:, :, None] * Q[None]).sum(1) + g[:, None] * k) / pz
    return torch.cat((of_place.flatten(0, 1), of_momentum.flatten(0, 1)))


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
