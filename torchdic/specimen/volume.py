"""The specimen: a learnable refractive index on a grid of voxels."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from torchdic.grid import Grid
from torchdic.scalar import number, scalar
from torchdic.specimen.interpolation import Interpolation, SliceSampler, spline_coefficients, window


class Volume(nn.Module):
    """A transparent specimen of index n = background + delta on a grid of voxels.

    grid: where the voxels are.
    delta: Δn, shape (z, y, x). An nn.Parameter is learned, any other tensor keeps its graph. Everything computed from
        the volume has the dtype and device of delta.
    background: index of the medium around the specimen, a number or a 0-d tensor.
    absorption: κ ≥ 0 of the complex index n + iκ, shape (z, y, x). None is a specimen that absorbs nothing.
    Raises TypeError for what is no tensor, and ValueError if a shape is not the grid's, a dtype is neither float32 nor
    float64, an index is not a positive number, or κ is negative.
    """

    delta: Float[Tensor, "z y x"]
    background: Float[Tensor, ""]
    absorption: Float[Tensor, "z y x"] | None

    def __init__(
        self,
        grid: Grid,
        delta: Tensor,
        background: float | Tensor,
        absorption: Tensor | None = None,
    ) -> None:
        super().__init__()
        _check_field("delta", delta, grid)
        if absorption is not None:
            _check_field("absorption", absorption, grid)
            if bool((absorption < 0).any()):
                raise ValueError(f"absorption {float(absorption.detach().min()):g} is negative: κ must be at least 0")
        index = number(background)
        if not (index > 0 and index < float("inf")):
            raise ValueError(f"background {index} must be a refractive index above 0")
        lowest = index + float(delta.detach().min())
        if lowest <= 0:
            raise ValueError(f"index {lowest:g} = background {index:g} + delta must stay above 0")
        self.grid = grid
        self._keep("delta", delta)
        self._keep("background", scalar(background, delta))
        self._keep("absorption", None if absorption is None else absorption.to(delta))

    def _keep(self, name: str, value: Tensor | None) -> None:
        if isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        else:
            self.register_buffer(name, value)

    def sampled(self, interpolation: Interpolation) -> "SampledVolume":
        """The volume prepared for sampling between its voxel centres."""
        fields = [self.delta] if self.absorption is None else [self.delta, self.absorption]
        if interpolation == "cubic":
            fields = [spline_coefficients(f) for f in fields]
        return SampledVolume(self.grid, self.background, tuple(f.unbind(0) for f in fields), interpolation)

    def padded(self, margin: int) -> "Volume":
        """The volume with `margin` more voxels of the medium on each side along y and x."""
        if margin == 0:
            return self
        delta, absorption = (None if f is None else F.pad(f, (margin,) * 4) for f in (self.delta, self.absorption))
        assert delta is not None
        return Volume(self.grid.widened(margin, margin), delta, self.background, absorption)

    def mean_plane(self) -> float:
        """The |Δn|-weighted mean depth in µm, rounded to the nearest slice centre or face; 0 if Δn is 0 everywhere.

        Faces count too. Otherwise a specimen centred between two slices would be out of focus by half a slice.
        """
        weight = self.delta.detach().abs().sum((1, 2), dtype=torch.float64)
        total = float(weight.sum())
        if total == 0:
            return 0.0
        depth = self.grid.coordinates(0, dtype=torch.float64, device=weight.device)
        index = round(2 * self.grid.index(0, float((weight * depth).sum()) / total)) / 2
        return self.grid.centre(0, index)


@dataclass(frozen=True, eq=False)
class SampledVolume:
    """A volume whose Δn and κ can be sampled between voxel centres. It is made once and serves every batch of sources.

    grid: where the voxels are.
    background: index of the medium, 0-d.
    fields: the slices (y, x) of Δn, then those of κ if the volume absorbs. They are the voxels themselves for "linear",
        and spline coefficients for "cubic".
    interpolation: "linear" or "cubic".
    """

    grid: Grid
    background: Float[Tensor, ""]
    fields: tuple[tuple[Float[Tensor, "y x"], ...], ...]
    interpolation: Interpolation

    @property
    def absorbs(self) -> bool:
        """Whether the volume has an absorption."""
        return len(self.fields) > 1

    def samplers(self, between: tuple[float, float] | None = None) -> list[SliceSampler]:
        """A sampler of each field. between: two depths in µm; the samplers then hold only the slices needed there."""
        near = slice(0, None) if between is None else window(self.grid, *between, self.interpolation)
        return [SliceSampler(self.grid, slices[near], self.interpolation, near.start) for slices in self.fields]


def _check_field(name: str, field: Tensor, grid: Grid) -> None:
    if not isinstance(field, Tensor):
        raise TypeError(f"{name} is of {type(field)}: it must be a tensor, as torch.as_tensor makes one")
    if tuple(field.shape) != grid.shape:
        raise ValueError(f"{name} has shape {tuple(field.shape)}, the grid has {grid.shape} (z, y, x)")
    if field.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} has dtype {field.dtype}: it must be torch.float32 or torch.float64")
    if not bool(torch.isfinite(field).all()):
        raise ValueError(f"{name} holds {int((~torch.isfinite(field)).sum())} values that are not finite")
