"""The grid of voxels: where voxel centres are, and which frequencies an array holds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Grid:
    """A box of voxels centred on the origin: voxel i of an axis has its centre at (i − (N−1)/2)·spacing.

    shape: number of voxels along (z, y, x).
    spacing: voxel size along (z, y, x) in µm.
    The box fills [−N·spacing/2, +N·spacing/2] along each axis, outer faces included.
    Raises ValueError unless shape is three whole numbers of at least 1 and spacing three lengths above 0.
    """

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]

    def __post_init__(self) -> None:
        shape, spacing = tuple(self.shape), tuple(self.spacing)
        if len(shape) != 3 or any(isinstance(n, bool) or int(n) != n or n < 1 for n in shape):
            raise ValueError(f"shape {_show(shape)} must be three whole numbers (z, y, x), each at least 1")
        if len(spacing) != 3 or not all(math.isfinite(d) and d > 0 for d in spacing):
            raise ValueError(f"spacing {_show(spacing)} must be three lengths (z, y, x) in µm, each above 0")
        object.__setattr__(self, "shape", tuple(int(n) for n in shape))
        object.__setattr__(self, "spacing", tuple(float(d) for d in spacing))

    @property
    def extent(self) -> tuple[float, float, float]:
        """The box's size (z, y, x) in µm, from outer face to outer face."""
        return tuple(n * d for n, d in zip(self.shape, self.spacing, strict=True))  # pyright: ignore[reportReturnType]

    def centre(self, axis: int, index: float) -> float:
        """The coordinate in µm of a voxel index along one axis. The index may be fractional."""
        return (index - (self.shape[axis] - 1) / 2) * self.spacing[axis]

    def index(self, axis: int, coordinate: float) -> float:
        """The voxel index, possibly fractional, of a coordinate in µm along one axis: the inverse of `centre`."""
        return coordinate / self.spacing[axis] + (self.shape[axis] - 1) / 2

    def widened(self, rows: int, columns: int) -> "Grid":
        """The grid with more voxels on each side: `rows` along y, `columns` along x. Its centre stays the same."""
        nz, ny, nx = self.shape
        return replace(self, shape=(nz, ny + 2 * rows, nx + 2 * columns))

    def coordinates(
        self, axis: int, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Float[Tensor, " n"]:
        """Voxel centres along one axis in µm, shape (n,)."""
        n = self.shape[axis]
        steps = torch.arange(n, dtype=torch.float64, device=device) - (n - 1) / 2
        return (steps * self.spacing[axis]).to(dtype or torch.get_default_dtype())

    def frequencies(
        self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Float[Tensor, "2 y x"]:
        """Transverse frequencies (f_y, f_x) in 1/µm in the order of the FFT, shape (2, y, x)."""
        axes = [
            torch.fft.fftfreq(self.shape[axis], self.spacing[axis], dtype=torch.float64, device=device)
            for axis in (1, 2)
        ]
        return torch.stack(torch.meshgrid(*axes, indexing="ij")).to(dtype or torch.get_default_dtype())


def _show(values: Sequence[object]) -> str:
    return "(" + ", ".join(str(v) for v in values) + ")"
