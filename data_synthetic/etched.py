"""Glass etched in two levels under a mounting medium: a step, as the paper manufactured it, and a grating."""

import math
from abc import abstractmethod
from dataclasses import dataclass, field

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
    """Glass below a mounting medium. The surface of the glass has two levels, which alternate along a direction.

    Light travels toward +z, from the glass into the medium and on to the objective. So the background is the medium,
    and the glass has Δn = glass − background.

    height: of the higher level above the lower one, in µm.
    glass, background: refractive indices of the glass and of the medium.
    direction: transverse vector (y, x) of any length, across the walls.
    offset: place of the first wall in µm along the direction.
    surface: z in µm halfway between the levels.
    edge: width of a wall in µm. At 0 it is vertical; above 0 it is smooth, z = surface + (height/2)·tanh(d/edge), where
        d is the distance from the nearest wall, above 0 on the higher side.
    subpixels: columns per voxel along y and along x. Each voxel is filled by its covered volume, so that a vertical
        wall is placed to 1/(2·subpixels) of a voxel.
    Raises ValueError for an index below 1, a direction of length 0 or a negative edge.
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
        """The OPD of axial light at the higher level minus that at the lower, in µm: height·(glass − background)."""
        return self.height * (self.glass - self.background)

    @abstractmethod
    def from_wall(self, u: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """The distance in µm from the nearest wall, above 0 on the higher side.

        u: place in µm along the direction, counted from `offset`.
        """

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


@dataclass(frozen=True)
class EtchedGlassStep(EtchedGlass):
    """Glass whose surface is higher on the side that the direction points to; see `EtchedGlass`.

    The wall stands `offset` µm along the direction. A negative height is a step down.
    """

    def from_wall(self, u: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """The distance from the only wall, which is u itself."""
        return u


@dataclass(frozen=True)
class EtchedGlassGrating(EtchedGlass):
    """Glass with one ridge in each period along the direction; see `EtchedGlass`.

    A ridge begins `offset` µm along the direction. A negative height makes grooves of the ridges.

    period: in µm.
    duty: width of a ridge, as a fraction of the period.
    Raises ValueError also for a period not above 0 and a duty not between 0 and 1.
    """

    period: float = field(kw_only=True)
    duty: float = field(default=0.5, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_above_zero("period", self.period, "µm")
        require_finite("duty", self.duty, "")
        if not 0 < self.duty < 1:
            raise ValueError(f"duty {self.duty} must lie between 0 and 1")

    def from_wall(self, u: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """Half a ridge's width minus the distance from the middle of the nearest ridge."""
        half = self.duty * self.period / 2
        from_middle = torch.remainder(u - half + self.period / 2, self.period) - self.period / 2
        return half - from_middle.abs()
