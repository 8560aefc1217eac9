"""Glass with a surface etched in two levels under a mounting medium: what step and grating share."""

import math
from abc import abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from data_synthetic.fill import covered_fraction, require_subpixels
from data_synthetic.specimen import (
    Specimen,
    require_above_zero,
    require_finite,
    require_index,
    require_vector,
)
from torchdic.grid import Grid


@dataclass(frozen=True)
class EtchedGlass(Specimen):
    """Glass below a mounting medium, its surface at two levels `height` apart along `direction`.

    Light travels toward +z, from the glass into the medium. The background is the medium, because that is
    where the light leaves to the objective; the glass is Δn = glass − background. height, and the z halfway
    between the levels `surface`, in µm; direction: a transverse vector (y, x) of any length. edge: 0 is a
    vertical wall, above 0 a smooth one, z = surface + (height/2)·tanh(d/edge) with d the distance from the
    nearest wall, above 0 on the higher side. Voxels are filled by their covered volume, which places a
    vertical wall to 1/(2·subpixels) of a voxel. Raises ValueError for an index below 1, a direction of
    length 0 or a negative edge.
    """

    height: float
    glass: float
    background: float
    direction: tuple[float, float] = (0.0, 1.0)
    offset: float = 0.0
    surface: float = 0.0
    edge: float = 0.0
    subpixels: int = 4

    def __post_init__(self) -> None:
        require_index("glass", self.glass)
        require_index("background", self.background)
        require_vector("direction", self.direction, "y, x")
        for name in ("height", "offset", "surface", "edge"):
            require_finite(name, getattr(self, name), "µm")
        require_subpixels(self.subpixels)
        if self.edge != 0:
            require_above_zero("edge", self.edge, "µm")
        require_above_zero("length of the direction", math.hypot(*self.direction), "(y, x)")

    @property
    def opd_step(self) -> float:
        """How much the OPD of axial light rises from the lower level to the higher one, in µm.

        height·(glass − background): above 0 where the higher side has more of the denser glass.
        """
        return self.height * (self.glass - self.background)

    @abstractmethod
    def from_wall(self, u: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """Distance in µm from the nearest wall, above 0 on the higher side; u: µm along `direction` from `offset`."""

    def surface_height(self, y: Float[Tensor, "*point"], x: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """The z in µm of the glass surface at (y, x) in µm."""
        uy, ux = (u / math.hypot(*self.direction) for u in self.direction)
        d = self.from_wall(uy * y + ux * x - self.offset)
        return self.surface + self.height / 2 * (torch.tanh(d / self.edge) if self.edge > 0 else torch.sign(d))

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        def surfaces(y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
            upper = self.surface_height(y, x)
            return torch.full_like(upper, -grid.extent[0] / 2).minimum(upper), upper

        return (self.glass - self.background) * covered_fraction(grid, surfaces, self.subpixels)
