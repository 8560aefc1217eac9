"""An ellipsoid whose index falls from its centre to its surface."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from data_synthetic.ellipsoid import Ellipsoid
from data_synthetic.specimen import Specimen, centres, require_contrast
from torchdic.grid import Grid


@dataclass(frozen=True)
class GradedEllipsoid(Specimen):
    """Δn = contrast·(1 − ρ²) within an ellipsoid, a parabola: ρ is 0 at its centre and 1 on its surface.

    A voxel holds the Δn of its centre. Raises ValueError for an index below 1.
    """

    shape: Ellipsoid
    contrast: float
    background: float

    def __post_init__(self) -> None:
        require_contrast("ellipsoid", self.background, self.contrast)

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        terms = [
            ((x - c) / a) ** 2 for x, c, a in zip(centres(grid), self.shape.centre, self.shape.semi_axes, strict=True)
        ]
        return self.contrast * (1 - (terms[0] + terms[1] + terms[2])).clamp_min(0)
