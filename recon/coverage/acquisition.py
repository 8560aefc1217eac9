"""An acquisition that is planned or made: the optics, what is recorded with them, and the noise of it."""

import math
from dataclasses import dataclass, replace

import torch

from recon.coverage.expected import ExpectedSpecimen
from recon.coverage.seen import Coverage, coverage
from recon.fit.setup import Setup, empty_medium
from torchdic import Acquisition, Fidelity, Grid, Microscope, Prism
from torchdic.scalar import number

# Voxels along a side of the field at most. A wider one has no other frequencies, only more of them.
MOST_VOXELS = 64

# Condenser directions. Of two waves near the limits of both apertures few directions hold the one: with 128 frequencies
# there are stated 1.7 times too well (benchmarks/evidence.py gratings).
DIRECTIONS = 512

# Both, where one line is said of what is seen.
ROUGHLY = 32


@dataclass(frozen=True, eq=False)
class NoisyAcquisition:
    """Images that are planned or made.

    grid: of the volume behind them. background: index of the medium. microscope, acquisition: as in `torchdic.image`.
    noise: standard deviation of a pixel behind each prism, relative to the empty bright field.
    """

    grid: Grid
    background: float
    microscope: Microscope
    acquisition: Acquisition
    noise: tuple[float, ...]

    def coverage(self, expected: ExpectedSpecimen, *, roughly: bool = False) -> Coverage:
        """What these images tell of an expected specimen. roughly: with few directions and voxels, in a second."""
        voxels, directions = (ROUGHLY, ROUGHLY) if roughly else (MOST_VOXELS, DIRECTIONS)
        nz, *sides = self.grid.shape
        ny, nx = (min(side, voxels) for side in sides)
        medium = empty_medium(
            Grid((nz, ny, nx), self.grid.spacing), self.background, torch.zeros((), dtype=torch.float64)
        )
        setup = Setup(medium, self.microscope, self.acquisition)
        noise = torch.tensor(self.noise, dtype=torch.float64)[:, None].expand(-1, len(self.acquisition.focus))
        return coverage(setup, noise, Fidelity(sources=directions), expected)

    def with_prisms(self, prisms: list[tuple[Prism | None, float]]) -> "NoisyAcquisition":
        """The recording with other prisms, each with its noise."""
        acquisition = Acquisition([prism for prism, _ in prisms], self.acquisition.focus)
        return replace(self, acquisition=acquisition, noise=tuple(noise for _, noise in prisms))

    def with_focus(self, focus: list[float]) -> "NoisyAcquisition":
        """The recording at other focus planes, µm."""
        return replace(self, acquisition=Acquisition(self.acquisition.prisms, focus))

    @property
    def prisms(self) -> list[tuple[Prism | None, float]]:
        """The prisms, each with its noise."""
        return list(zip(self.acquisition.prisms, self.noise, strict=True))

    @property
    def focus(self) -> list[float]:
        """The focus planes in µm, from the lowest on."""
        return sorted(number(z) for z in self.acquisition.focus)


def shot_noise(level: float, photons: float, read_noise: float = 0.0) -> float:
    """Standard deviation of a pixel, relative to the empty bright field.

    level: intensity of the empty field behind the prism, relative to the bright field. photons: per pixel of the empty
    bright field. read_noise: electrons.
    """
    return math.sqrt(level * photons + read_noise**2) / photons
