"""Which frequencies of Δn the images of an acquisition see better than they are known before.

A weak specimen's images are linear in Δn (`torchdic.linear`): with noise of variance σ² they tell, of each lateral
frequency, A = Σ conj(T)·T/σ² of Δn's cosines along z, beside the variance P that is expected of these. The best linear
estimate then is R·Δn + noise with the resolution operator

    R = (A + P⁻¹)⁻¹A,

and its diagonal is the part of the expected variance that the images take away: 1 is seen, 0 is guessed
(G. Backus and F. Gilbert, Geophys. J. 16, 169, 1968; A. Tarantola, Inverse Problem Theory, SIAM 2005, 3.2).
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from recon.coverage.expected import ExpectedSpecimen, lateral_frequencies
from recon.fit.newton.weak_hessian import axial_band, cosines, waves_of_columns, weak_curvature
from recon.fit.setup import Setup
from torchdic import Fidelity, Grid
from torchdic.scalar import number


@dataclass(frozen=True, eq=False)
class Coverage:
    """What the images of an acquisition tell of a specimen.

    grid: the voxels. power: that is expected of Δn's coefficients, (y, half, cosine), see `ExpectedSpecimen.power`.
    operator: R of the lowest cosines (y, half, low, low). beyond: its diagonal for the others (y, half, high).
    passed: which coefficients the apertures let through (y, half, cosine).
    """

    grid: Grid
    power: Float[Tensor, "y half cosine"]
    operator: Complex[Tensor, "y half low low"]
    beyond: Float[Tensor, "y half high"]
    passed: Bool[Tensor, "y half cosine"]

    @property
    def seen(self) -> Float[Tensor, "y half cosine"]:
        """The part of each coefficient's expected variance that the images take away, 0 to 1."""
        return torch.cat([self.operator.diagonal(dim1=-2, dim2=-1).real, self.beyond], -1)

    @property
    def number(self) -> float:
        """How many of the volume's coefficients are seen: the trace of R."""
        return float((self.seen.sum(-1) * self._counts).sum())

    @property
    def share(self) -> float:
        """`number` over that of all coefficients which the apertures let through, whatever is recorded."""
        return self.number / float((self.passed.sum(-1) * self._counts).sum())

    @property
    def known_before(self) -> float:
        """Root mean square over the voxels of the expected Δn: its standard deviation before the recording."""
        return math.sqrt(float((self.power.sum(-1) * self._counts).sum()) / math.prod(self.grid.shape))

    @property
    def deviation(self) -> float:
        """Root mean square over the voxels of what stays unknown of Δn: the standard deviation after the recording."""
        left = ((1 - self.seen) * self.power).sum(-1) * self._counts
        return math.sqrt(float(left.sum()) / math.prod(self.grid.shape))

    @property
    def explained(self) -> float:
        """The share of the expected variance of Δn that the images explain."""
        return 1 - (self.deviation / self.known_before) ** 2

    @property
    def _counts(self) -> Float[Tensor, " half"]:
        return waves_of_columns(self.grid.shape[2])

    def estimate(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """R·Δn: what the best linear estimate makes of a volume, but for noise."""
        along_z = cosines(self.grid.shape[0])
        spectrum = torch.fft.rfft2(torch.tensordot(along_z, delta.double(), 1)).permute(1, 2, 0)
        low = self.operator.shape[-1]
        told = (self.operator @ spectrum[..., :low, None])[..., 0]
        spectrum = torch.cat([told, self.beyond * spectrum[..., low:]], -1).permute(2, 0, 1)
        return torch.tensordot(along_z.mT, torch.fft.irfft2(spectrum, s=self.grid.shape[1:]), 1)

    def estimate_of_point(self) -> tuple[Float[Tensor, "z y x"], tuple[int, int, int]]:
        """What the best linear estimate makes of a point in the middle of the volume, and the point's voxel."""
        nz, ny, nx = self.grid.shape
        place = nz // 2, ny // 2, nx // 2
        point = torch.zeros(self.grid.shape, dtype=torch.float64)
        point[place] = 1.0
        return self.estimate(point), place


def coverage(
    setup: Setup, noise: Float[Tensor, "prism focus"], fidelity: Fidelity, expected: ExpectedSpecimen
) -> Coverage:
    """What the images of a setup tell of a weak specimen.

    setup: its volume's Δn plays no part. noise: standard deviation of each image's pixels, relative to the empty bright
    field. fidelity: its condenser directions count. expected: of the specimen, beforehand.
    """
    grid = setup.volume.grid
    kept = min(grid.shape[0], axial_band(setup))
    weights = noise.double().reciprocal().square() * math.prod(setup.pixels.shape[1:]) / math.prod(grid.shape[1:])
    matrix, diagonal = weak_curvature(setup, weights, fidelity, kept, fidelity.memory)
    power = expected.power(grid)
    root = power[..., :kept].sqrt()
    told = root[..., None] * matrix * root[..., None, :]
    told = torch.linalg.solve(told + torch.eye(kept), told)  # P^½·A·P^½ commutes with its own inverse
    beyond = diagonal * power[..., kept:]
    operator = root[..., None] * told / root[..., None, :]
    return Coverage(grid, power, operator, beyond / (1 + beyond), _passed(setup, kept))


def cutoff(setup: Setup) -> float:
    """The highest frequency across z that two waves within the apertures can make, 1/µm."""
    microscope, n0 = setup.microscope, number(setup.volume.background)
    lens = n0 if microscope.objective is None else microscope.objective.reach(n0)
    light = 0.0 if microscope.condenser is None else min(microscope.condenser.na, n0)
    return (lens + light) / microscope.wavelength


def _passed(setup: Setup, kept: int) -> Bool[Tensor, "y half cosine"]:
    """The coefficients that two waves within the apertures can make: across z, and the `kept` ones along z."""
    grid = setup.volume.grid
    along_y, along_x = lateral_frequencies(grid)
    across = torch.hypot(along_y[:, None], along_x) <= cutoff(setup)
    return across[..., None] & (torch.arange(grid.shape[0]) < kept)
