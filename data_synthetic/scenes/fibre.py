"""A fibre across the optical axis."""

import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from data_synthetic.fill import covered_fraction, require_subpixels
from data_synthetic.specimen import Specimen, require_above_zero, require_contrast, require_vector
from torchdic.grid import Grid


@dataclass(frozen=True)
class Fibre(Specimen):
    """A round fibre across the optical axis, with hemispheres at its ends.

    radius: in µm.
    length: in µm between the centres of its ends.
    contrast: Δn inside.
    background: index of the medium.
    angle: in rad from +x towards +y.
    centre: (z, y, x) in µm.
    subpixels: columns per voxel along y and along x, by which each voxel's covered volume is found.
    Raises ValueError for a radius or length not above 0 and for an index below 1.
    """

    radius: float
    length: float
    contrast: float
    background: float
    angle: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    subpixels: int = 4

    def __post_init__(self) -> None:
        require_above_zero("radius", self.radius, "µm")
        require_above_zero("length", self.length, "µm")
        require_contrast("fibre", self.background, self.contrast)
        require_vector("centre", self.centre, "z, y, x")
        require_subpixels(self.subpixels)

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        (cz, cy, cx), sine, cosine = self.centre, math.sin(self.angle), math.cos(self.angle)

        def surfaces(y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
            along = cosine * (x - cx) + sine * (y - cy)
            beyond = (along.abs() - self.length / 2).clamp_min(0)
            across = cosine * (y - cy) - sine * (x - cx)
            half = (self.radius**2 - across**2 - beyond**2).clamp_min(0).sqrt()
            return cz - half, cz + half

        return self.contrast * covered_fraction(grid, surfaces, self.subpixels)
