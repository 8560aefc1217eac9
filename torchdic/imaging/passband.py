"""The few frequencies of an array that a pupil passes, and the coarse array that holds their intensities exactly.

A pupil of aperture NA passes of each source's envelope the frequencies f with |f + f_s| ≤ NA/λ: a disc about −f_s whose
diameter 2·NA/λ is most often much less than what the array holds, 1/dx. All that transfer functions do is done within a
rectangle about that disc. An intensity's frequencies are differences of two in one disc, so that they lie within
±2·NA/λ whatever the source: where voxels are finer than that asks for, intensities are summed on coarser ones and
brought to the array's by trigonometric interpolation, once for all sources. Both are exact.
"""

import math
from dataclasses import dataclass
from typing import cast

import scipy.fft
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from torchdic.grid import Grid

# Of the array's pixels, the most that a window or a coarser array may have to be worth its indices or interpolation.
WORTHWHILE = 0.6

# Part of the pupil's radius by which windows are wider than it, so that rounding loses no frequency at its edge.
_MARGIN = 1e-4


@dataclass(frozen=True, eq=False)
class Passband:
    """A window of each source's spectrum that holds all that a pupil passes.

    indices: of its waves in the flattened array (y, x), in rising order of frequency. frequencies: of its waves, in
    1/µm. shape: of the array (y, x) that holds the intensities of its fields.
    """

    indices: Int[Tensor, "source v u"]
    frequencies: Float[Tensor, "source 2 v u"]
    shape: tuple[int, int]

    @classmethod
    def around(cls, grid: Grid, wavelength: float, na: float, momentum: Float[Tensor, "source 2"]) -> "Passband | None":
        """The window of each source's |λf + p0| ≤ na; None where it would be most of the array."""
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

    def window(self, spectrum: Complex[Tensor, "*component source y x"]) -> Complex[Tensor, "*component source v u"]:
        """Each source's spectrum within its window."""
        # an index keeps less than `gather` does, whose backward pass holds on to the whole spectrum
        sources = torch.arange(len(self.indices), device=spectrum.device)[:, None, None]
        return spectrum.flatten(-2)[..., sources, self.indices]


def sizes(grid: Grid, wavelength: float, na: float) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Shapes (y, x) of a source's window and of the array for its intensities; None where nothing would be gained."""
    ny, nx = grid.shape[1:]
    # whole bins of frequency that lie across the disc at most
    v, u = (min(n, math.floor(2 * r) + 1) for n, r in zip((ny, nx), _radii(grid, wavelength, na), strict=True))
    if v * u > WORTHWHILE * ny * nx:
        return None
    rows, columns = (min(n, cast(int, scipy.fft.next_fast_len(2 * m - 1))) for n, m in ((ny, v), (nx, u)))
    return (v, u), (rows, columns) if rows * columns <= WORTHWHILE * ny * nx else (ny, nx)


def _radii(grid: Grid, wavelength: float, na: float) -> list[float]:
    """Bins of frequency from the disc's middle to its edge, along y and x."""
    return [na * (1 + _MARGIN) * extent / wavelength for extent in grid.extent[1:]]


def interpolate(intensity: Float[Tensor, "*image row column"], shape: tuple[int, int]) -> Float[Tensor, "*image y x"]:
    """Intensities at the pixels of an array of that shape (y, x), the same along an axis or finer.

    Of the trigonometric polynomial through them: exact for frequencies below half of a coarser axis's number of pixels.
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
    # axis by axis, which takes less memory than both at once; what is dark may come out below 0 by rounding
    spectrum = torch.fft.ifft(spectrum, dim=-2, norm="forward")
    return torch.fft.irfft(spectrum, n=nx, norm="forward").clamp_min(0)
