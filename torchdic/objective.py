"""The objective's pupil: aperture and Zernike aberrations."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Objective:
    """An objective.

    na: numerical aperture. aberrations: Zernike coefficients {Noll index: rad}, rms phase over the pupil; numbers or
    0-d tensors, which are learned; None for a perfect lens.
    Raises ValueError for an aperture that isn't positive or a Noll index below 1.
    """

    na: float
    aberrations: Mapping[int, float | Tensor] | None = None

    def __post_init__(self) -> None:
        if not (0 < self.na < float("inf")):
            raise ValueError(f"objective NA {self.na} must be above 0")
        for index, value in (self.aberrations or {}).items():
            if isinstance(index, bool) or not isinstance(index, int) or index < 1:
                raise ValueError(f"aberration {index!r}: a Noll index is a whole number from 1")
            coefficient = float(torch.as_tensor(value, dtype=torch.float64).detach())
            if not math.isfinite(coefficient):
                raise ValueError(f"aberration {index}: {coefficient} rad must be a finite number")

    def aperture(self, momentum: Float[Tensor, "source 2 y x"]) -> Tensor:
        """Which transverse momenta n·sinθ the pupil lets through, shape (source, y, x); its edge counts as inside."""
        rounding = 8 * torch.finfo(momentum.dtype).eps
        return momentum.square().sum(1) <= self.na**2 * (1 + rounding)

    def phase(self, momentum: Float[Tensor, "source 2 y x"]) -> Float[Tensor, "source y x"] | None:
        """The aberrations' phase in rad at each transverse momentum, or None for a perfect lens."""
        if not self.aberrations:
            return None
        pupil = momentum / self.na
        rho, theta = pupil.square().sum(1).sqrt(), torch.atan2(pupil[:, 0], pupil[:, 1])
        terms = [
            torch.as_tensor(value, dtype=rho.dtype, device=rho.device) * zernike(index, rho, theta)
            for index, value in self.aberrations.items()
        ]
        return torch.stack(terms).sum(0)


def zernike(noll: int, rho: Tensor, theta: Tensor) -> Tensor:
    """The Zernike polynomial of a Noll index, of unit rms over the disc ρ ≤ 1; θ is counted from +x towards +y.

    Noll, J. Opt. Soc. Am. 66, 207 (1976).
    """
    n = (math.isqrt(8 * noll - 7) - 1) // 2
    place = noll - n * (n + 1) // 2
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    radial = torch.zeros_like(rho)
    for k in range((n - m) // 2 + 1):
        factor = math.comb(n - k, k) * math.comb(n - 2 * k, (n - m) // 2 - k)
        radial = radial + (-1) ** k * factor * rho ** (n - 2 * k)
    if m == 0:
        return math.sqrt(n + 1) * radial
    azimuthal = torch.cos(m * theta) if noll % 2 == 0 else torch.sin(m * theta)
    return math.sqrt(2 * (n + 1)) * radial * azimuthal
