"""A bead, such as the one in optical cement that the paper manufactured."""

from dataclasses import dataclass

from jaxtyping import Complex, Float
from torch import Tensor

from data_synthetic.ellipsoid import Ellipsoid
from data_synthetic.exact.fields import sphere_field
from data_synthetic.fill import require_subpixels
from data_synthetic.specimen import Specimen, require_above_zero, require_contrast, require_vector
from torchdic.grid import Grid


@dataclass(frozen=True)
class Bead(Specimen):
    """A homogeneous sphere of index background + contrast.

    radius: in µm.
    contrast: Δn inside.
    background: index of the medium.
    centre: (z, y, x) in µm.
    subpixels: columns per voxel along y and along x, by which each voxel's covered volume is found.
    Raises ValueError for a radius not above 0 and for an index below 1.
    """

    radius: float
    contrast: float
    background: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    subpixels: int = 4

    def __post_init__(self) -> None:
        require_above_zero("radius", self.radius, "µm")
        require_contrast("bead", self.background, self.contrast)
        require_vector("centre", self.centre, "z, y, x")
        require_subpixels(self.subpixels)

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        sphere = Ellipsoid((self.radius, self.radius, self.radius), self.centre)
        return self.contrast * sphere.fill(grid, self.subpixels)

    def field(
        self,
        grid: Grid,
        wavelength: float,
        points: Float[Tensor, "source 2"],
        plane: float = 0.0,
        *,
        padding: float = 2.0,
        na: float | None = None,
    ) -> Complex[Tensor, "source y x"]:
        """The exact field behind this bead as envelopes (source, y, x); the arguments are those of `sphere_field`."""
        return sphere_field(
            grid,
            wavelength,
            self.radius,
            self.background + self.contrast,
            self.background,
            points,
            plane,
            self.centre,
            padding=padding,
            na=na,
        )
