"""A graded-index rod. Its rays are harmonic oscillations, by which the order of an integrator is tested."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from data_synthetic.specimen import (
    ExactRays,
    Specimen,
    centres,
    require_above_zero,
    require_index,
    require_propagating,
    require_vector,
)
from torchdic.grid import Grid


@dataclass(frozen=True)
class GradedIndexRod(Specimen):
    """A rod along z with n² = n0²·(1 − α²r²), where r is the distance from its axis.

    alpha: α in 1/µm.
    background: n0, the index on the axis.
    axis: place of the axis, (y, x) in µm.
    Δn is 0 on the axis and negative elsewhere. Raises ValueError for an alpha not above 0 and an n0 below 1; `delta`
    raises it for a grid so wide that n would fall below 1 in it.
    """

    alpha: float
    background: float
    axis: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        require_above_zero("alpha", self.alpha, "1/µm")
        require_index("background", self.background)
        require_vector("axis", self.axis, "y, x")

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        _, y, x = centres(grid)
        r2 = (y - self.axis[0]) ** 2 + (x - self.axis[1]) ** 2
        # With n = n0·√(1 − u), n − n0 = −n0·u/(1 + √(1 − u)) keeps all digits where u is small.
        u = self.alpha**2 * r2
        reach = math.sqrt(1 - 1 / self.background**2) / self.alpha
        if float(r2.max()) > reach**2:
            raise ValueError(
                f"the grid reaches {math.sqrt(float(r2.max())):.4g} µm from the rod's axis, but beyond "
                f"{reach:.4g} µm n0·√(1 − α²r²) is below 1, the index of vacuum"
            )
        return (-self.background * u / (1 + (1 - u).sqrt())).expand(grid.shape).clone()

    def rays(
        self,
        position: Float[Tensor, "*ray 2"],
        momentum: Float[Tensor, "*ray 2"],
        start: float,
        end: float,
    ) -> ExactRays:
        """Trace rays exactly from z = start to z = end.

        position: (..., 2), (y, x) in µm, at the start.
        momentum: n·(transverse direction), (..., 2), (y, x), at the start.
        start, end: z in µm.

        n does not depend on z, so p_z = √(n(x0)² − |p0|²) is conserved and dp/dz = ½∇n²/p_z gives
        x'' = −ω²x with ω = n0·α/p_z (x from the axis):
            x = x0·cos ωz + p0/(p_z·ω)·sin ωz,    p = p0·cos ωz − p_z·ω·x0·sin ωz.
        From dW/dz = (n² − p·p0 − p_z·p_z0)/p_z, n² = p_z² + |p|² and p_z0 = √(n0² − |p0|²):
            W = (p_z − p_z0)·z + ∫|p|²dz/p_z − p0·(x − x0).
        Raises ValueError for a momentum that the index at x0, or on the axis, cannot carry.
        """
        position, momentum = position.to(torch.float64), momentum.to(torch.float64)
        axis = torch.tensor(self.axis, dtype=torch.float64)
        x0, p0, n0, z = position - axis, momentum, self.background, end - start
        r2, p2 = x0.square().sum(-1), p0.square().sum(-1)
        pz0 = require_propagating(p0, n0)
        pz = require_propagating(p0, n0 * (1 - self.alpha**2 * r2).clamp_min(0).sqrt())
        w = n0 * self.alpha / pz
        sine, cosine = (w * z).sin(), (w * z).cos()

        x = x0 * cosine[..., None] + p0 * (sine / (pz * w))[..., None]
        p = p0 * cosine[..., None] - x0 * (pz * w * sine)[..., None]
        wave = sine * cosine / w  # ∫cos² = (z + wave)/2, ∫sin² = (z − wave)/2, ∫sin·cos = sin²/(2ω)
        kinetic = (p2 * (z + wave) + (pz * w) ** 2 * r2 * (z - wave)) / 2
        kinetic = kinetic - pz * sine**2 * (x0 * p0).sum(-1)
        bending = -((n0 * self.alpha) ** 2) * r2  # p_z² − p_z0²: no digits lost in p_z − p_z0
        opd = bending / (pz + pz0) * z + kinetic / pz - (p0 * (x - x0)).sum(-1)
        return ExactRays(x + axis, p, opd)
