"""The base of every specimen: a background index, and Δn on any grid."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.grid import Grid


class ExactRays(NamedTuple):
    """Rays behind a specimen whose ray equation has an exact solution.

    position: (..., 2), (y, x) in µm.
    momentum: n·(transverse direction), (..., 2), (y, x).
    opd: W in µm, (...), the difference of the optical path from that of the plane wave with which the ray began.
    """

    position: Float[Tensor, "*ray 2"]
    momentum: Float[Tensor, "*ray 2"]
    opd: Float[Tensor, "*ray"]


class Specimen(ABC):
    """A specimen of known index n = background + Δn. Subclasses are frozen dataclasses, with lengths in µm."""

    background: float

    @abstractmethod
    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        """Δn on the grid, shape (z, y, x), float64, on the CPU; `delta` and `index` convert it."""

    def delta(
        self, grid: Grid, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
    ) -> Float[Tensor, "z y x"]:
        """The index difference Δn = n − background on a grid, shape (z, y, x)."""
        return self._delta(grid).to(dtype=dtype, device=device)

    def index(
        self, grid: Grid, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
    ) -> Float[Tensor, "z y x"]:
        """The refractive index n = background + Δn on a grid, shape (z, y, x)."""
        return (self.background + self._delta(grid)).to(dtype=dtype, device=device)


def centres(
    grid: Grid,
) -> tuple[Float[Tensor, "z 1 1"], Float[Tensor, "1 y 1"], Float[Tensor, "1 1 x"]]:
    """Voxel centres (z, y, x) in µm, float64, shaped to broadcast against a volume."""
    z, y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in range(3))
    return z[:, None, None], y[None, :, None], x[None, None, :]


def require_above_zero(name: str, value: float, unit: str) -> None:
    """Raise ValueError unless a length or rate is finite and above 0."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} {value} {unit} must be above 0")


def require_finite(name: str, value: float, unit: str) -> None:
    """Raise ValueError unless a number is finite."""
    if not math.isfinite(value):
        raise ValueError(f"{name} {value} {unit} must be finite".replace("  ", " "))


def require_index(name: str, value: float) -> None:
    """Raise ValueError unless a refractive index is finite and at least 1, the index of vacuum."""
    if not (math.isfinite(value) and value >= 1):
        raise ValueError(f"index {value} of the {name} must be at least 1, the index of vacuum")


def require_contrast(name: str, background: float, contrast: float) -> None:
    """Raise ValueError unless the background and the background + contrast are refractive indices."""
    require_index("background", background)
    if not (math.isfinite(contrast) and background + contrast >= 1):
        raise ValueError(f"index {background} + ({contrast}) of the {name} must be at least 1, the index of vacuum")


def require_vector(name: str, value: Sequence[float], axes: str) -> None:
    """Raise ValueError unless a vector has one finite number for each of the axes."""
    if len(value) != len(axes.split(", ")) or not all(math.isfinite(v) for v in value):
        raise ValueError(f"{name} {tuple(value)} must be finite numbers ({axes})")


def require_propagating(
    momentum: Float[Tensor, "*ray 2"], index: float | Float[Tensor, "*ray"]
) -> Float[Tensor, "*ray"]:
    """The axial momentum p_z = √(n² − |p|²), shape (...); ValueError where no ray can travel toward +z."""
    squared = torch.as_tensor(index, dtype=torch.float64) ** 2 - momentum.square().sum(-1)
    if bool((squared <= 0).any()):
        steepest, lowest = float(momentum.norm(dim=-1).max()), float(torch.as_tensor(index).min())
        raise ValueError(f"transverse momentum {steepest:.6g} must be below the index {lowest:.6g}")
    return squared.sqrt()
