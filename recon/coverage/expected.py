"""The specimen that is expected before anything is recorded: structures of one contrast and one size, with sharp edges.

Two phases that fill space at random have the autocorrelation exp(−r/a) (P. Debye, H. R. Anderson and H. Brumberger,
J. Appl. Phys. 28, 679, 1957), whatever the shapes of their parts. So the power of Δn falls with frequency as
8πa³/(1 + (2πaf)²)², as that of beads and cells does.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic import Grid


def lateral_frequencies(grid: Grid) -> tuple[Float[Tensor, " y"], Float[Tensor, " half"]]:
    """Frequencies of waves along y and x, as of a real FFT, in 1/µm."""
    (_, ny, nx), (_, dy, dx) = grid.shape, grid.spacing
    return torch.fft.fftfreq(ny, dy, dtype=torch.float64), torch.fft.rfftfreq(nx, dx, dtype=torch.float64)


@dataclass(frozen=True)
class ExpectedSpecimen:
    """What is known of a specimen beforehand.

    contrast: Δn between its structures and what lies around them. size: a of exp(−r/a), µm; a ball's is three eighths
    of its diameter.
    Raises ValueError where one isn't above 0.
    """

    contrast: float = 0.02
    size: float = 1.0

    def __post_init__(self) -> None:
        for name, value in (("contrast", self.contrast), ("size", self.size)):
            if not (0 < value < math.inf):
                raise ValueError(f"{name} {value} must be above 0")

    def power(self, grid: Grid) -> Float[Tensor, "y half cosine"]:
        """Variance of Δn's orthonormal coefficients: cosines along z, waves along y and x as of a real FFT; float64.

        Half of space is structure, so that Δn varies by half of the contrast.
        """
        nz, (dz, dy, dx) = grid.shape[0], grid.spacing
        along_y, along_x = lateral_frequencies(grid)
        along_z = torch.arange(nz, dtype=torch.float64) / (2 * nz * dz)
        squared = along_y[:, None, None] ** 2 + along_x[:, None] ** 2 + along_z**2
        density = 8 * math.pi * self.size**3 / (1 + (2 * math.pi * self.size) ** 2 * squared) ** 2
        return (self.contrast / 2) ** 2 * density / (dz * dy * dx)
