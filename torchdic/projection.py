"""Straight rays: the specimen's projection along each source's direction, without an ODE.

It is the limit of the ray equations for weak contrast, where dW/dz = √(n² − |p0|²) − p_z0 along the unperturbed ray.
"""

import math

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.rays import TurnedRaysError, axial_momentum
from torchdic.recompute import recompute, slabs
from torchdic.sampling import SliceSampler, spline_coefficients
from torchdic.volume import Volume


def project(
    volume: Volume, wavelength: float, momentum: Float[Tensor, "source 2"], plane: float, fidelity: Fidelity
) -> Complex[Tensor, "source y x"]:
    """Each source's envelope as seen at depth `plane` (µm).

    Raises TurnedRaysError where the index on a ray falls below its transverse momentum.
    """
    grid, n0 = volume.grid, volume.background
    fields = [volume.delta] if volume.absorption is None else [volume.delta, volume.absorption]
    if fidelity.interpolation == "cubic":
        fields = [spline_coefficients(f) for f in fields]
    samplers = [SliceSampler(grid, f.unbind(0), fidelity.interpolation) for f in fields]

    y, x = (grid.coordinates(axis, dtype=momentum.dtype, device=momentum.device) for axis in (1, 2))
    p0 = momentum[:, None, None, :]
    pz0 = axial_momentum(n0, p0)
    vy, vx = (p0 / pz0[..., None]).unbind(-1)
    wide = (len(momentum), *grid.shape[1:])

    def cross(first: int, last: int, *sums: Tensor) -> tuple[Tensor, ...]:
        for i in range(first, last):
            z = grid.centre(0, i)
            position = (y[:, None] + vy * (z - plane)).expand(wide), (x + vx * (z - plane)).expand(wide)
            delta = samplers[0].value(z, *position)
            n = n0 + delta
            pz = axial_momentum(n, p0)
            change = [delta * (n + n0) / (pz + pz0)]
            if len(samplers) == 2:
                change.append(samplers[1].value(z, *position) * n / pz)
            sums = tuple(s + grid.spacing[0] * c for s, c in zip(sums, change, strict=True))
        return sums

    zero = momentum.new_zeros(wide)
    sums = tuple(zero for _ in samplers)
    steps = grid.shape[0]
    crowded = kept_by_projection(grid, fidelity) * zero.numel() * zero.element_size() > fidelity.memory
    for first, last in slabs(steps, split=crowded):
        sums = recompute(cross, first, last, *sums, when=crowded)
    stopped = ~torch.isfinite(sums[0].detach())
    if bool(stopped.any()):
        raise TurnedRaysError.of(stopped)
    k0 = 2 * math.pi / wavelength
    amplitude = torch.ones_like(sums[0]) if len(sums) == 1 else torch.exp(-k0 * sums[1])
    return torch.polar(amplitude, k0 * sums[0])


def kept_by_projection(grid: Grid, fidelity: Fidelity) -> int:
    """Values per source and pixel that autograd keeps for the backward pass."""
    return 9 * grid.shape[0]
