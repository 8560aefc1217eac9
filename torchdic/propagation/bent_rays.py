"""Bent rays, with their amplitude, caustics and polarisation, by the ray ODE."""

from collections.abc import Iterable
from dataclasses import dataclass

from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.plane_waves import to_spectrum
from torchdic.propagation.base import Crossing, Propagation, ToSpectrum
from torchdic.rays.landing import ray_field
from torchdic.specimen.volume import SampledVolume, Volume

# Work of a step in FFTs of a field, measured on a CPU from 64² to 256² pixels.
STEP = 260.0


class BentRays(Propagation):
    """Rays that bend along the gradient of the index."""

    name = "rays"
    spreads = False
    carries_polarisation = True
    small_batches = True
    # rays that go straight on land just on pixels, which gives 8 pairs of triangle and pixel to test per pixel, not 2
    holds_by_content = True

    def check(self, fidelity: Fidelity) -> None:
        """An object aberration stands in for the amplitude, so rays can't have both."""
        if fidelity.object_aberration is not None and fidelity.amplitude:
            raise ValueError(
                f"object_aberration {fidelity.object_aberration!r} double-counts what the rays' amplitude does: "
                "amplitude must be false"
            )

    def prepare(self, volume: Volume, fidelity: Fidelity, plane: float, *, polarised: bool = False) -> "TracedRays":
        """The rays through a volume."""
        return TracedRays(volume.sampled(fidelity.interpolation), fidelity, plane, polarised)

    def work(self, grid: Grid, fidelity: Fidelity, *, absorbs: bool) -> float:
        """The ray ODE is solved for each pixel in every step."""
        return (fidelity.steps or grid.shape[0]) * STEP

    def rungs(self, grid: Grid, margin: int) -> Iterable[tuple[Fidelity, str | None]]:
        """Few sources and long steps: more of either costs much and gains little."""
        steps = max(1, grid.shape[0] // 4)
        return [(Fidelity(self.name, sources=sources, steps=steps), None) for sources in (12, 24)]


@dataclass(frozen=True, eq=False)
class TracedRays(Crossing):
    """Bent rays through a volume, as a field at depth `plane` (µm)."""

    volume: SampledVolume
    fidelity: Fidelity
    plane: float
    polarised: bool

    def spectrum(
        self,
        wavelength: float,
        momentum: Float[Tensor, "source 2"],
        *,
        slabs: bool = False,
        to_spectrum: ToSpectrum = to_spectrum,
    ) -> Complex[Tensor, "source component y x"]:
        """The spectrum of each source's envelope, see `Crossing.spectrum`."""
        rays = self.volume, wavelength, momentum, self.plane, self.fidelity
        return to_spectrum(ray_field(*rays, polarised=self.polarised, slabs=slabs))
