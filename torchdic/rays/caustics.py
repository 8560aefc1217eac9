"""Caustics inside the specimen: how many each ray tube passes on its way from the first face to the last.

Along a ray, Q = ∂x/∂x0 and P = ∂p/∂x0 begin as I and 0 and obey Hamilton's linearised equations:

    Q' = H_px Q + H_pp P,    P' = −H_xx Q − H_xp P,    H = −√(n² − |p|²).

A caustic is a zero of det Q. It changes the phase by −π/2 (Maslov). Where two caustics coincide, as in the focus of a
round lens, det Q does not change its sign. But det(Q + iηP), with any length η > 0, never vanishes, and its argument
falls smoothly by π with each caustic. After N caustics the argument lies between −(N + 1)π and −(N − 1)π, and det Q has
the sign of (−1)^N (Littlejohn, Phys. Rep. 138, 193 (1986)). Both together give N.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchdic.grid import Grid
from torchdic.scalar import number
from torchdic.specimen.interpolation import window
from torchdic.specimen.volume import SampledVolume


class Tubes:
    """The tubes between neighbouring rays of each source, two triangles per cell, followed from step to step.

    grid: its voxels give the distances between rays on the first face.
    eta: η in µm. A tube's argument must change by less than π in a step. This holds if η is of the order of 1/√(n|∇∇n|)
        and a step is shorter than n·η.
    """

    def __init__(self, grid: Grid, eta: float) -> None:
        self._spacing, self._eta = grid.spacing[1:], eta
        # on the first face Q = I and P = 0
        self._area = self._tube = torch.ones(())
        self._argument = torch.zeros(())

    @torch.no_grad()
    def __call__(self, state: Float[Tensor, "4 source y x"]) -> None:
        """Follow the tubes through one more step. state: (δy, δx, δp_y, δp_x) of the rays after it."""
        # one more ring of cells around the outermost rays, with rays that deviate as those do
        state = F.pad(state, (1, 1, 1, 1), mode="replicate")
        y, x = torch.complex(state[:2], self._eta * state[2:])
        # edges from ray to ray along x and along y, each with its components (y, x)
        dy, dx = self._spacing
        along_x, along_y = (y.diff(dim=2), dx + x.diff(dim=2)), (dy + y.diff(dim=1), x.diff(dim=1))
        self._area = _areas([v.real for v in along_x], [v.real for v in along_y])
        tube = _areas(along_x, along_y)
        self._argument = self._argument + (tube * self._tube.conj()).angle()
        self._tube = tube

    def passed(self) -> Float[Tensor, "source row column 2"]:
        """The number of caustics that each triangle has passed so far, (source, row, column, 2).

        A cell with the corners a, b above c, d has the triangles (a, b, c) and (d, c, b). The cells are those between
        the rays, and one ring around them.
        """
        odd = (self._area < 0).to(self._argument)
        return odd + 2 * ((-self._argument / math.pi - odd) / 2).round()


@torch.no_grad()
def tubes_that_may_fold(volume: SampledVolume, momentum: Float[Tensor, "source 2"]) -> Tubes | None:
    """Tubes to follow through the volume; None if it is proven that the volume contains no caustic.

    volume: sampled.
    momentum: n·sinθ (y, x) of each source's direction.
    S = PQ⁻¹ obeys S' = −H_xx − H_xp S − S H_px − S H_pp S. So |S| is at most the solution of s' = c + 2a s + b s²,
    where a, b, c are bounds of |H_px|, |H_pp|, |H_xx| in each slice. With s = p/q this becomes q' = −a q − b p, p' = c
    q + a p, from q = 1, p = 0. While q > 0, S is finite and Q has an inverse, so there is no caustic. Behind a thin
    lens q stays above 0 up to the focus itself.
    """
    grid, n0 = volume.grid, number(volume.background)
    slices = torch.stack([_bounds(s, grid) for s in volume.fields[0]]).to("cpu", torch.float64)
    faces = [grid.centre(0, i - 0.5) for i in range(grid.shape[0] + 1)]
    seen = [window(grid, *ends, volume.interpolation) for ends in pairwise(faces)]
    lowest, highest, gradient, curvature = torch.stack([slices[s].amax(0) for s in seen]).unbind(1)
    if not bool(curvature.any()):
        return None

    n, n_min, dz = n0 + highest, n0 - lowest, grid.spacing[0]
    tubes = Tubes(grid, 1 / math.sqrt(n0 * float(curvature.max())))
    # |p|' ≤ n|∇n|/p_z: a lower bound of p_z gives an upper bound p of |p|, and p gives a closer lower bound of p_z
    start = float(momentum.norm(dim=-1).max())
    pz = (n_min.square() - start**2).clamp_min(0).sqrt() / 2
    p = start + (n * gradient / pz).cumsum(0) * dz
    if not bool((p.square() + pz.square() <= n_min.square()).all()):
        return tubes
    for _ in range(2):
        pz = (n_min.square() - p.square()).sqrt()
        p = start + (n * gradient / pz).cumsum(0) * dz
    a = p * n * gradient / pz**3
    b = n**2 / pz**3
    c = (gradient**2 + n * curvature) / pz + n**2 * gradient**2 / pz**3
    pair = torch.tensor([1.0, 0.0], dtype=torch.float64)
    for through in torch.linalg.matrix_exp(dz * torch.stack((-a, -b, c, a), -1).unflatten(-1, (2, 2))):
        pair = through @ pair
        if not float(pair[0]) > 0:
            return tubes
    return None


def _areas(along_x: Sequence[Tensor], along_y: Sequence[Tensor]) -> Tensor:
    """Twice the areas of both triangles of each cell. along_x, along_y: the cell's edges, with components (y, x)."""
    near, far = slice(None, -1), slice(1, None)
    return torch.stack(
        [along_x[1][:, i] * along_y[0][:, :, i] - along_x[0][:, i] * along_y[1][:, :, i] for i in (near, far)], -1
    )


def _bounds(field: Float[Tensor, "y x"], grid: Grid) -> Float[Tensor, "4"]:
    """Bounds of −f, f, |∇f| and |∇∇f| in one slice.

    field: voxels, for linear interpolation between them, or spline coefficients. Between these values f is a mean of
    the values, its slope is a mean of their differences, and its curvature is a mean of their second differences.
    """
    _, dy, dx = grid.spacing
    y, x = field.diff(dim=0) / dy, field.diff(dim=1) / dx

    def largest(values: Tensor) -> Tensor:
        return values.abs().max() if values.numel() else values.new_zeros(())

    def second(slope: Tensor, axis: int) -> Tensor:
        # mirrored at the ends, as splines are; linear interpolation ends flat, so it bends half as much there
        first, last = (slope.narrow(axis, i, min(slope.shape[axis], 1)) for i in (0, max(slope.shape[axis] - 1, 0)))
        return torch.cat((-first, slope, -last), axis).diff(dim=axis)

    yy, yx, xx = largest(second(y, 0)) / dy, largest(x.diff(dim=0)) / dy, largest(second(x, 1)) / dx
    slope = torch.hypot(largest(y), largest(x))
    return torch.stack((-field.min(), field.max(), slope, torch.maximum(yy, xx) + yx))
