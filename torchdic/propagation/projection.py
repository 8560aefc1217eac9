"""Straight rays: the specimen's projection along each source's direction, without an ODE.

It is the limit of the ray equations for weak contrast, where dW/dz = √(n² − |p0|²) − p_z0 along the unperturbed ray.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import Fidelity
from torchdic.memory.batches import Demand, indices, recompute, slabs
from torchdic.plane_waves import axial_momentum
from torchdic.specimen.interpolation import SliceSampler
from torchdic.specimen.volume import Volume


def project(
    volume: Volume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    plane: float,
    fidelity: Fidelity,
    fields: Sequence[Float[Tensor, "z y x"]] | None = None,
) -> Complex[Tensor, "source y x"]:
    """Each source's envelope as seen at depth `plane` (µm).

    fields: `Volume.sampled`, where it serves several calls.
    Raises TurnedRaysError where the index on a ray falls below its transverse momentum.
    """
    grid, n0 = volume.grid, volume.background
    fields = fields or volume.sampled(fidelity.interpolation)
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
    crowded = demand_of_projection(volume, fidelity).whole * zero.numel() * zero.element_size() > fidelity.memory
    for first, last in slabs(steps, split=crowded):
        sums = recompute(cross, first, last, *sums, when=crowded)
    stopped = ~torch.isfinite(sums[0].detach())
    if bool(stopped.any()):
        raise TurnedRaysError.of(stopped)
    k0 = 2 * math.pi / wavelength
    amplitude = torch.ones_like(sums[0]) if len(sums) == 1 else torch.exp(-k0 * sums[1])
    return torch.polar(amplitude, k0 * sums[0])


def demand_of_projection(volume: Volume, fidelity: Fidelity) -> Demand:
    """What `project` holds; measured by `python benchmarks/memory.py`."""
    absorbs, index = volume.absorption is not None, indices(volume.delta.dtype)
    steps = volume.grid.shape[0]
    if fidelity.interpolation == "linear":
        return Demand(10 + 2 * absorbs, 4 + absorbs, 10, steps, 8 + 2 * absorbs, 10, 1 + absorbs, shared=1)
    # a spline's 16 voxels, their places and weights
    working = 43 + 8 * index + 44 * absorbs
    step = 14 + 16 * index + 2 * absorbs
    return Demand(64 + 24 * index + 2 * absorbs, 4 + absorbs, working, steps, step, working, 1 + absorbs)
