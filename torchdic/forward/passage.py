"""The path of light from a specimen to its images, in batches of sources."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.imaging.intensity import Imaging
from torchdic.imaging.passband import interpolate
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.memory.batches import sum_over_sources
from torchdic.memory.budget import Batches
from torchdic.object_aberration.levels import Levels, object_levels
from torchdic.plane_waves import axial_difference, paraxial_difference, to_spectrum
from torchdic.propagation.base import Crossing, propagation_of
from torchdic.specimen.volume import Volume


@dataclass(frozen=True, eq=False)
class Passage:
    """From a volume to its images. It holds what is computed once and serves every batch of sources.

    volume: with its padding.
    microscope, acquisition, fidelity: as for `torchdic.image`.
    plane: depth in µm of the plane to which the crossing refers its light.
    crossing: the light's way through the volume.
    levels: of the object aberration, one for each colour. Empty if the fidelity names none.
    """

    volume: Volume
    microscope: Microscope
    acquisition: Acquisition
    fidelity: Fidelity
    plane: float
    crossing: Crossing
    levels: tuple[Levels, ...]

    @classmethod
    def through(
        cls, volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, levels: int = 2
    ) -> "Passage":
        """The passage of a volume without padding. levels: smallest number of levels of an object aberration."""
        propagation = propagation_of(fidelity)
        plane = propagation.reference_plane(volume, fidelity)
        padded = volume.padded(fidelity.padding)
        polarised = propagation.carries_polarisation and microscope.turns_polarisation
        crossing = propagation.prepare(padded, fidelity, plane, polarised=polarised)
        found = ()
        if fidelity.object_aberration is not None:
            found = tuple(object_levels(padded, plane, part, fidelity, levels) for part, _ in microscope.colours())
        return cls(padded, microscope, acquisition, fidelity, plane, crossing, found)

    @property
    def most_levels(self) -> int:
        """The largest number of levels of any colour; 0 if there are no levels."""
        return max((len(levels.defocus) for levels in self.levels), default=0)

    def images(self, batches: Batches) -> Float[Tensor, "prism focus y x"]:
        """The images in all colours together. Sources are computed in batches."""
        colours = self.microscope.colours()
        levels = self.levels or (None,) * len(colours)
        images = [share * self._image(part, own, batches) for (part, share), own in zip(colours, levels, strict=True)]
        return images[0] if len(images) == 1 else torch.stack(images).sum(0)

    def _image(
        self, microscope: Microscope, levels: Levels | None, batches: Batches
    ) -> Float[Tensor, "prism focus y x"]:
        """The images in light of one wavelength."""
        volume, fidelity = self.volume, self.fidelity
        scene = microscope, self.acquisition, fidelity.defocus, fidelity.band_limit
        imaging = Imaging(volume.grid, volume.background, self.plane, *scene)

        def intensity(momentum: Tensor, weights: Tensor) -> Tensor:
            def spread(field: Tensor) -> Tensor:
                return to_spectrum(field) if levels is None else self._spread(field, levels, microscope, momentum)

            wavelength, slabs = microscope.wavelength, batches.slabs
            spectrum = self.crossing.spectrum(wavelength, momentum, slabs=slabs, to_spectrum=spread)
            return imaging.intensity(spectrum, momentum, weights)

        sources = microscope.sources(fidelity.sources, dtype=volume.delta.dtype, device=volume.delta.device)
        total = sum_over_sources(intensity, sources, batches.sources)
        return seen(total, volume.grid, fidelity.padding, microscope)

    def _spread(self, field: Tensor, levels: Levels, microscope: Microscope, momentum: Tensor) -> Tensor:
        """The spectrum of a field in which each point has its own defocus."""
        waves = self.volume.grid, microscope.wavelength, self.volume.background, momentum
        paraxial = self.fidelity.defocus == "paraxial"
        difference = paraxial_difference(*waves) if paraxial else axial_difference(*waves)[0]
        return levels.spread(field, microscope.wavelength, difference)


@dataclass(frozen=True, eq=False)
class FieldPassage:
    """From a field at z = 0 to its images.

    transmission: (y, x), the same for every source, or (source, y, x).
    grid: its pixels, without padding.
    background: index of the medium, 0-d.
    microscope, acquisition, fidelity: as for `torchdic.image`.
    """

    transmission: Complex[Tensor, "*source y x"]
    grid: Grid
    background: Float[Tensor, ""]
    microscope: Microscope
    acquisition: Acquisition
    fidelity: Fidelity

    def images(self, batches: Batches) -> Float[Tensor, "prism focus y x"]:
        """The images. Sources are computed in batches."""
        pad, real = self.fidelity.padding, self.transmission.real
        grid = self.grid.widened(pad, pad)
        spectra = to_spectrum(F.pad(self.transmission, (pad,) * 4, value=1.0))
        momentum, weights = self.microscope.sources(self.fidelity.sources, dtype=real.dtype, device=real.device)

        scene = self.microscope, self.acquisition, self.fidelity.defocus, self.fidelity.band_limit
        imaging = Imaging(grid, self.background, 0.0, *scene)

        def intensity(momentum: Tensor, weights: Tensor, spectra: Tensor) -> Tensor:
            return imaging.intensity(spectra[:, None], momentum, weights)

        own = spectra if spectra.ndim == 3 else spectra.expand(len(weights), -1, -1)
        total = sum_over_sources(intensity, (momentum, weights, own), batches.sources)
        return seen(total, grid, pad, self.microscope)


def seen(
    images: Float[Tensor, "prism focus row column"], grid: Grid, padding: int, microscope: Microscope
) -> Float[Tensor, "prism focus y x"]:
    """Images without their padding, or on the camera's pixels if it has a pixel size.

    images: (prism, focus, row, column) on the padded grid, or on a coarser array, from which they are interpolated.
    grid: with padding.
    padding: voxels on each side.
    """
    _, ny, nx = grid.shape
    images = interpolate(images, (ny, nx))
    camera = microscope.camera
    if camera is not None and camera.pixel_size is not None:
        return camera.integrate(images, grid.spacing[1:], (ny - 2 * padding, nx - 2 * padding))
    return images if padding == 0 else images[..., padding:-padding, padding:-padding]
