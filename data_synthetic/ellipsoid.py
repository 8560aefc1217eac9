"""Ellipsoids, the shape of beads and organelles."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from data_synthetic.fill import covered_fraction, require_subpixels
from data_synthetic.specimen import require_above_zero, require_vector
from torchdic.grid import Grid


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid whose axes lie along z, y and x.

    semi_axes: (z, y, x) in µm.
    centre: (z, y, x) in µm.
    Raises ValueError for a semi-axis not above 0 or a centre that is not finite.
    """

    semi_axes: tuple[float, float, float]
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require_vector("semi_axes", self.semi_axes, "z, y, x")
        require_vector("centre", self.centre, "z, y, x")
        for axis, length in zip("zyx", self.semi_axes, strict=True):
            require_above_zero(f"semi-axis along {axis}", length, "µm")

    @property
    def volume(self) -> float:
        """Its volume in µm³: 4π/3 times the product of the semi-axes."""
        return 4 / 3 * math.pi * math.prod(self.semi_axes)

    def fill(self, grid: Grid, subpixels: int = 4) -> Float[Tensor, "z y x"]:
        """The fraction of each voxel that it covers, shape (z, y, x), float64; see `covered_fraction`."""
        require_subpixels(subpixels)
        (az, ay, ax), (cz, cy, cx) = self.semi_axes, self.centre

        def surfaces(y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
            half = az * (1 - ((y - cy) / ay) ** 2 - ((x - cx) / ax) ** 2).clamp_min(0).sqrt()
            return cz - half, cz + half

        return covered_fraction(grid, surfaces, subpixels)

    def contains(self, points: Float[Tensor, "*point 3"]) -> Bool[Tensor, "*point"]:
        """Whether each point (z, y, x) in µm lies inside or on the surface, shape (...)."""
        centre, axes = (torch.tensor(v, dtype=torch.float64) for v in (self.centre, self.semi_axes))
        return ((points - centre) / axes).square().sum(-1) <= 1 + 1e-9

    def surface(self, number: int = 400) -> Float[Tensor, "point 3"]:
        """Points (z, y, x) in µm on a Fibonacci spiral over the surface, shape (number, 3), float64."""
        i = torch.arange(number, dtype=torch.float64) + 0.5
        cosine, azimuth = 1 - 2 * i / number, math.pi * (1 + math.sqrt(5)) * i
        sine = (1 - cosine.square()).sqrt()
        sphere = torch.stack((cosine, sine * azimuth.sin(), sine * azimuth.cos()), -1)
        axes, centre = (torch.tensor(v, dtype=torch.float64) for v in (self.semi_axes, self.centre))
        return sphere * axes + centre
