"""From the spectrum of the field behind the specimen to the intensity of each image."""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Defocus
from torchdic.grid import Grid
from torchdic.imaging.coherent import coherent_images
from torchdic.imaging.passband import Passband
from torchdic.imaging.polarised import polarised_images, state_transfers
from torchdic.imaging.pupil import Pupil, Waves
from torchdic.imaging.wrap_around import Spread, check_wrap_around
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.plane_waves import exp_i, to_field
from torchdic.scalar import number


@dataclass(frozen=True, eq=False)
class Imaging:
    """What all images of one wavelength have in common, whichever sources light them.

    grid: the array that holds the field behind the specimen, padding included.
    background: refractive index of the medium, 0-d.
    plane: depth in µm to which spectra are referred.
    microscope: of one wavelength; `Microscope.colours` gives one for each wavelength of a spectrum.
    acquisition: prisms and focus planes of the images.
    defocus: exact or paraxial, see `Fidelity`.
    band_limit: whether light that leaves the array on its way to a focus is cut, see `torchdic.imaging.wrap_around`.
    """

    grid: Grid
    background: Tensor
    plane: float
    microscope: Microscope
    acquisition: Acquisition
    defocus: Defocus = "exact"
    band_limit: bool = False

    def intensity(
        self,
        spectrum: Complex[Tensor, "source component y x"],
        momentum: Float[Tensor, "source 2"],
        weights: Float[Tensor, " source"],
    ) -> Float[Tensor, "prism focus row column"]:
        """The images' intensity, Σ over sources of weight·|F⁻¹[D·pupil·defocus·S]|².

        spectrum: S of each source's envelope at the depth `plane`. It has one component where light is a scalar, and
        two where rays carry their polarisation: along +x and +y, for light that comes in polarised along +x.
        momentum: n·sinθ of each source, as (y, x).
        weights: the sources' shares of the light.

        Pupil and defocus act at the field's frequency f + f_s. The prism's factor D = sin(π f·s + bias/2) acts at the
        envelope's frequency f if a condenser prism cancels the tilt's phase, and at f + f_s if not. Where lenses act
        on polarisation, the image is a sum over the light's pure states, each with a D of its own
        (`torchdic.imaging.polarised`).

        The intensity is on the grid's pixels, or on fewer pixels where the pupil passes so few frequencies that these
        hold the intensity exactly. `interpolate` brings it to the grid's pixels, once for all batches of sources.
        """
        microscope, acquisition, components = self.microscope, self.acquisition, spectrum.shape[1]
        wavelength, objective = microscope.wavelength, microscope.objective
        band = None if objective is None else Passband.around(self.grid, wavelength, self._radius, momentum)
        if band is None:
            frequencies = self.grid.frequencies(dtype=momentum.dtype, device=momentum.device)
            shape = self.grid.shape[1:]
        else:
            spectrum, frequencies, shape = band.window(spectrum), band.frequencies, band.shape
        waves = Waves(self.grid, wavelength, self.background, momentum, frequencies)
        pupil = Pupil.of(objective, waves, self.defocus)
        spectrum = pupil.through(spectrum)
        spread = Spread(waves, self._radius, self.plane)
        check_wrap_around(spectrum, spread, weights, acquisition, cut=self.band_limit)
        defocus = self._defocus(pupil.difference, spread)
        if microscope.lenses is not None:
            transfers = state_transfers(waves, pupil.passes, microscope, acquisition, components)
            images = polarised_images((spectrum * E[:, None] for E in defocus), transfers, weights, shape)
        else:
            seen_by_prism = frequencies if microscope.condenser_prism else waves.field_frequencies()
            images = self._scalar_images(spectrum.squeeze(1), defocus, seen_by_prism, weights, shape)
        return torch.stack(images).unflatten(0, (len(acquisition.focus), len(acquisition.prisms))).transpose(0, 1)

    @cached_property
    def _radius(self) -> float:
        """The largest |p| of a wave that passes; found once, because on a GPU the program waits for it."""
        n0, objective = number(self.background), self.microscope.objective
        return n0 if objective is None else objective.reach(n0)

    def _defocus(self, difference: Tensor, spread: Spread) -> Iterator[Tensor]:
        """The factor (source, y, x) of each wave on its way to one focus after the other."""
        k0 = 2 * math.pi / self.microscope.wavelength
        for focus in self.acquisition.focus:
            # a number stays a number: to bring a tensor to another device would make the program wait for it
            depth = focus.to(difference) if isinstance(focus, Tensor) else focus
            factor = exp_i(k0 * (depth - self.plane) * difference)
            yield spread.cut(factor, focus) if self.band_limit else factor

    def _scalar_images(
        self, spectrum: Tensor, defocus: Iterable[Tensor], frequencies: Tensor, weights: Tensor, shape: tuple[int, int]
    ) -> list[Tensor]:
        """The images of each focus and prism where lenses leave polarisation alone: the two beams are scalar fields.

        spectrum: (source, y, x). frequencies: at which the prism acts. shape: of the images (y, x).
        """
        polarisers, prisms = self.microscope.polarisers, self.acquisition.prisms
        transfers = [
            torch.ones_like(frequencies[..., 0, :, :]) if prism is None else prism.transfer(frequencies)
            for prism in prisms
        ]
        transfers = [transfer if transfer.ndim == 3 else transfer[None] for transfer in transfers]
        if polarisers is None:
            return [
                image for factor in defocus for image in coherent_images(spectrum, factor, transfers, weights, shape)
            ]
        images = []
        for factor in defocus:
            wave = spectrum * factor
            for prism, transfer in zip(prisms, transfers, strict=True):
                field = to_field(wave * transfer, shape)
                if prism is None:
                    images.append(torch.tensordot(weights, torch.view_as_real(field).square(), 1).sum(-1))
                    continue
                stopped = to_field(wave * prism.parallel(frequencies), shape)
                images.append(torch.einsum("syx,s->yx", polarisers.intensity(field, stopped, prism.bias), weights))
        return images
