"""Straight rays: the specimen's projection along each source's direction, without an ODE.

This is the limit of the ray equations for weak contrast, where dW/dz = √(n² − |p0|²) − p_z0 along the unperturbed ray.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.errors import TurnedRaysError
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.memory.batches import recompute
from torchdic.memory.batches import slabs as ranges
from torchdic.plane_waves import axial_momentum, to_spectrum
from torchdic.propagation.base import Crossing, Propagation, ToSpectrum
from torchdic.specimen.volume import SampledVolume, Volume

# Work of a slice in FFTs of a field, measured on a CPU from 64² to 256² pixels.
SLICE = {"linear": 5.0, "cubic": 90.0}


class Projection(Propagation):
    """Straight rays along each source's direction."""

    name = "projection"
    spreads = False

    def prepare(self, volume: Volume, fidelity: Fidelity, plane: float, *, polarised: bool = False) -> "StraightRays":
        """The straight rays through a volume."""
        return StraightRays(volume.sampled(fidelity.interpolation), plane)

    def work(self, grid: Grid, fidelity: Fidelity, *, absorbs: bool) -> float:
        """Each slice of the index is sampled once, and each slice of the absorption too."""
        return grid.shape[0] * SLICE[fidelity.interpolation] * (2 if absorbs else 1)

    def planned(self) -> Iterable[Fidelity]:
        """The cheapest image."""
        return [Fidelity(self.name)]

    def rungs(self, grid: Grid, margin: int) -> Iterable[tuple[Fidelity, str | None]]:
        """Few sources, and the usual number."""
        return [(Fidelity(self.name, sources=12), None), (Fidelity(self.name), None)]


@dataclass(frozen=True, eq=False)
class StraightRays(Crossing):
    """Straight rays through a volume, seen at depth `plane` (µm)."""

    volume: SampledVolume
    plane: float

    def spectrum(
        self,
        wavelength: float,
        momentum: Float[Tensor, "source 2"],
        *,
        slabs: bool = False,
        to_spectrum: ToSpectrum = to_spectrum,
    ) -> Complex[Tensor, "source 1 y x"]:
        """The spectrum of each source's envelope, see `Crossing.spectrum`."""
        return to_spectrum(project(self.volume, wavelength, momentum, self.plane, slabs=slabs))[:, None]


def project(
    volume: SampledVolume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    plane: float,
    *,
    slabs: bool = False,
) -> Complex[Tensor, "source y x"]:
    """Each source's envelope as seen at depth `plane` (µm).

    volume: sampled.
    wavelength: in vacuum, µm.
    momentum: n·sinθ (y, x) of each source's direction, (source, 2).
    plane: depth in µm.
    slabs: whether the backward pass sums the slices again, slab by slab.
    Raises TurnedRaysError if the index on a ray falls below its transverse momentum.
    """
    grid, n0 = volume.grid, volume.background
    index, *absorption = volume.samplers()
    y, x = (grid.coordinates(axis, dtype=momentum.dtype, device=momentum.device) for axis in (1, 2))
    p0 = momentum[:, None, None, :]
    pz0 = axial_momentum(n0, p0)
    vy, vx = (p0 / pz0[..., None]).unbind(-1)
    wide = (len(momentum), *grid.shape[1:])

    def cross(first: int, last: int, *sums: Tensor) -> tuple[Tensor, ...]:
        for i in range(first, last):
            z = grid.centre(0, i)
            position = (y[:, None] + vy * (z - plane)).expand(wide), (x + vx * (z - plane)).expand(wide)
            delta = index.value(z, *position)
            n = n0 + delta
            pz = axial_momentum(n, p0)
            change = [delta * (n + n0) / (pz + pz0)]
            change += [kappa.value(z, *position) * n / pz for kappa in absorption]
            sums = tuple(s + grid.spacing[0] * c for s, c in zip(sums, change, strict=True))
        return sums

    sums = (momentum.new_zeros(wide),) * len(volume.fields)
    for first, last in ranges(grid.shape[0], split=slabs):
        sums = recompute(cross, first, last, *sums, when=slabs)
    stopped = ~torch.isfinite(sums[0].detach())
    if bool(stopped.any()):
        raise TurnedRaysError.of(stopped)
    k0 = 2 * math.pi / wavelength
    amplitude = torch.ones_like(sums[0]) if len(sums) == 1 else torch.exp(-k0 * sums[1])
    return torch.polar(amplitude, k0 * sums[0])
