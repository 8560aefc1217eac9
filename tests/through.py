"""One way across a volume at a time, for tests that look at the light itself and not at its images."""

from torch import Tensor

from torchdic import Fidelity, Rays, Volume
from torchdic.propagation import projection
from torchdic.propagation.base import propagation_of
from torchdic.rays import caustics, landing, trace


def propagate(volume: Volume, wavelength: float, momentum: Tensor, plane: float, fidelity: Fidelity) -> Tensor:
    """The spectrum (source, y, x) of each source's envelope behind a volume."""
    crossing = propagation_of(fidelity).prepare(volume, fidelity, plane)
    return crossing.spectrum(wavelength, momentum)[:, 0]


def project(volume: Volume, wavelength: float, momentum: Tensor, plane: float, fidelity: Fidelity) -> Tensor:
    """The field (source, y, x) of straight rays."""
    return projection.project(volume.sampled(fidelity.interpolation), wavelength, momentum, plane)


def ray_field(
    volume: Volume, wavelength: float, momentum: Tensor, plane: float, fidelity: Fidelity, **options
) -> Tensor:
    """The field of bent rays, (source, y, x), or (source, 2, y, x) of polarised ones."""
    field = landing.ray_field(volume.sampled(fidelity.interpolation), wavelength, momentum, plane, fidelity, **options)
    return field if options.get("polarised") else field[:, 0]


def deviation(volume: Volume, rays: Rays, fidelity: Fidelity, **options) -> trace.Deviation:
    """How bent rays deviate at the last face."""
    return trace.deviation(volume.sampled(fidelity.interpolation), rays, fidelity, **options)


def tubes_that_may_fold(volume: Volume, momentum: Tensor, fidelity: Fidelity) -> caustics.Tubes | None:
    """The tubes of a volume's rays, None where there is no caustic."""
    return caustics.tubes_that_may_fold(volume.sampled(fidelity.interpolation), momentum)
