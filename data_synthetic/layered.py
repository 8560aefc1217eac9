"""A medium whose index varies along the optical axis only, to test Snell's law."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.integrate import quad
from torch import Tensor

from data_synthetic.specimen import (
    ExactRays,
    Specimen,
    centres,
    require_above_zero,
    require_contrast,
    require_finite,
    require_propagating,
)
from torchdic.grid import Grid


@dataclass(frozen=True)
class LayeredMedium(Specimen):
    """A layer of index background + contrast, perpendicular to z, with smooth faces.

    Δn(z) = (contrast/2)·[tanh((z − bottom)/edge) − tanh((z − bottom − thickness)/edge)].

    contrast: Δn within the layer.
    background: index of the medium.
    bottom: z of the first face in µm.
    thickness: in µm. If it is infinite, the layer has only its first face.
    edge: half the width in µm over which the index changes at a face.
    A voxel holds the Δn of its centre. Raises ValueError for a thickness or edge not above 0 and for an index below 1.
    """

    contrast: float
    background: float
    bottom: float = 0.0
    thickness: float = math.inf
    edge: float = 1.0

    def __post_init__(self) -> None:
        require_contrast("layer", self.background, self.contrast)
        require_finite("bottom", self.bottom, "µm")
        require_above_zero("edge", self.edge, "µm")
        if not self.thickness > 0:
            raise ValueError(f"thickness {self.thickness} µm must be above 0")

    def profile(self, z: Float[Tensor, "*z"]) -> Float[Tensor, "*z"]:
        """Δn at heights z in µm."""
        top = self.bottom + self.thickness
        return self.contrast / 2 * (((z - self.bottom) / self.edge).tanh() - ((z - top) / self.edge).tanh())

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        return self.profile(centres(grid)[0]).expand(grid.shape).clone()

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

        n does not depend on (y, x), so p is conserved (Snell's law); with p_z(z) = √(n(z)² − |p|²) and
        B = n² − n0²,  x = x0 + p·∫dz/p_z  and  W = ∫(p_z − p_z0) dz = ∫B/(p_z + p_z0) dz, by adaptive
        quadrature to 1e-12. Raises ValueError where a ray would be totally reflected.
        """
        position, momentum = position.to(torch.float64), momentum.to(torch.float64)
        lowest = self.background + min(0.0, self.contrast)
        require_propagating(momentum, lowest)
        answers = [self._path(float(p2), start, end) for p2 in momentum.square().sum(-1).reshape(-1)]
        path, opd = torch.tensor(answers, dtype=torch.float64).reshape(*momentum.shape[:-1], 2).unbind(-1)
        return ExactRays(position + momentum * path[..., None], momentum.clone(), opd)

    def _path(self, p_squared: float, start: float, end: float) -> tuple[float, float]:
        """(∫dz/p_z, ∫(p_z − p_z0) dz) for one |p|²."""
        n0 = self.background
        pz0 = math.sqrt(n0**2 - p_squared)

        def axial(z: float) -> tuple[float, float]:
            delta = float(self.profile(torch.tensor(z, dtype=torch.float64)))
            bending = delta * (2 * n0 + delta)
            return math.sqrt(pz0**2 + bending), bending

        def rate(z: float) -> float:
            pz, bending = axial(z)
            return bending / (pz + pz0)

        # The integrand changes fast at the faces. quad's estimate of its error is right only if it knows them.
        low, high = min(start, end), max(start, end)
        faces = [z for z in (self.bottom, self.bottom + self.thickness) if low < z < high] or None
        tolerance = {"epsabs": 1e-12, "epsrel": 1e-12, "limit": 400, "points": faces}
        path = quad(lambda z: 1 / axial(z)[0], start, end, **tolerance)[0]
        return path, quad(rate, start, end, **tolerance)[0]
