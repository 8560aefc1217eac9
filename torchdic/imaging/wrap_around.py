"""Far from focus light spreads beyond the array's sides, and comes back in at the opposite ones unless it is cut.

The array is periodic, and what is computed is exact for a specimen that is: light that moves sideways by more than half
the array comes, where a specimen stands alone, from its images outside. Without these waves the transfer function is
the band-limited one of Matsushima & Shimobaba, Opt. Express 17, 19662 (2009): they are those whose phase turns by more
than π from one frequency of the array to the next.
"""

import math
import warnings
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from torchdic.errors import WrapAroundWarning
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition
from torchdic.scalar import number

# Part of an image's light that may wrap around unremarked: its root is about what it changes an image by.
UNREMARKED = 1e-4


@dataclass(frozen=True, eq=False)
class Spread:
    """How far each source's waves go sideways on their way to a focus.

    frequencies: of the envelopes' waves in 1/µm. na: the most that |p| of a wave can be. plane: depth in µm to which
    spectra are referred.
    """

    grid: Grid
    wavelength: float
    background: Tensor
    na: float | Tensor
    plane: float
    momentum: Float[Tensor, "source 2"]
    frequencies: Float[Tensor, "*source 2 y x"]

    def distance(self, focus: float | Tensor) -> float:
        """Of a focus in µm: from `plane` or from the volume's middle, whichever is nearer.

        A wave is referred to the last face, and back to its middle spreads no more.
        """
        depth = number(focus)
        return min(abs(depth - self.plane), abs(depth))

    @torch.no_grad()
    def beyond(self, distance: float) -> Float[Tensor, "source y x"] | None:
        """Voxels by which each wave from the array's middle has gone beyond its sides; None where none can have.

        Over a distance d a wave of momentum p moves sideways by d·p/p_z.
        """
        n0, steepest = self._steepest
        shape, spacing = self.grid.shape[1:], self.grid.spacing[1:]
        sides = [n * d for n, d in zip(shape, spacing, strict=True) if n > 1]
        if not sides or distance == 0 or distance * steepest <= min(sides) / 2:
            return None
        waves = self.momentum[:, :, None, None] + self.wavelength * self.frequencies
        squared = n0**2 - waves.square().sum(1)
        slope = waves.abs() / torch.where(squared > 0, squared, torch.inf).sqrt()[:, None]
        # across one voxel there is nowhere to go
        across = [
            distance * slope[:, axis] / d - n / 2
            for axis, (n, d) in enumerate(zip(shape, spacing, strict=True))
            if n > 1
        ]
        return torch.stack(across).amax(0)

    @cached_property
    def _steepest(self) -> tuple[float, float]:
        """The background's index, and the largest p/p_z of a wave."""
        n0, most = number(self.background), number(self.na)
        return n0, most / math.sqrt(n0**2 - most**2) if most < n0 else math.inf

    @property
    def direct(self) -> Bool[Tensor, "*source y x"]:
        """Which waves are the sources' own, which are everywhere and so leave no array."""
        return (self.frequencies == 0).all(-3)

    def cut(
        self, waves: Complex[Tensor, "*component source y x"], focus: float | Tensor
    ) -> Complex[Tensor, "*component source y x"]:
        """The waves at a focus without those that have left the array."""
        beyond = self.beyond(self.distance(focus))
        return waves if beyond is None else torch.where((beyond > 0) & ~self.direct, 0, waves)


@torch.no_grad()
def check_wrap_around(
    spectrum: Complex[Tensor, "*component source y x"],
    spread: Spread,
    weights: Float[Tensor, " source"],
    acquisition: Acquisition,
    *,
    cut: bool,
) -> None:
    """Warn with WrapAroundWarning where light from the array's middle has left the array when it comes to a focus.

    spectrum: of what the pupil passes. cut: whether that light is cut. Where nothing can leave, nothing is computed.
    """
    distance, farthest = max((spread.distance(focus), number(focus)) for focus in acquisition.focus)
    beyond = spread.beyond(distance)
    if beyond is None:
        return
    light = torch.view_as_real(spectrum).square().sum(-1)
    light = weights[:, None, None] * (light if light.ndim == 3 else light.sum(0))
    total = float(light.sum())
    light, beyond = torch.where(spread.direct, 0, light).flatten(), beyond.flatten()
    part = float(light[beyond > 0].sum()) / total if total > 0 else 0.0
    if part <= UNREMARKED:
        return
    order = beyond.argsort(descending=True)
    kept = light[order].cumsum(0) > UNREMARKED * total
    padding = math.ceil(float(beyond[order][kept].amax()))
    fate = "is cut" if cut else "comes back in at the opposite side"
    warnings.warn(
        WrapAroundWarning(
            f"focus {farthest:g} µm lies {distance:g} µm from the specimen: {100 * part:.2g} % of the light "
            f"leaves the array and {fate}; {padding} more voxels of padding would hold it",
            severity=part,
        ),
        stacklevel=3,  # torch.no_grad is a call between
    )
