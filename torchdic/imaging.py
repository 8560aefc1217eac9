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
from torchdic.recompute import Demand
from torchdic.wave import axial_difference, exp_i, paraxial_difference, to_field
from torchdic.wrap_around import check_wrap_around

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
) -> Float[Tensor, "prism focus y x"]:
    """Σ over sources of weight·|F⁻¹[D·pupil·defocus·S]|², the spectra S referred to depth `plane` (µm).

    Pupil and defocus act on the field's frequency f + f_s, the prism's shear on the envelope's f if a condenser prism
    makes up for the tilt. Behind a pupil of Jones matrices it is the sum over pure states of the light, each with a D
    of its own, see `Polarisation.transfers`. spectrum: with the components of `propagate` where rays are turned.
    """
    k0 = 2 * math.pi / microscope.wavelength
    frequencies = grid.frequencies(dtype=momentum.dtype, device=momentum.device)
    difference, pz = axial_difference(grid, microscope.wavelength, background, momentum)
    passes = pz > 0
    if defocus == "paraxial":
        difference = paraxial_difference(grid, microscope.wavelength, background, momentum)
    turned = spectrum.ndim == 4
    if turned:
        spectrum = spectrum.movedim(1, 0)
    if microscope.objective is not None:
        waves = momentum[:, :, None, None] + microscope.wavelength * frequencies
        passes = passes & microscope.objective.aperture(waves)
        pupil = microscope.objective.transfer(waves, momentum, microscope.wavelength, background)
        if pupil is not None:
            spectrum = spectrum * pupil
    spectrum = torch.where(passes, spectrum, 0)
    na = background if microscope.objective is None else microscope.objective.na
    check_wrap_around(spectrum, grid, microscope.wavelength, background, na, plane, momentum, weights, acquisition)
    if not microscope.condenser_prism or microscope.vectorial:
        frequencies = frequencies + momentum[:, :, None, None] / microscope.wavelength

    def sharp(focus: float | Tensor) -> Tensor:
        depth = torch.as_tensor(focus, dtype=difference.dtype, device=difference.device)
        return spectrum * exp_i(k0 * (depth - plane) * difference)

    if microscope.vectorial:
        transfers = _state_transfers(frequencies, passes, momentum, background, microscope, acquisition, turned)
        images = []
        for focus in acquisition.focus:
            wave = sharp(focus)
            for shares, transfer in transfers:
                field = to_field((transfer * wave).sum(1))
                images.append(torch.einsum("tsyxc,s,t->yx", torch.view_as_real(field).square(), weights, shares))
    else:
        images = _scalar_images(sharp, frequencies, weights, microscope, acquisition)
    shape = (len(acquisition.focus), len(acquisition.prisms), *grid.shape[1:])
    return torch.stack(images).reshape(shape).transpose(0, 1)


def _scalar_images(
    sharp: Callable[[float | Tensor], Tensor],
    frequencies: Tensor,
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
            field = to_field(wave if transfer is None else wave * transfer)
            if prism is None or polarisation is None:
                # over the sources first: a sum over two neighbours in memory is slow
                images.append(torch.tensordot(weights, torch.view_as_real(field).square(), 1).sum(-1))
            else:
                stopped = to_field(wave * prism.parallel(frequencies))
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
    microscope: Microscope, acquisition: Acquisition, components: int = 1, *, learned: bool = False
) -> Demand:
    """What `form_image` holds; measured by `python benchmarks/memory.py`.

    components: of the spectrum. learned: whether the microscope or acquisition is, and not the specimen alone.
    """
    focus, prisms, polarisation = len(acquisition.focus), acquisition.prisms, microscope.polarisation
    objective = microscope.objective
    lens = (
        0 if objective is None else 2 * (bool(objective.aberrations) or bool(objective.layer or objective.apodisation))
    )
    if microscope.vectorial:
        assert polarisation is not None
        assert polarisation.pupil is not None
        pupil = polarisation.pupil
        states = [4 if prism is None else polarisation.states for prism in prisms]
        turned = pupil.depolarisation and components == 1
        factors = bool(pupil.retardance) + bool(pupil.diattenuation) + turned
        matrix = KEPT_BY_MATRIX + 2 * focus if learned else 0
        beams = max((polarisation.states for prism in prisms if prism is not None), default=0)
        alone = max(46 if factors > 1 else 31, 29 + 2 * components * sum(states) + 6 * beams)
        return Demand(
            alone, 2 * focus + 2 * (components + focus) * sum(states) + lens + matrix, 7 * max(states) + 25 * learned
        )
    fields = 1 if polarisation is None or polarisation.ideal else 2
    # a transfer for each source, or one for all of them
    own = 0 if microscope.condenser_prism else fields * len(prisms)
    extra = 7 if fields == 2 else 0
    alone = 12 + lens + (2 if focus * len(prisms) > 1 else 0) + (1 + 2 * own if own else 0) + extra
    kept = focus * (2 + 2 * fields * len(prisms)) + (2 * len(prisms) if fields == 2 else 0) + own + lens
    if learned:
        terms = 0 if objective is None else len(objective.aberrations or {})
        kept += 3 + 2 * len(prisms) + terms
    return Demand(alone, kept, 10 if fields == 1 else 13)
