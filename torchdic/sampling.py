"""Values and transverse gradients between voxel centres, one slice at a time.

All rays of a source are at the same depth, so a 3-D interpolation is a 2-D one in the slice blended for that depth, and
its backward pass touches two (linear) or four (cubic) slices instead of the whole volume.

Outside the outermost voxel centres a field is constant, so its gradient there is 0.
"""

import math
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchdic.grid import Grid

Interpolation = Literal["linear", "cubic"]


class SliceSampler:
    """Samples a field of voxels at one depth and many transverse positions.

    grid: of the whole field. slices: the field's 2-D slices first … first + len(slices) − 1, or, for "cubic", those of
    its spline coefficients (see `spline_coefficients`).
    """

    def __init__(
        self,
        grid: Grid,
        slices: Sequence[Float[Tensor, "y x"]],
        interpolation: Interpolation,
        first: int = 0,
    ) -> None:
        self.grid, self.slices, self.first = grid, slices, first
        self.interpolation: Interpolation = interpolation

    def sample(
        self, z: float, y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]
    ) -> tuple[Float[Tensor, " *ray"], Float[Tensor, " *ray"], Float[Tensor, " *ray"]]:
        """The field and its derivatives along y and x (1/µm) at depth z and positions (y, x) in µm."""
        return self.sample_plane(self.plane(z), y, x)

    def value(self, z: float, y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]) -> Float[Tensor, " *ray"]:
        """The field alone at depth z and positions (y, x) in µm."""
        return self.value_plane(self.plane(z), y, x)

    def plane(self, z: float) -> Float[Tensor, "y x"]:
        """The slice blended for depth z; of spline coefficients for "cubic"."""
        weights = depth_weights(self.grid, z, self.interpolation)
        (first, weight), *others = weights.items()
        field = self.slices[first - self.first] * weight
        for i, weight in others:
            field = field.add(self.slices[i - self.first], alpha=weight)
        return field

    def sample_plane(
        self, field: Float[Tensor, "y x"], y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]
    ) -> tuple[Float[Tensor, " *ray"], Float[Tensor, " *ray"], Float[Tensor, " *ray"]]:
        """As `sample`, of a slice that `plane` blended."""
        dy, dx = self.grid.spacing[1:]
        if self.interpolation == "cubic":
            value, slope_y, slope_x = _sample_cubic(field, *self._indices(y, x))
            slope_y, slope_x = slope_y / dy, slope_x / dx
        else:
            # Two rings of edge values: the central differences fall to 0 within one voxel beyond the edge.
            padded = F.pad(field[None], (2, 2, 2, 2), mode="replicate")[0]
            slopes_y = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * dy)
            slopes_x = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * dx)
            value, slope_y, slope_x = self._linear(torch.stack((padded[1:-1, 1:-1], slopes_y, slopes_x)), y, x)
        return value, slope_y, slope_x

    def value_plane(
        self, field: Float[Tensor, "y x"], y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]
    ) -> Float[Tensor, " *ray"]:
        """As `value`, of a slice that `plane` blended."""
        if self.interpolation == "cubic":
            return _sample_cubic(field, *self._indices(y, x))[0]
        return self._linear(field[None], y, x)[0]

    def _linear(self, channels: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """Channels (c, y, x), centred on the grid, at positions in µm: shape (c, …)."""
        for axis in (1, 2):  # grid_sample's coordinates, −1 … 1, need two points to stand on
            if channels.shape[axis] == 1:
                channels = channels.repeat_interleave(2, axis)
        ny, nx = channels.shape[1:]
        dy, dx = self.grid.spacing[1:]
        where = torch.stack((x * (2 / (dx * (nx - 1))), y * (2 / (dy * (ny - 1)))), -1).reshape(1, 1, -1, 2)
        sampled = F.grid_sample(channels[None], where, padding_mode="border", align_corners=True)
        return sampled.reshape(len(channels), *y.shape)

    def _indices(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        (ny, nx), (dy, dx) = self.grid.shape[1:], self.grid.spacing[1:]
        return y / dy + (ny - 1) / 2, x / dx + (nx - 1) / 2


def depth_weights(grid: Grid, z: float, interpolation: Interpolation) -> dict[int, float]:
    """The slices that the field at depth z depends on, with their weights."""
    last = grid.shape[0] - 1
    index = min(max(grid.index(0, z), 0.0), float(last))
    base = min(int(index), max(last - 1, 0))
    t = index - base
    if interpolation == "linear":
        taps = {base: 1 - t, base + 1: t}
    else:
        taps = dict(zip(range(base - 1, base + 3), _bspline(t), strict=True))
    weights: dict[int, float] = {}
    for i, weight in taps.items():
        if weight != 0:
            mirrored = _mirror(i, last)
            weights[mirrored] = weights.get(mirrored, 0.0) + weight
    return weights


def spline_coefficients(field: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
    """Coefficients of the cubic B-spline (C²) that passes through a field's voxel centres, mirrored at its ends."""
    for axis in range(3):
        n = field.shape[axis]
        if n == 1:
            continue
        matrix = torch.eye(n, dtype=torch.float64) * 4
        for i in range(n):
            for neighbour in (i - 1, i + 1):
                matrix[i, _mirror(neighbour, n - 1)] += 1
        inverse = torch.linalg.inv(matrix / 6).to(field)
        field = torch.tensordot(inverse, field.movedim(axis, 0), dims=1).movedim(0, axis)
    return field


def _mirror(i: int, last: int) -> int:
    if last == 0:
        return 0
    return last - abs(last - abs(i))


def _bspline(t: float) -> tuple[float, float, float, float]:
    return ((1 - t) ** 3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (1 + 3 * t + 3 * t**2 - 3 * t**3) / 6, t**3 / 6)


def _sample_cubic(coefficients: Tensor, iy: Tensor, ix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """A spline and its derivatives at fractional indices."""
    rows, wy, sy = spline_taps(iy, coefficients.shape[0])
    columns, wx, sx = spline_taps(ix, coefficients.shape[1])
    flat = rows[..., :, None] * coefficients.shape[1] + columns[..., None, :]
    patch = coefficients.reshape(-1)[flat]
    along_x = (patch * wx[..., None, :]).sum(-1)
    slope_x = ((patch * sx[..., None, :]).sum(-1) * wy).sum(-1)
    return (along_x * wy).sum(-1), (along_x * sy).sum(-1), slope_x


def spline_taps(index: Tensor, n: int) -> tuple[Tensor, Tensor, Tensor]:
    """The four neighbours of a fractional index along an axis of n, with their weights and slopes."""
    # clamp's gradient is 0 outside, and so is the mirrored spline's slope at its ends
    along = index.clamp(0, n - 1)
    # a ray that can't go on is nan, which no index can be: its weights stay nan
    base = along.detach().floor().clamp(max=max(n - 2, 0)).nan_to_num()
    t = along - base
    weights = torch.stack(((1 - t) ** 3, 4 + t * t * (3 * t - 6), 1 + 3 * t * (1 + t - t * t), t**3), -1) / 6
    slopes = torch.stack((-((1 - t) ** 2), t * (3 * t - 4), 1 + t * (2 - 3 * t), t * t), -1) / 2
    tap = base.long()[..., None] + torch.arange(-1, 3, device=index.device)
    mirrored = (n - 1) - ((n - 1) - tap.abs()).abs() if n > 1 else torch.zeros_like(tap)
    return mirrored, weights, slopes


def window(grid: Grid, z0: float, z1: float, interpolation: Interpolation) -> slice:
    """The slices that depths z0 … z1 (in either order) depend on, as a range of indices."""
    reach = 0 if interpolation == "linear" else 1
    last = grid.shape[0] - 1
    low, high = sorted((grid.index(0, z0), grid.index(0, z1)))
    first = min(max(math.floor(low) - reach, 0), max(last - 1 - 2 * reach, 0))
    return slice(first, min(math.ceil(high) + 1 + reach, last + 1))
