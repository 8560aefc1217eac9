"""Far from focus light spreads beyond the array's sides, and comes back in at the opposite ones."""

import math
import warnings

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.grid import Grid
from torchdic.instrument import Acquisition

# Part of an image's light that may wrap around unremarked: its root is about what it changes an image by.
UNREMARKED = 1e-4


class WrapAroundWarning(UserWarning):
    """A focus so far from the specimen that its light wraps around the array."""


@torch.no_grad()
def check_wrap_around(
    spectrum: Complex[Tensor, "*component source y x"],
    frequencies: Float[Tensor, "*source 2 y x"],
    grid: Grid,
    wavelength: float,
    background: Tensor,
    na: float | Tensor,
    plane: float,
    momentum: Float[Tensor, "source 2"],
    weights: Float[Tensor, " source"],
    acquisition: Acquisition,
) -> None:
    """Warn with WrapAroundWarning where light from the array's middle has left the array when it comes to a focus.

    Over a distance d a wave of momentum p moves sideways by d·p/p_z; the direct light, which is everywhere, apart.
    spectrum: of what the pupil passes, referred to depth `plane` (µm), at these frequencies (1/µm). The distance is
    that from `plane` or from the volume's middle, whichever is nearer: a wave is referred to the last face, and back to
    its middle spreads no more. na: the most that |p| can be. Where even that stays within the array, nothing is
    computed.
    """
    depths = [float(torch.as_tensor(focus).detach()) for focus in acquisition.focus]
    distance, farthest = max((min(abs(depth - plane), abs(depth)), depth) for depth in depths)
    n0, most = float(background), float(na)
    sides = [n * d for n, d in zip(grid.shape[1:], grid.spacing[1:], strict=True) if n > 1]
    steepest = most / math.sqrt(n0**2 - most**2) if most < n0 else math.inf
    if not sides or distance == 0 or distance * steepest <= min(sides) / 2:
        return
    waves = momentum[:, :, None, None] + wavelength * frequencies
    squared = n0**2 - waves.square().sum(1)
    slope = waves.abs() / torch.where(squared > 0, squared, torch.inf).sqrt()[:, None]
    # voxels by which a wave from the middle has gone beyond the sides; across one voxel there is nowhere to go
    size, spacing = (momentum.new_tensor(v)[:, None, None] for v in (grid.shape[1:], grid.spacing[1:]))
    beyond = distance * slope / spacing - size / 2
    beyond = torch.where(size > 1, beyond, -torch.inf).amax(1)
    light = torch.view_as_real(spectrum).square().sum(-1)
    light = weights[:, None, None] * (light if light.ndim == 3 else light.sum(0))
    total = float(light.sum())
    light = torch.where((frequencies == 0).all(-3), 0, light)
    light, beyond = light.flatten(), beyond.flatten()
    part = float(light[beyond > 0].sum()) / total if total > 0 else 0.0
    if part <= UNREMARKED:
        return
    order = beyond.argsort(descending=True)
    kept = light[order].cumsum(0) > UNREMARKED * total
    padding = math.ceil(float(beyond[order][kept].amax()))
    warnings.warn(
        f"focus {farthest:g} µm lies {distance:g} µm from the specimen: {100 * part:.2g} % of the light "
        f"leaves the array and comes back in at the opposite side; {padding} more voxels of padding would hold it",
        WrapAroundWarning,
        stacklevel=2,
    )
