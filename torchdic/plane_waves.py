"""Fields as sums of plane waves: their spectra, and the momenta of the waves along z.

Each source's field is represented by its envelope, which is the field without the source's tilt. The envelope's
frequency f belongs to the field's frequency f + f_s, with f_s = p0/λ. The envelope of an unperturbed plane wave is 1.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.grid import Grid


def axial_difference(
    grid: Grid,
    wavelength: float,
    background: Tensor,
    momentum: Float[Tensor, "source 2"],
    frequencies: Float[Tensor, "*source 2 y x"] | None = None,
) -> tuple[Float[Tensor, "source y x"], Float[Tensor, "source y x"]]:
    """p_z(f + f_s) − p_z0 and p_z(f + f_s) of each source's waves, (source, y, x); p_z is 0 if a wave is evanescent.

    grid: of the field.
    wavelength: in vacuum, µm.
    background: the index n0, 0-d.
    momentum: n·sinθ (y, x) of each source's direction, (source, 2).
    frequencies: f in 1/µm, (2, y, x) or (source, 2, y, x). None is all frequencies of the grid.
    The difference is computed without cancellation, so float32 keeps the phase of a long path.
    """
    deflection = wavelength * _frequencies(grid, momentum, frequencies)
    p0 = momentum[:, :, None, None]
    pz0 = axial_momentum(background, momentum)[:, None, None]
    squared = background**2 - (p0 + deflection).square().sum(1)
    propagates = squared > 0
    # the inner where keeps the square root's infinite slope at 0 out of the gradient
    pz = torch.where(propagates, torch.where(propagates, squared, 1).sqrt(), 0)
    return -(deflection * (deflection + 2 * p0)).sum(1) / (pz + pz0), pz


def paraxial_difference(
    grid: Grid,
    wavelength: float,
    background: Tensor,
    momentum: Float[Tensor, "source 2"],
    frequencies: Float[Tensor, "*source 2 y x"] | None = None,
) -> Float[Tensor, "source y x"]:
    """p_z − p_z0 to second order in the momenta p at f + f_s: −(|p|² − |p0|²)/(2n0).

    The arguments are those of `axial_difference`.
    """
    deflection = wavelength * _frequencies(grid, momentum, frequencies)
    return -(deflection * (deflection + 2 * momentum[:, :, None, None])).sum(1) / (2 * background)


def _frequencies(grid: Grid, momentum: Tensor, given: Tensor | None) -> Tensor:
    return grid.frequencies(dtype=momentum.dtype, device=momentum.device) if given is None else given


def exp_i(phase: Tensor) -> Tensor:
    """exp(i·phase). The phase is real, or complex if light is absorbed."""
    if phase.is_complex():  # five times as fast as torch.exp of a complex number
        return exp_i(phase.real) * torch.exp(-phase.imag)
    return _ExpI.apply(phase)  # pyright: ignore[reportReturnType]


class _ExpI(torch.autograd.Function):
    """exp(i·phase) of a real phase, five times as fast as torch.polar on the CPU. It keeps only its result."""

    @staticmethod
    def forward(ctx: Any, phase: Tensor) -> Tensor:
        result = torch.complex(phase.cos(), phase.sin())
        ctx.save_for_backward(result)
        return result

    @staticmethod
    def backward(ctx: Any, result_bar: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        (result,) = ctx.saved_tensors
        return result.real * result_bar.imag - result.imag * result_bar.real


def to_spectrum(field: Tensor) -> Tensor:
    """Amplitudes of the plane waves that make up a field (…, y, x). A field of 1 has the amplitude 1 at f = 0."""
    return torch.fft.fft2(field, norm="forward")


def to_field(spectrum: Tensor, shape: tuple[int, int] | None = None) -> Tensor:
    """The field (…, y, x) of a spectrum. shape: the field's (y, x), to which zeros are appended to the spectrum."""
    return torch.fft.ifft2(spectrum, s=shape, norm="forward")


def axial_momentum(background: Float[Tensor, " *#ray"], momentum: Float[Tensor, "*#ray 2"]) -> Float[Tensor, " *#ray"]:
    """p_z = √(n0² − |p|²) in the index n0."""
    return (background**2 - momentum.square().sum(-1)).sqrt()
