"""Values and transverse gradients between voxel centres, one slice at a time.

All rays of a source are at the same depth. A 3-D interpolation is therefore a 2-D one in the slice blended for that
depth, and its backward pass touches two (linear) or four (cubic) slices instead of the whole volume.

Outside the outermost voxel centres a field is constant, so its gradient there is 0.
"""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from torchdic.grid import Grid

Interpolation = Literal["linear", "cubic"]


class SliceSampler:
    """Samples a field of voxels at one depth and many transverse positions.

    grid: of the whole field.
    slices: the field's 2-D slices first … first + len(slices) − 1. For "cubic" those of its spline coefficients (see
        `spline_coefficients`).
    interpolation: "linear" or "cubic".
    first: index of the first slice.
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
        self._around: dict[int, Tensor] = {}
        self._blended: tuple[float, Tensor] | None = None

    def sample(self, z: float, y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]) -> Float[Tensor, "3 *ray"]:
        """The field and its derivatives along y and x (1/µm) at depth z and positions (y, x) in µm."""
        if self.interpolation == "cubic":
            return self.sample_plane(self.plane(z), y, x)
        return self._sample_channels(self._channels(z), y, x)

    def value(self, z: float, y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]) -> Float[Tensor, " *ray"]:
        """The field alone at depth z and positions (y, x) in µm."""
        return self.value_plane(self.plane(z), y, x)

    def plane(self, z: float) -> Float[Tensor, "y x"]:
        """The slice blended for depth z (µm). For "cubic" it holds spline coefficients."""
        weights = depth_weights(self.grid, z, self.interpolation)
        (first, weight), *others = weights.items()
        field = self.slices[first - self.first] * weight
        for i, weight in others:
            field = field.add(self.slices[i - self.first], alpha=weight)
        return field

    def sample_plane(
        self, field: Float[Tensor, "y x"], y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]
    ) -> Float[Tensor, "3 *ray"]:
        """Like `sample`, in a slice that `plane` blended."""
        if self.interpolation == "cubic":
            (dy, dx), (value, slope_y, slope_x) = self.grid.spacing[1:], _sample_cubic(field, *self._indices(y, x))
            return torch.stack((value, slope_y / dy, slope_x / dx))
        return self._sample_channels(self._with_slopes(field), y, x)

    def value_plane(
        self, field: Float[Tensor, "y x"], y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"]
    ) -> Float[Tensor, " *ray"]:
        """Like `value`, in a slice that `plane` blended."""
        if self.interpolation == "cubic":
            return _sample_cubic(field, *self._indices(y, x))[0]
        return _grid_sample(_thick(field[None]), self._where(y, x)).reshape(y.shape)

    def pull_back(
        self, z: float, y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"], sampled_bar: Float[Tensor, "3 *ray"]
    ) -> tuple[Float[Tensor, "2 *ray"], Float[Tensor, "y x"] | None]:
        """The loss's derivatives with respect to (y, x), and with respect to the plane at depth z.

        sampled_bar: those with respect to the result of `sample`.
        Builds no graph. The plane's derivative is None if no slice requires grad.
        """
        learned = any(s.requires_grad for s in self.slices)
        with torch.no_grad():
            if self.interpolation == "cubic":
                return _by_autograd(self.sample_plane, self.plane(z), y, x, sampled_bar, learned)
            channels, where = self._channels(z), self._where(y, x, ring=1)
            # the function that autograd would call, without a second forward pass
            shared, (share, _, rays, _) = _shared(channels, where), where.shape
            shared_bar, where_bar = torch.ops.aten.grid_sampler_2d_backward(
                sampled_bar.reshape(3, share, 1, rays).transpose(0, 1), shared, where, 0, 1, True, [learned, True]
            )
            scale_y, scale_x = self._scales(ring=1)
            place_bar = sampled_bar.new_empty(2, share, rays)
            torch.mul(where_bar[:, 0, :, 1], scale_y, out=place_bar[0])
            torch.mul(where_bar[:, 0, :, 0], scale_x, out=place_bar[1])
            plane_bar = self._with_slopes_pull_back(shared_bar.sum(0)) if learned else None
            return place_bar.reshape(2, *y.shape), plane_bar

    def pull_back_value(
        self, z: float, y: Float[Tensor, " *ray"], x: Float[Tensor, " *ray"], value_bar: Float[Tensor, " *ray"]
    ) -> tuple[Float[Tensor, "2 *ray"], Float[Tensor, "y x"] | None]:
        """Like `pull_back`, for `value`."""
        learned = any(s.requires_grad for s in self.slices)
        with torch.no_grad():
            return _by_autograd(self.value_plane, self.plane(z), y, x, value_bar, learned)

    def _sample_channels(self, channels: Float[Tensor, "3 yy xx"], y: Tensor, x: Tensor) -> Float[Tensor, "3 *ray"]:
        return _grid_sample(channels, self._where(y, x, ring=1)).reshape(3, *y.shape)

    def _channels(self, z: float) -> Float[Tensor, "3 yy xx"]:
        """`_with_slopes` of the slice blended for depth z."""
        if torch.is_grad_enabled():
            return self._with_slopes(self.plane(z))
        if self._blended is not None and self._blended[0] == z:  # a step begins where another one ended
            return self._blended[1]
        # the slopes of a blend are the blend of the slopes, so those of a slice are kept while rays are beside it
        weights = depth_weights(self.grid, z, "linear")
        known = self._around
        self._around = {i: known[i] if i in known else self._with_slopes(self.slices[i - self.first]) for i in weights}
        (channels, *others), (_, *further) = self._around.values(), weights.values()
        self._blended = z, torch.lerp(channels, others[0], further[0]) if others else channels
        return self._blended[1]

    def _with_slopes(self, field: Float[Tensor, "y x"]) -> Float[Tensor, "3 yy xx"]:
        """A field and its central differences along y and x, with one more ring of voxels."""
        dy, dx = self.grid.spacing[1:]
        # Two rings of edge values: the central differences fall to 0 within one voxel beyond the edge.
        padded = F.pad(field[None], (2, 2, 2, 2), mode="replicate")[0]
        slopes_y = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * dy)
        slopes_x = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * dx)
        return torch.stack((padded[1:-1, 1:-1], slopes_y, slopes_x))

    def _with_slopes_pull_back(self, channels_bar: Float[Tensor, "3 yy xx"]) -> Float[Tensor, "y x"]:
        """The transpose of `_with_slopes`."""
        dy, dx = self.grid.spacing[1:]
        value_bar, slopes_y_bar, slopes_x_bar = channels_bar
        padded_bar = F.pad(value_bar, (1, 1, 1, 1))
        padded_bar[2:, 1:-1].add_(slopes_y_bar, alpha=1 / (2 * dy))
        padded_bar[:-2, 1:-1].sub_(slopes_y_bar, alpha=1 / (2 * dy))
        padded_bar[1:-1, 2:].add_(slopes_x_bar, alpha=1 / (2 * dx))
        padded_bar[1:-1, :-2].sub_(slopes_x_bar, alpha=1 / (2 * dx))
        rows_bar = padded_bar[2:-2]
        rows_bar[0].add_(padded_bar[:2].sum(0))
        rows_bar[-1].add_(padded_bar[-2:].sum(0))
        field_bar = rows_bar[:, 2:-2]
        field_bar[:, 0].add_(rows_bar[:, :2].sum(1))
        field_bar[:, -1].add_(rows_bar[:, -2:].sum(1))
        return field_bar

    def _scales(self, ring: int = 0) -> tuple[float, float]:
        """Factors from µm to grid_sample's coordinates of y and x, −1 at the first voxel and 1 at the last."""
        (ny, nx), (dy, dx) = self.grid.shape[1:], self.grid.spacing[1:]
        return 2 / (dy * (max(ny + 2 * ring, 2) - 1)), 2 / (dx * (max(nx + 2 * ring, 2) - 1))

    def _where(self, y: Tensor, x: Tensor, ring: int = 0) -> Float[Tensor, "share 1 ray 2"]:
        """Positions in µm as grid_sample's coordinates (x, y), on a field with `ring` more voxels on each side."""
        scale_y, scale_x = self._scales(ring)
        # x and y in separate rows of memory, which is fastest for the kernel
        if torch.is_grad_enabled():
            where = torch.stack((x * scale_x, y * scale_y))
        else:
            where = x.new_empty(2, *x.shape)
            torch.mul(x, scale_x, out=where[0])
            torch.mul(y, scale_y, out=where[1])
        return where.reshape(2, shares(self.grid, y.numel(), y.device), 1, -1).permute(1, 2, 3, 0)

    def _indices(self, y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        (ny, nx), (dy, dx) = self.grid.shape[1:], self.grid.spacing[1:]
        return y / dy + (ny - 1) / 2, x / dx + (nx - 1) / 2


def _thick(channels: Float[Tensor, "c y x"]) -> Float[Tensor, "c yy xx"]:
    """Channels at least two voxels wide: between −1 and 1 grid_sample's coordinates need two points."""
    for axis in (1, 2):
        if channels.shape[axis] == 1:
            channels = channels.repeat_interleave(2, axis)
    return channels


def _grid_sample(
    channels: Float[Tensor, "c y x"], where: Float[Tensor, "share 1 ray 2"]
) -> Float[Tensor, "c share ray"]:
    shared = _shared(channels, where)
    return F.grid_sample(shared, where, padding_mode="border", align_corners=True)[:, :, 0].transpose(0, 1)


def _shared(channels: Float[Tensor, "c y x"], where: Float[Tensor, "share 1 ray 2"]) -> Float[Tensor, "share c y x"]:
    return channels.expand(len(where), *channels.shape)


def _by_autograd(
    sample: Callable[..., Tensor], plane: Tensor, y: Tensor, x: Tensor, sampled_bar: Tensor, learned: bool
) -> tuple[Tensor, Tensor | None]:
    """The loss's derivatives by (y, x) and, if learned, by the plane, from those by sample(plane, y, x)."""
    inputs = [v.detach().requires_grad_() for v in ((y, x, plane) if learned else (y, x))]
    with torch.enable_grad():
        sampled = sample(inputs[2] if learned else plane, inputs[0], inputs[1])
    y_bar, x_bar, *plane_bar = torch.autograd.grad(sampled, inputs, sampled_bar)
    return torch.stack((y_bar, x_bar)), plane_bar[0] if learned else None


def shares(grid: Grid, rays: int, device: torch.device) -> int:
    """The number of equal parts that `SliceSampler` makes of that many rays.

    grid_sample gives each part to a thread of the CPU. Rays of shape (share, ray) are divided without a copy. Each part
    adds up the slice's gradient by itself, so a part has at least a quarter as many rays as the slice has voxels.
    """
    if device.type != "cpu":
        return 1
    _, ny, nx = grid.shape
    most = min(torch.get_num_threads(), 4 * rays // (ny * nx))
    return next((count for count in range(most, 1, -1) if rays % count == 0), 1)


def depth_weights(grid: Grid, z: float, interpolation: Interpolation) -> dict[int, float]:
    """The slices on which the field at depth z (µm) depends, with their weights."""
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
    """Coefficients of the cubic B-spline (C²) through a field's voxels. The field is mirrored at its ends."""
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
    """A spline and its derivatives along y and x at fractional indices."""
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
    # a ray that can't go on is nan: it reads at index 0, and its weights stay nan
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
