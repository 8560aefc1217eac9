"""Δn within bounds, as a smooth function of a parameter that may take any value."""

import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

# Sharpness of softplus: its knee is about 1/200 = 0.005 wide, the scale of a cell's Δn.
SHARPNESS = 200.0


@dataclass(frozen=True)
class Bounds:
    """The least and the greatest Δn.

    lower: the least Δn; None is no bound. upper: the greatest Δn; None is no bound.
    Raises ValueError unless lower < upper.

    Δn is a smooth function of the parameter, not a clamped one: a voxel that is clamped at a bound has no gradient and
    can never leave it.
    """

    lower: float | None = 0.0
    upper: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("lower", self.lower), ("upper", self.upper)):
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} bound {value} must be a finite Δn")
        if self.lower is not None and self.upper is not None and self.lower >= self.upper:
            raise ValueError(f"lower bound {self.lower} must be below the upper bound {self.upper}")

    def delta(self, parameter: Tensor) -> Tensor:
        """Δn of a parameter of any value."""
        lower, upper = self.lower, self.upper
        if lower is not None and upper is not None:
            return lower + (upper - lower) * torch.sigmoid(4 * parameter / (upper - lower))
        if lower is not None:
            return lower + F.softplus(parameter, beta=SHARPNESS)
        if upper is not None:
            return upper - F.softplus(-parameter, beta=SHARPNESS)
        return parameter

    def clamped(self, delta: Tensor) -> Tensor:
        """Δn moved to the nearest value within the bounds."""
        return delta if self.lower is None and self.upper is None else delta.clamp(self.lower, self.upper)

    def parameter(self, delta: Tensor, margin: float) -> Tensor:
        """The parameter whose Δn is the given one, first moved to at least `margin` (in Δn) from each bound."""
        lower, upper = self.lower, self.upper
        if lower is not None and upper is not None:
            margin = min(margin, (upper - lower) / 4)
            share = (delta.clamp(lower + margin, upper - margin) - lower) / (upper - lower)
            return (upper - lower) / 4 * torch.logit(share)
        if lower is not None:
            return _inverse_softplus((delta - lower).clamp_min(margin))
        if upper is not None:
            return -_inverse_softplus((upper - delta).clamp_min(margin))
        return delta.clone()


@dataclass(frozen=True, eq=False)
class SupportedBounds(Bounds):
    """Bounds within a support; outside Δn is 0, whatever they are.

    support: the voxels (z, y, x) in which Δn is sought (True). Outside, a parameter has no gradient.
    Raises ValueError where the support holds no voxel.
    """

    support: Bool[Tensor, "z y x"] = field(default_factory=lambda: torch.ones(1, 1, 1, dtype=torch.bool))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not bool(self.support.any()):
            raise ValueError("the support holds no voxel: there is nothing to fit")

    def delta(self, parameter: Tensor) -> Tensor:
        """Δn of a parameter of any value; 0 outside the support."""
        return torch.where(self.support, super().delta(parameter), 0)

    def clamped(self, delta: Tensor) -> Tensor:
        """Δn moved to the nearest value within the bounds; 0 outside the support."""
        return torch.where(self.support, super().clamped(delta), 0)


def _inverse_softplus(value: Tensor) -> Tensor:
    return value + torch.log(-torch.expm1(-SHARPNESS * value)) / SHARPNESS
