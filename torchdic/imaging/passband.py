"""The few frequencies of an array that a pupil passes, and the coarse array that holds their intensities exactly.

A pupil of aperture NA passes those frequencies f of a source's envelope for which |f + f_s| ≤ NA/λ. They fill a disc
about −f_s of diameter 2·NA/λ, most often much less than the array holds, 1/dx. Pupil, defocus and prism are computed
in a rectangle about that disc only. An intensity's frequencies are differences of two frequencies of one disc: they lie
within ±2·NA/λ, whatever the source. Where the voxels are finer than this needs, intensities are summed on a coarser
array, and trigonometric interpolation brings the sum to the voxels, once for all sources. Both steps are exact.
"""

import math
from dataclasses import dataclass
from typing import cast

import scipy.fft
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from torchdic.grid import Grid

# A window or a coarser array of more than this part of the array's pixels isn't worth its indices or interpolation.
WORTHWHILE = 0.6

# Windows are wider than the pupil by this part of its radius, so that rounding loses no frequency at its edge.
_MARGIN = 1e-4


@dataclass(frozen=True, eq=False)
class Passband:
    """A window of each source's spectrum that holds all frequencies that a pupil passes.

    indices: of the window's waves in the flattened array (y, x), in rising order of frequency.
    frequencies: of the window's waves, in 1/µm.
    shape: of the array (y, x) that holds the intensities of the window's fields.
    """

    indices: Int[Tensor, "source v u"]
    frequencies: Float[Tensor, "source 2 v u"]
    shape: tuple[int, int]

    @classmethod
    def around(cls, grid: Grid, wavelength: float, na: float, momentum: Float[Tensor, "source 2"]) -> "Passband | None":
        """The window about |λf + p0| ≤ na of each source; None where it would be most of the array."""
        found = sizes(grid, wavelength, na)
        if found is None:
            return None
        widths, shape = found
        radii, (_, ny, nx) = _radii(grid, wavelength, na), grid.shape
        rows, columns = (
            torch.ceil(-momentum[:, axis].detach().double() * grid.extent[1 + axis] / wavelength - radii[axis]).long()
            for axis in (0, 1)
        )
        rows, columns = (
            (first[:, None] + torch.arange(width, device=first.device)).remainder(n)
            for first, width, n in zip((rows, columns), widths, (ny, nx), strict=True)
        )
        indices = rows[:, :, None] * nx + columns[:, None, :]
        frequencies = grid.frequencies(dtype=momentum.dtype, device=momentum.device).flatten(1)[:, indices]
        return cls(indices, frequencies.movedim(0, 1), shape)

    def window(self, spectrum: Complex[Tensor, "source component y x"]) -> Complex[Tensor, "source component v u"]:
        """Each source's spectrum within its window."""
        # indexing keeps less for the backward pass than `gather`, which keeps the whole spectrum
        sources = torch.arange(len(self.indices), device=spectrum.device)[:, None, None]
        return spectrum.flatten(-2).movedim(1, 0)[..., sources, self.indices].movedim(0, 1)


def sizes(grid: Grid, wavelength: float, na: float) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Shapes (y, x) of a source's window and of the array for its intensities; None where a window gains nothing."""
    ny, nx = grid.shape[1:]
    # the most whole bins of frequency that fit across the disc
    v, u = (min(n, math.floor(2 * r) + 1) for n, r in zip((ny, nx), _radii(grid, wavelength, na), strict=True))
    if v * u > WORTHWHILE * ny * nx:
        return None
    rows, columns = (min(n, cast(int, scipy.fft.next_fast_len(2 * m - 1))) for n, m in ((ny, v), (nx, u)))
    return (v, u), (rows, columns) if rows * columns <= WORTHWHILE * ny * nx else (ny, nx)


def _radii(grid: Grid, wavelength: float, na: float) -> list[float]:
    """The disc's radius in bins of frequency, along y and x."""
    return [na * (1 + _MARGIN) * extent / wavelength for extent in grid.extent[1:]]


def interpolate(intensity: Float[Tensor, "*image row column"], shape: tuple[int, int]) -> Float[Tensor, "*image y x"]:
    """Intensities on an array of as many or more pixels, by trigonometric interpolation.

    intensity: (…, row, column), periodic.
    shape: of the new array (y, x), along no axis smaller.

    Exact for frequencies below half of the number of pixels along each axis that gets finer.
    """
    (rows, columns), (ny, nx) = intensity.shape[-2:], shape
    if (rows, columns) == (ny, nx):
        return intensity
    spectrum = torch.fft.rfft2(intensity, norm="forward")
    if columns < nx:
        spectrum = spectrum[..., : (columns + 1) // 2]
    if rows < ny:
        half = (rows - 1) // 2
        nothing = spectrum.new_zeros(*spectrum.shape[:-2], ny - 2 * half - 1, spectrum.shape[-1])
        spectrum = torch.cat((spectrum[..., : half + 1, :], nothing, spectrum[..., rows - half :, :]), -2)
    # axis by axis, which takes less memory than both at once; rounding may bring dark pixels below 0
    spectrum = torch.fft.ifft(spectrum, dim=-2, norm="forward")
    return torch.fft.irfft(spectrum, n=nx, norm="forward").clamp_min(0)
