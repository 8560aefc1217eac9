"""A Gaussian ball. It is smooth everywhere, so that it shows how good a ray model can be."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from data_synthetic.exact.fields import radial_field
from data_synthetic.specimen import (
    Specimen,
    centres,
    require_above_zero,
    require_contrast,
    require_propagating,
    require_vector,
)
from torchdic.grid import Grid


@dataclass(frozen=True)
class GaussianBall(Specimen):
    """A ball of Δn = contrast·exp(−r²/2σ²), where r is the distance from its centre.

    sigma: σ in µm.
    contrast: Δn at the centre.
    background: index of the medium.
    centre: (z, y, x) in µm.
    A voxel holds the Δn of its centre. Raises ValueError for a sigma not above 0 and for an index below 1.
    """

    sigma: float
    contrast: float
    background: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        require_above_zero("sigma", self.sigma, "µm")
        require_contrast("ball", self.background, self.contrast)
        require_vector("centre", self.centre, "z, y, x")

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        z, y, x = (x - c for x, c in zip(centres(grid), self.centre, strict=True))
        r2 = z**2 + y**2 + x**2
        return self.contrast * torch.exp(-r2 / (2 * self.sigma**2))

    def straight_opd(
        self,
        position: Float[Tensor, "*ray 2"],
        momentum: Float[Tensor, "*ray 2"],
        plane: float = 0.0,
        start: float = -math.inf,
        end: float = math.inf,
    ) -> Float[Tensor, "*ray"]:
        """The OPD ∫Δn ds in µm, shape (...), along straight rays of any direction.

        position: where each ray crosses z = plane, (..., 2), (y, x) in µm.
        momentum: n·(transverse direction) of each ray in the background, (..., 2), (y, x).
        plane: z in µm.
        start, end: z in µm between which the OPD is counted.
        With b the ray's distance from the centre and s the path from the point closest to it, the OPD is
        contrast·σ·√(π/2)·exp(−b²/2σ²)·[erf(s_end/σ√2) − erf(s_start/σ√2)].
        Raises ValueError for a momentum not below the background index.
        """
        position, momentum = position.to(torch.float64), momentum.to(torch.float64)
        pz = require_propagating(momentum, self.background)
        direction = torch.cat((pz[..., None], momentum), -1) / self.background
        from_centre = torch.cat((torch.full_like(position[..., :1], plane), position), -1) - torch.tensor(
            self.centre, dtype=torch.float64
        )
        closest = -(from_centre * direction).sum(-1)  # path from the plane to the closest point
        b2 = (from_centre + closest[..., None] * direction).square().sum(-1)
        cosine = pz / self.background
        limits = [((z - plane) / cosine - closest) / (self.sigma * math.sqrt(2)) for z in (start, end)]
        ends = torch.erf(limits[1]) - torch.erf(limits[0])
        scale = self.contrast * self.sigma * math.sqrt(math.pi / 2)
        return scale * torch.exp(-b2 / (2 * self.sigma**2)) * ends

    @property
    def reach(self) -> float:
        """The distance in µm from the centre beyond which Δn is lost in the rounding of n in double precision."""
        fall = abs(self.contrast) / (np.finfo(np.float64).eps * self.background)
        return self.sigma * math.sqrt(2 * math.log(max(fall, math.e)))

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
        """The exact field behind this ball as envelopes (source, y, x); the arguments are those of `radial_field`."""

        def index(r: np.ndarray) -> np.ndarray:
            return self.background + self.contrast * np.exp(-(r**2) / (2 * self.sigma**2))

        return radial_field(
            grid,
            wavelength,
            index,
            self.reach,
            self.background,
            points,
            plane,
            self.centre,
            padding=padding,
            na=na,
        )
