"""The split-step solution of the one-way wave equation on the envelope of each source."""

import math
import warnings
from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.errors import SlabWarning, UnstableError
from torchdic.fidelity import Fidelity
from torchdic.memory.batches import replay
from torchdic.memory.batches import slabs as ranges
from torchdic.plane_waves import axial_difference, axial_momentum, exp_i
from torchdic.propagation.slab import Screens, Slab, cross_slab
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# Smallest p_z in the factor 1/p_z, which is unbounded for waves that graze the slices. On exact fields of sharp beads
# the errors are alike for floors from 0.1 to 0.4 (benchmarks/exact_fields.py). A lower floor needs thinner slabs where
# the index has strong steps.
LOWEST_PZ = 0.3

# Largest energy behind the volume, over the energy that came in. A specimen makes no energy, so any more comes from the
# slabs.
MOST_ENERGY = 1.1

# Smallest energy behind the volume, over the energy that came in, if nothing absorbs. Slabs that lose more lose it
# to waves that they cut.
LEAST_ENERGY = 0.9

# Screens are shared where there are at most so many for each source. Otherwise few sources would be computed at a time.
MOST_SCREENS = 0.5


def split_step(
    volume: Volume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    fidelity: Fidelity,
    *,
    slabs: bool = False,
) -> Complex[Tensor, "source y x"]:
    """Spectrum of each source's envelope on the volume's last face, (source, y, x).

    volume: with its padding.
    wavelength: in vacuum, µm.
    momentum: n·sinθ (y, x) of each source's direction, (source, 2).
    fidelity: its steps and order are used.
    slabs: whether the backward pass computes the steps again, slab by slab.

    The textbook's phase screen k0·Δn·dz is wrong for oblique light, because the effect of Δn depends on the angle after
    scattering as well as before. With B = n² − n0² the one-way kernel is B/(p_z(f) + p_z(f')). Here the screen is φ =
    k0 dz B/(√(n² − |p0|²) + p_z0), which is exact for a slab along the source. What it scatters is multiplied by G² =
    p_z0/p_z(f + f_s), to first or second order in φ: see `torchdic.propagation.slab`.

    Raises UnstableError if the slabs are so thick that this makes energy, or if the index falls below a source's |p0|.
    Warns with SlabWarning if the slabs lose energy although nothing absorbs.
    """
    steps = fidelity.steps or volume.grid.shape[0]
    dz = volume.grid.extent[0] / steps
    k0, n0 = 2 * math.pi / wavelength, volume.background
    slices = [*volume.delta.unbind(0), *(() if volume.absorption is None else volume.absorption.unbind(0))]
    count = len(volume.delta)

    difference, pz = axial_difference(volume.grid, wavelength, n0, momentum)
    H = torch.where(pz > 0, exp_i(k0 * dz / 2 * difference), 0)
    pz0 = axial_momentum(n0, momentum)[:, None, None]
    # 0 removes what a screen scatters into evanescent waves, before the next half of the screen can scatter it back
    squared_gain = torch.where(pz > 0, pz0 / pz.clamp_min(LOWEST_PZ), 0)
    g = (squared_gain if fidelity.order == 1 else squared_gain - 1).to(H.dtype)
    square, screens = _screens(momentum, n0)
    pz0 = (n0**2 - square).sqrt()[:, None, None]
    slab = Slab(fidelity.order, k0 * dz, screens)

    def cross(
        first: int, last: int, V: Tensor, H: Tensor, g: Tensor, pz0: Tensor, n0: Tensor, *slices: Tensor
    ) -> Tensor:
        HH = H * H
        for step in range(first, last):
            n = n0 + slab_mean(slices[:count], step, steps)
            B = (n - n0) * (n + n0)
            if len(slices) > count:
                kappa = slab_mean(slices[count:], step, steps)
                B = torch.complex(B - kappa**2, 2 * n * kappa)
            V = cross_slab(slab, B, pz0, V, H if step == steps - 1 else HH, g)
        return V

    S = torch.zeros_like(H)
    S[:, 0, 0] = 1
    for first, last in ranges(steps, split=slabs):
        S = replay(partial(cross, first, last), S, H, g, pz0, n0, *slices, when=slabs)
    _check_energy(S.detach(), pz, volume, momentum, steps)
    return S


def _screens(momentum: Tensor, n0: Tensor) -> tuple[Tensor, Screens]:
    """|p0|² of each screen, (screen,), and how many consecutive sources share it.

    A screen depends on a source's |p0| alone, which is the same all along a ring of the condenser, but for rounding.
    """
    square = momentum.square().sum(-1)
    if momentum.requires_grad or square.device.type != "cpu":  # to find rings elsewhere would make the program wait
        return square, None
    rounding = 16 * torch.finfo(square.dtype).eps * number(n0) ** 2
    _, counts = (square / rounding).round().unique_consecutive(return_counts=True)
    if len(counts) > len(square) * MOST_SCREENS:
        return square, None
    return square[counts.cumsum(0) - 1], counts.tolist()


@torch.no_grad()
def _check_energy(S: Tensor, pz: Tensor, volume: Volume, momentum: Tensor, steps: int) -> None:
    """Check the energy Σ p_z|S|² of each source's waves, which is p_z0 in front of the specimen.

    It grows if a slab scatters more than there is. It falls if a slab scatters into evanescent waves, which carry none.
    """
    flux = (pz * torch.view_as_real(S).square().sum(-1)).sum((1, 2))
    least, most = torch.stack(torch.aminmax(flux / axial_momentum(volume.background, momentum))).tolist()
    lossless = volume.absorption is None
    if most <= MOST_ENERGY and (least >= LEAST_ENERGY or not lossless):
        return
    low, high = (float(v) + 0.0 for v in torch.aminmax(volume.delta))  # −0 is 0
    lowest, oblique = number(volume.background) + low, float(momentum.norm(dim=-1).max())
    thickness = volume.grid.extent[0] / steps
    if not math.isfinite(most) and lowest <= oblique:
        raise UnstableError(
            f"light of n·sinθ {oblique:.6g} can't go on toward +z: inside the volume the index falls to {lowest:.6g}"
        )
    if not most <= MOST_ENERGY:
        raise UnstableError(
            f"slabs of {thickness:g} µm are too thick for Δn from {low:.3g} to {high:.3g}: behind "
            f"them the wave has {most:.3g} times the energy that came in; use more than {steps} steps"
        )
    warnings.warn(
        SlabWarning(
            f"slabs of {thickness:g} µm are too thick for Δn from {low:.3g} to {high:.3g}: behind them the wave has "
            f"{least:.3g} times the energy that came in, and nothing absorbs; use more than {steps} steps",
            severity=1 - least,
        ),
        stacklevel=3,  # torch.no_grad adds a call
    )


def slab_mean(slices: Sequence[Tensor], step: int, steps: int) -> Tensor:
    """The mean of a field over slab number `step` of `steps` equal slabs. slices: the field's, in order."""
    n = len(slices)
    first, last = step * n // steps, -(-(step + 1) * n // steps)
    if last - first == 1:
        return slices[first]
    # in units in which a slice is `steps` long and a slab n, so that overlaps are whole numbers
    overlaps = [min((step + 1) * n, (i + 1) * steps) - max(step * n, i * steps) for i in range(first, last)]
    total: Tensor = sum(o * slices[first + i] for i, o in enumerate(overlaps))  # pyright: ignore[reportAssignmentType]
    return total / n
