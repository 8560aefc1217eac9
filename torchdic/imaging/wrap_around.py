"""Far from focus light spreads beyond the array's sides and comes back in at the opposite sides, unless it is cut.

The array is periodic, and its images are exact for a periodic specimen. Where a specimen stands alone, light that moves
sideways by more than half the array comes from the specimen's periodic copies outside. If such waves are cut, the
transfer function is the band-limited one of Matsushima & Shimobaba, Opt. Express 17, 19662 (2009): it leaves out the
waves whose phase turns by more than π from one frequency of the array to the next.
"""

import math
import warnings
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from torchdic.errors import WrapAroundWarning
from torchdic.imaging.pupil import Waves
from torchdic.instrument.microscope import Acquisition
from torchdic.scalar import number

# No warning where no more than this part of an image's light wraps around; its root is about the change of the image.
UNREMARKED = 1e-4


@dataclass(frozen=True, eq=False)
class Spread:
    """How far each source's waves move sideways on their way to a focus.

    waves: the waves behind the specimen.
    na: the largest |p| of a wave that passes.
    plane: depth in µm to which spectra are referred.
    """

    waves: Waves
    na: float
    plane: float

    def distance(self, focus: float | Tensor) -> float:
        """Distance in µm over which waves spread to a focus: from `plane` or from the volume's middle, the nearer one.

        A wave may be referred to the volume's last face; to go back from there to the middle spreads it no further.
        """
        depth = number(focus)
        return min(abs(depth - self.plane), abs(depth))

    @torch.no_grad()
    def beyond(self, distance: float) -> Float[Tensor, "source y x"] | None:
        """How many voxels beyond the array's sides each wave goes that starts in the array's middle.

        Over a distance d a wave of momentum p moves sideways by d·p/p_z. None where no wave can leave the array.
        """
        waves, (n0, steepest) = self.waves, self._steepest
        shape, spacing = waves.grid.shape[1:], waves.grid.spacing[1:]
        sides = [n * d for n, d in zip(shape, spacing, strict=True) if n > 1]
        if not sides or distance == 0 or distance * steepest <= min(sides) / 2:
            return None
        momentum = waves.transverse_momentum()
        squared = n0**2 - momentum.square().sum(1)
        slope = momentum.abs() / torch.where(squared > 0, squared, torch.inf).sqrt()[:, None]
        # an axis of one voxel has no sides to leave by
        across = [
            distance * slope[:, axis] / d - n / 2
            for axis, (n, d) in enumerate(zip(shape, spacing, strict=True))
            if n > 1
        ]
        return torch.stack(across).amax(0)

    @cached_property
    def _steepest(self) -> tuple[float, float]:
        """The background's index, and the largest p/p_z of a wave."""
        n0, most = number(self.waves.background), self.na
        return n0, most / math.sqrt(n0**2 - most**2) if most < n0 else math.inf

    @property
    def direct(self) -> Bool[Tensor, "*source y x"]:
        """Which waves are the sources' own, f = 0: they fill all of space, so they leave no array."""
        return (self.waves.frequencies == 0).all(-3)

    def cut(self, factor: Complex[Tensor, "source y x"], focus: float | Tensor) -> Complex[Tensor, "source y x"]:
        """The factor of the waves at a focus, 0 for the waves that have left the array."""
        beyond = self.beyond(self.distance(focus))
        if beyond is None:
            return factor
        return torch.where((beyond > 0) & ~self.direct, 0, factor)


@torch.no_grad()
def check_wrap_around(
    spectrum: Complex[Tensor, "source component y x"],
    spread: Spread,
    weights: Float[Tensor, " source"],
    acquisition: Acquisition,
    *,
    cut: bool,
) -> None:
    """Warn with WrapAroundWarning where light from the array's middle leaves the array on its way to a focus.

    spectrum: of the light that passes the pupil.
    weights: the sources' shares of the light.
    cut: whether the light that leaves is cut.

    Where no light can leave, nothing is computed.
    """
    distance, farthest = max((spread.distance(focus), number(focus)) for focus in acquisition.focus)
    beyond = spread.beyond(distance)
    if beyond is None:
        return
    light = weights[:, None, None] * torch.view_as_real(spectrum).square().sum((1, -1))
    total = float(light.sum())
    light, beyond = torch.where(spread.direct, 0, light).flatten(), beyond.flatten()
    part = float(light[beyond > 0].sum()) / total if total > 0 else 0.0
    if part <= UNREMARKED:
        return
    order = beyond.argsort(descending=True)
    kept = light[order].cumsum(0) > UNREMARKED * total
    padding = math.ceil(float(beyond[order][kept].amax()))
    fate = "is cut" if cut else "comes back in at the opposite side"
    advice = "" if cut else ", and band_limit = true would cut it"
    warnings.warn(
        WrapAroundWarning(
            f"focus {farthest:g} µm lies {distance:g} µm from the specimen: {100 * part:.2g} % of the light "
            f"leaves the array and {fate}; {padding} more voxels of padding would hold it{advice}",
            severity=part,
        ),
        stacklevel=3,  # the caller: torch.no_grad adds a call between
    )
