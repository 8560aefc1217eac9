"""From the field behind the specimen to images: pupil, defocus, prism, polarisers, intensity."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Defocus
from torchdic.grid import Grid
from torchdic.instrument import Acquisition, Microscope
from torchdic.jones import unpolarised
from torchdic.jones_pupil import product, turn
from torchdic.passband import Passband, sizes
from torchdic.recompute import Demand
from torchdic.wave import axial_difference, exp_i, paraxial_difference, to_field
from torchdic.wrap_around import Spread, check_wrap_around

# Values per source and pixel that autograd keeps of a pupil of Jones matrices, all of whose terms are learned.
KEPT_BY_MATRIX = 50


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


def demand_of_imaging(
    grid: Grid, microscope: Microscope, acquisition: Acquisition, components: int = 1, *, learned: bool = False
) -> Demand:
    """What `form_image` holds; measured by `python benchmarks/memory.py`.

    components: of the spectrum. learned: whether the microscope or acquisition is, and not the specimen alone.
    """
    focus, prisms, polarisation = len(acquisition.focus), acquisition.prisms, microscope.polarisation
    objective, images = microscope.objective, len(acquisition.focus) * len(acquisition.prisms)
    wavelength = min(part.wavelength for part, _ in microscope.colours())
    found = None if objective is None else sizes(grid, wavelength, objective.na)
    # of the array's pixels, the parts that are waves of a window and pixels of a field
    window, field = (math.prod(shape) / math.prod(grid.shape[1:]) for shape in found) if found else (1.0, 1.0)
    # a window's frequencies and their indices are each source's own, the whole array's are common to all
    indexed, shared = (2.25, 0) if found else (0, 3 + 2 * len(prisms))
    # images of a coarser array are brought to the grid's pixels at last
    last = 4 * images if field < 1 else 0
    lens = 0
    if objective is not None:
        lens = 2 * bool(objective.aberrations or objective.layer or objective.apodisation)
    if microscope.vectorial:
        assert polarisation is not None
        assert polarisation.pupil is not None
        pupil = polarisation.pupil
        states = [4 if prism is None else polarisation.states for prism in prisms]
        transfers = 2 * components * sum(states)
        factors = bool(pupil.retardance) + bool(pupil.diattenuation) + (pupil.depolarisation and components == 1)
        beams = max((polarisation.states for prism in prisms if prism is not None), default=0)
        making = max(46 if factors > 1 else 31, 29 + transfers + 6 * beams) + 2 * indexed
        matrix = KEPT_BY_MATRIX + 2 * focus if learned else 0
        return Demand(
            max(making * window, (14 + transfers) * window + 6.5 * max(states) * field),
            (2 * focus + transfers + lens + matrix + indexed) * window + 2 * focus * sum(states) * field,
            max(7 * max(states) * field + 25 * learned * window, 2 * components),
            shared=shared,
            once=last,
        )
    leaks = polarisation is not None and not polarisation.ideal
    own = len(prisms) if found or not microscope.condenser_prism else 0
    kept = (2 * focus + lens + own + indexed) * window + (6 if leaks else 2) * images * field
    if found and leaks:
        kept += images * window
    if learned:
        terms = 0 if objective is None else len(objective.aberrations or {})
        kept += (2 * focus + 4 + terms + own) * window
    if found:
        alone = (14 + len(prisms) + lens) * window + (10 if leaks else 6 if images > 1 else 4) * field
        return Demand(alone, kept, max((10 if leaks else 8) * field, 2 * components), once=last)
    alone = 12 + lens + (2 if images > 1 else 0) + (1 + 2 * own if own else 0) + (7 if leaks else 0)
    return Demand(alone, kept, 13 if leaks else 10, shared=shared)
