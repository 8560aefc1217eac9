"""The fraction of each voxel that a solid covers: all specimens with sharp edges fill their voxels by it."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.grid import Grid

Surfaces = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


def covered_fraction(grid: Grid, surfaces: Surfaces, subpixels: int) -> Float[Tensor, "z y x"]:
    """The fraction of each voxel between two surfaces, shape (z, y, x), float64, from 0 to 1.

    grid: the voxels.
    surfaces: a function that takes y and x in µm, two arrays of one shape, and gives the solid's lower and upper z in
        µm in arrays of that shape; where the solid misses a column, both are equal.
    subpixels: columns per voxel along y and along x.
    The covered length of each column is exact, and a voxel's fraction is the mean over its subpixels² columns. Voxels
    that are wholly filled or empty would move a sphere's edge by up to half a voxel, and the DIC image would show that.
    """
    faces = torch.arange(grid.shape[0] + 1, dtype=torch.float64) - grid.shape[0] / 2
    faces = (faces * grid.spacing[0])[:, None]
    y, x = (_subpixel_coordinates(grid, axis, subpixels) for axis in (1, 2))  # (subpixel, n)
    mesh_y = y[:, None, :, None].expand(-1, subpixels, -1, grid.shape[2])
    mesh_x = x[None, :, None, :].expand(subpixels, -1, grid.shape[1], -1)
    lower, upper = (s.flatten(0, 1) for s in surfaces(mesh_y, mesh_x))  # (subpixels², y, x)

    touched = (upper > lower).any(0)
    below = torch.zeros(grid.shape[0] + 1, int(touched.sum()), dtype=torch.float64)
    for low, high in zip(lower[:, touched], upper[:, touched], strict=True):
        below += torch.clamp(faces, low, high)  # the solid's height under each face, up to a constant
    fraction = torch.zeros(grid.shape, dtype=torch.float64)
    fraction[:, touched] = (below.diff(dim=0) / (subpixels**2 * grid.spacing[0])).clamp(0, 1)
    return fraction


def require_subpixels(subpixels: int) -> None:
    """Raise ValueError unless the number of subpixels is a whole number of at least 1."""
    if isinstance(subpixels, bool) or int(subpixels) != subpixels or subpixels < 1:
        raise ValueError(f"subpixels {subpixels} must be a whole number of at least 1")


def _subpixel_coordinates(grid: Grid, axis: int, subpixels: int) -> Float[Tensor, "subpixel n"]:
    """Centres in µm of the equal parts of each voxel along one axis."""
    offsets = (torch.arange(subpixels, dtype=torch.float64) + 0.5) / subpixels - 0.5
    return grid.coordinates(axis, dtype=torch.float64) + offsets[:, None] * grid.spacing[axis]
