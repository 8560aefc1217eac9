"""From the field behind the specimen to images: pupil, defocus, prism, polarisers, intensity."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Defocus
from torchdic.grid import Grid
from torchdic.imaging.passband import Passband
from torchdic.imaging.wrap_around import Spread, check_wrap_around
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.instrument.polarisation import unpolarised
from torchdic.instrument.polarised_lenses import product, turn
from torchdic.plane_waves import axial_difference, exp_i, paraxial_difference, to_field


def form_image(
    spectrum: Complex[Tensor, "source *component y x"],
    grid: Grid,
    background: Tensor,
    plane: float,
    momentum: Float[Tensor, "source 2"],
    weights: Float[Tensor, " source"],
    microscope: Microscope,
    acquisition: Acquisition,
    defocus: Defocus = "exact",
    *,
    band_limit: bool = False,
) -> Float[Tensor, "prism focus row column"]:
    """Σ over sources of weight·|F⁻¹[D·pupil·defocus·S]|², the spectra S referred to depth `plane` (µm).

    It comes on the grid's pixels or, where the pupil passes little of what these hold, on fewer that hold it exactly:
    `interpolate` then brings it, and sums of several batches of sources, to the grid's.

    Pupil and defocus act on the field's frequency f + f_s, the prism's shear on the envelope's f if a condenser prism
    makes up for the tilt. Behind a pupil of Jones matrices it is the sum over pure states of the light, each with a D
    of its own, see `Polarisation.transfers`. spectrum: with the components of `propagate` where rays are turned.
    """
    wavelength, objective = microscope.wavelength, microscope.objective
    turned = spectrum.ndim == 4
    if turned:
        spectrum = spectrum.movedim(1, 0)
    band = None if objective is None else Passband.around(grid, wavelength, objective.na, momentum)
    if band is None:
        frequencies = grid.frequencies(dtype=momentum.dtype, device=momentum.device)
    else:
        spectrum, frequencies = band.window(spectrum), band.frequencies
    difference, pz = axial_difference(grid, wavelength, background, momentum, frequencies)
    passes = pz > 0
    if defocus == "paraxial":
        difference = paraxial_difference(grid, wavelength, background, momentum, frequencies)
    if objective is not None:
        waves = momentum[:, :, None, None] + wavelength * frequencies
        passes = passes & objective.aperture(waves)
        pupil = objective.transfer(waves, momentum, wavelength, background)
        if pupil is not None:
            spectrum = spectrum * pupil
    spectrum = torch.where(passes, spectrum, 0)
    na = background if objective is None else objective.na
    spread = Spread(grid, wavelength, background, na, plane, momentum, frequencies)
    check_wrap_around(spectrum, spread, weights, acquisition, cut=band_limit)
    if not microscope.condenser_prism or microscope.vectorial:
        frequencies = frequencies + momentum[:, :, None, None] / wavelength
    shape = grid.shape[1:] if band is None else band.shape
    k0 = 2 * math.pi / wavelength

    def sharp(focus: float | Tensor) -> Tensor:
        # a number stays one: brought to another device, it would be waited for
        depth = focus.to(difference) if isinstance(focus, Tensor) else focus
        wave = spectrum * exp_i(k0 * (depth - plane) * difference)
        return spread.cut(wave, focus) if band_limit else wave

    if microscope.vectorial:
        transfers = _state_transfers(frequencies, passes, momentum, background, microscope, acquisition, turned)
        images = []
        for focus in acquisition.focus:
            wave = sharp(focus)
            for shares, transfer in transfers:
                field = to_field((transfer * wave).sum(1), shape)
                images.append(torch.einsum("tsyxc,s,t->yx", torch.view_as_real(field).square(), weights, shares))
    else:
        images = _scalar_images(sharp, frequencies, shape, weights, microscope, acquisition)
    return torch.stack(images).unflatten(0, (len(acquisition.focus), len(acquisition.prisms))).transpose(0, 1)


def _scalar_images(
    sharp: Callable[[float | Tensor], Tensor],
    frequencies: Tensor,
    shape: tuple[int, int],
    weights: Tensor,
    microscope: Microscope,
    acquisition: Acquisition,
) -> list[Tensor]:
    """The images of each focus and prism where lenses leave polarisation alone, so that the beams are a scalar pair."""
    polarisation = microscope.polarisation
    if polarisation is not None and polarisation.ideal:
        polarisation = None
    transfers = [None if prism is None else prism.transfer(frequencies) for prism in acquisition.prisms]
    images = []
    for focus in acquisition.focus:
        wave = sharp(focus)
        for prism, transfer in zip(acquisition.prisms, transfers, strict=True):
            field = to_field(wave if transfer is None else wave * transfer, shape)
            if prism is None or polarisation is None:
                # over the sources first: a sum over two neighbours in memory is slow
                images.append(torch.tensordot(weights, torch.view_as_real(field).square(), 1).sum(-1))
            else:
                stopped = to_field(wave * prism.parallel(frequencies), shape)
                images.append(torch.einsum("syx,s->yx", polarisation.intensity(field, stopped, prism.bias), weights))
    return images


def _state_transfers(
    frequencies: Tensor,
    passes: Tensor,
    momentum: Tensor,
    background: Tensor,
    microscope: Microscope,
    acquisition: Acquisition,
    turned: bool,
) -> list[tuple[Tensor, Tensor]]:
    """For each prism the shares of the light's pure states and what multiplies the spectrum for each of them.

    frequencies: the field's f + f_s.
    """
    polarisation, objective = microscope.polarisation, microscope.objective
    assert polarisation is not None
    assert polarisation.pupil is not None
    # what the aperture stops would overflow, far outside it, in the polynomials and what is made of them
    waves = torch.where(passes[:, None], microscope.wavelength * frequencies, 0)
    matrix = None if objective is None else polarisation.pupil.lenses(waves / objective.na)
    if polarisation.pupil.depolarisation and not turned:
        tilted = turn(waves, momentum, background)
        matrix = tilted if matrix is None else product(matrix, tilted)
    if matrix is None:  # bent rays through plain lenses
        matrix = torch.eye(2, dtype=momentum.dtype, device=momentum.device)[None, :, :, None, None]
    direct = momentum[:, :, None, None] / microscope.wavelength
    transfers = []
    for prism in acquisition.prisms:
        if prism is None:
            transfers.append(unpolarised(matrix, turned=turned))
            continue
        tilt = prism.shear_phase(direct)[:, 0, 0] if microscope.condenser_prism else None
        half, axis = prism.shear_phase(frequencies), prism.polarised_along(momentum)
        transfers.append(polarisation.transfers(matrix, half, tilt, axis, prism.bias, turned=turned))
    return transfers
