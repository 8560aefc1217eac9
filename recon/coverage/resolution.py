"""Resolution: how wide the best linear estimate of a point is."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import map_coordinates
from torch import Tensor

from recon.coverage.expected import lateral_frequencies
from recon.coverage.seen import Coverage

# Angles across z at which a point's width is taken, in degrees.
ANGLES = range(0, 180, 15)
# Places to a voxel at which a profile is looked at.
FINE = 20


@dataclass(frozen=True)
class Resolution:
    """Full widths at half of the maximum of the estimate of a point, µm.

    axial: along z. finest, coarsest: across z, along the best and the worst direction. direction: of the coarsest, in
    degrees from right towards down. infinite where the response doesn't fall to its half within the volume.
    """

    axial: float
    finest: float
    coarsest: float
    direction: float


def resolution_of(coverage: Coverage) -> Resolution:
    """The widths of the response to a point in the middle of the volume."""
    return widths(*coverage.estimate_of_point(), coverage.grid.spacing)


def finest_along_z(coverage: Coverage, period: float) -> float | None:
    """The shortest period along z, in µm, that is seen of gratings whose period across z is as given, in µm.

    It is seen where R's diagonal, averaged over the grating's directions across z, is at least one half. None where no
    period is, infinity where only what doesn't change along z is.
    """
    grid = coverage.grid
    along_y, along_x = lateral_frequencies(grid)
    step = max(1 / (n * d) for n, d in zip(grid.shape[1:], grid.spacing[1:], strict=True))
    ring = (torch.hypot(along_y[:, None], along_x) - 1 / period).abs() <= step / 2
    if not bool(ring.any()):
        return None
    seen = torch.nonzero(coverage.seen[ring].mean(0) >= 0.5).flatten()
    if len(seen) == 0:
        return None
    highest = int(seen[-1])
    return math.inf if highest == 0 else 2 * grid.extent[0] / highest


def widths(
    response: Float[Tensor, "z y x"], place: tuple[int, int, int], spacing: tuple[float, float, float]
) -> Resolution:
    """The widths of a point's response about its place. spacing: of the voxels (z, y, x), µm."""
    values, (z, y, x) = response.numpy(), place
    axial = width(values[:, y, x], z) * spacing[0]
    finest = min(spacing[1:])
    reach = max(int(min(y * spacing[1], x * spacing[2]) / finest - 1), 0)
    steps = np.arange(-reach, reach + 1)
    across = []
    for angle in ANGLES:
        down, right = math.sin(math.radians(angle)) * finest, math.cos(math.radians(angle)) * finest
        at = [y + steps * down / spacing[1], x + steps * right / spacing[2]]
        across.append(width(map_coordinates(values[z], at, order=3, mode="grid-wrap"), reach) * finest)
    return Resolution(axial, min(across), max(across), float(ANGLES[int(np.argmax(across))]))


def width(profile: NDArray[np.floating], middle: int) -> float:
    """Full width of a profile at half of its middle's value, in its steps; infinite where it doesn't fall so far."""
    if len(profile) == 1:
        return math.inf
    at = np.arange((len(profile) - 1) * FINE + 1) / FINE
    fine = CubicSpline(np.arange(len(profile)), profile)(at)
    centre = middle * FINE
    below = np.flatnonzero(fine <= fine[centre] / 2)
    left, right = below[below < centre], below[below > centre]
    if len(left) == 0 or len(right) == 0:
        return math.inf
    return float(at[right[0]] - at[left[-1]])
