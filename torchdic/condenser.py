"""Köhler illumination: the condenser's aperture as weighted plane waves."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Condenser:
    """A condenser's aperture, filled evenly with mutually incoherent plane waves.

    na: its numerical aperture; 0 is one axial plane wave. points: directions (source, 2), each n·(sinθ_y, sinθ_x) as
    given, in place of the disc of `na`. weights: their shares (source,), made to sum to 1; None means equal ones.
    Raises ValueError for a negative aperture or weight, weights without points, or unequal numbers of the two.
    """

    na: float
    points: Float[Tensor, "source 2"] | None = None
    weights: Float[Tensor, " source"] | None = None

    def __post_init__(self) -> None:
        if not (0 <= self.na < float("inf")):
            raise ValueError(f"condenser NA {self.na} must be at least 0")
        if self.points is None:
            if self.weights is not None:
                raise ValueError("condenser weights need the points that they belong to")
            return
        points = torch.as_tensor(self.points, dtype=None if isinstance(self.points, Tensor) else torch.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
            raise ValueError(f"condenser points have shape {tuple(points.shape)}, not (source, 2)")
        if not bool(torch.isfinite(points).all()):
            raise ValueError("condenser points must be finite")
        object.__setattr__(self, "points", points)
        if self.weights is not None:
            weights = torch.as_tensor(self.weights)
            if tuple(weights.shape) != (len(points),):
                raise ValueError(f"condenser has {len(points)} points and weights of shape {tuple(weights.shape)}")
            if not (bool((weights >= 0).all()) and 0 < float(weights.sum()) < float("inf")):
                raise ValueError("condenser weights must be at least 0, with a positive finite sum")
            object.__setattr__(self, "weights", weights)

    def sources(
        self, count: int, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> tuple[Float[Tensor, "source 2"], Float[Tensor, " source"]]:
        """Directions n·sinθ (source, 2) and weights (source,) of sum 1; at most `count` unless points are given."""
        if self.points is not None:
            points = self.points
            weights = torch.ones(len(points)) if self.weights is None else self.weights
        elif self.na == 0:
            points, weights = torch.zeros(1, 2), torch.ones(1)
        else:
            points, weights = (torch.from_numpy(a) for a in disc_quadrature(count))
            points = points * self.na
        points = points.to(device, dtype or torch.get_default_dtype())
        weights = weights.to(device, torch.float64)
        return points, (weights / weights.sum()).to(points.dtype)


def disc_quadrature(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 2) in the unit disc and weights (m,) that sum to 1, m ≤ count, for the mean over the disc.

    K rings at the Gauss nodes of r², each with M equally spaced azimuths: exact for polynomials of degree below
    min(4K, M). The rings are turned by half a step against each other, so that what their azimuths miss beyond that, up
    to about 2M, nearly cancels: K and M are chosen for it, and where they tie more rings are.
    """
    if count < 1:
        raise ValueError(f"a condenser needs at least 1 source, not {count}")
    if count == 1:
        return np.zeros((1, 2)), np.ones(1)
    rings, azimuths = max(
        ((k, count // k) for k in range(1, count + 1)), key=lambda rule: (min(2 * rule[0], rule[1]), rule[0])
    )
    nodes, node_weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt((1 + nodes) / 2)
    angle = 2 * np.pi * (np.arange(azimuths)[None, :] + 0.5 * (np.arange(rings)[:, None] % 2)) / azimuths
    points = np.stack((radius[:, None] * np.sin(angle), radius[:, None] * np.cos(angle)), -1).reshape(-1, 2)
    return points, np.repeat(node_weights / 2 / azimuths, azimuths)
