"""A Gaussian ball: smooth everywhere, so that ray models can be held to their best."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from data_synthetic.exact import radial_field
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
    """Δn = contrast·exp(−r²/2σ²) about a centre: sigma in µm, centre (z, y, x) in µm.

    A voxel holds Δn at its centre. Raises ValueError for a sigma not above 0 and for an index below 1.
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
        """∫Δn ds in µm, shape (...), along straight rays of any direction, between z = start and z = end.

        position (..., 2): where a ray crosses z = plane, in µm; momentum (..., 2): its n·(transverse
        direction) in the background. With b the ray's distance from the centre and s the path from the
        closest point: contrast·σ·√(π/2)·exp(−b²/2σ²)·[erf(s_end/σ√2) − erf(s_start/σ√2)]. Raises
        ValueError for a momentum not below the background index.
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
        """The distance in µm from the centre where Δn has fallen to double precision's rounding of n."""
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
        """The exact field behind this ball as envelopes (source, y, x); arguments as of `radial_field`."""

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
