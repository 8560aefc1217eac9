"""Images where lenses act on polarisation: a sum over the light's pure states, each with its own transfer function.

Polariser and analyser have one pure state each if they are ideal, and two if they leak. Behind the analyser's state w,
in light of the polariser's state v, the amplitude of a wave is

    Σ w_b* K_b J_ba C_a v_a,    a, b = 1, 2 the prism's axes,

with J the matrix of the lenses in the frame of the prism, K_b = exp(±i(π(f + f_s)·s + bias/2)) the objective's prism,
upper sign for beam 1, and C_a = exp(∓iπ f_s·s) the condenser's prism, if there is one. A compensator gives its bias to
the light in front of all these. A bright field has no polarisers: its light is unpolarised.
"""

from collections.abc import Iterable

import torch
from jaxtyping import Bool, Float, Inexact
from torch import Tensor

from torchdic.imaging.pupil import Waves
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.instrument.polarisation import Polarisation
from torchdic.instrument.polarised_lenses import product, turn
from torchdic.instrument.prism import Prism
from torchdic.plane_waves import to_field
from torchdic.scalar import scalar

# Shares of the intensity (state,) of an image's pure states, and each one's factors (state, source, component, y, x).
# How many states there are differs from image to image.
States = tuple[Float[Tensor, " _"], Inexact[Tensor, "_ #source component #y #x"]]


def polarised_images(
    focused: Iterable[Tensor], transfers: list[States], weights: Float[Tensor, " source"], shape: tuple[int, int]
) -> list[Float[Tensor, "row column"]]:
    """The images of each focus and prism.

    focused: the spectrum (source, component, y, x) at each focus.
    transfers: of each prism, from `state_transfers`.
    weights: the sources' shares of the light.
    shape: of the images (y, x).
    """
    images = []
    for wave in focused:
        for shares, transfer in transfers:
            field = to_field((transfer * wave).sum(2), shape)
            images.append(torch.einsum("tsyxc,s,t->yx", torch.view_as_real(field).square(), weights, shares))
    return images


def state_transfers(
    waves: Waves,
    passes: Bool[Tensor, "source y x"],
    microscope: Microscope,
    acquisition: Acquisition,
    components: int,
) -> list[States]:
    """For each prism the shares of the light's pure states, and the factors on the spectrum for each state.

    passes: which waves pass the pupil.
    components: how many the spectrum has. With one it is a scalar amplitude. Two are along +x and +y, for light that
    comes in polarised along +x; the specimen turns all polarisations by the same angle.
    """
    frequencies = waves.field_frequencies()
    matrix = _lenses(waves, frequencies, passes, microscope, components)
    return [
        _unpolarised(matrix, components)
        if prism is None
        else _between_polarisers(matrix, waves, frequencies, microscope, prism, components)
        for prism in acquisition.prisms
    ]


def _lenses(
    waves: Waves, frequencies: Tensor, passes: Tensor, microscope: Microscope, components: int
) -> Inexact[Tensor, "#source 2 2 #y #x"]:
    """The lenses' Jones matrix for each wave, in the laboratory's frame. frequencies: the field's f + f_s."""
    lenses, objective = microscope.lenses, microscope.objective
    assert lenses is not None
    # far outside the aperture the polynomials would overflow: waves that are stopped count as axial
    transverse = torch.where(passes[:, None], waves.wavelength * frequencies, 0)
    matrix = None if objective is None else lenses.lenses(transverse / objective.na)
    if lenses.depolarisation and components == 1:
        turned = turn(transverse, waves.momentum, waves.background)
        matrix = turned if matrix is None else product(matrix, turned)
    if matrix is None:  # rays carry their polarisation, and the lenses have no Zernike terms
        matrix = torch.eye(2, dtype=frequencies.dtype, device=frequencies.device)[None, :, :, None, None]
    return matrix


def _between_polarisers(
    lenses: Tensor, waves: Waves, frequencies: Tensor, microscope: Microscope, prism: Prism, components: int
) -> States:
    """The states of a DIC image. lenses: their matrices. frequencies: the field's f + f_s."""
    light, analyser, bias = (microscope.polarisers or Polarisation()).pure_states(prism.bias)
    direct = waves.momentum[:, :, None, None] / waves.wavelength
    tilt = prism.shear_phase(direct)[:, 0, 0] if microscope.condenser_prism else None
    half = prism.shear_phase(frequencies)
    kind, device = half.dtype, half.device
    shares = (analyser.shares[:, None] * light.shares).flatten().to(device, kind)
    cos, sin = prism.polarised_along(waves.momentum)
    # in front of the lenses: the condenser's prism, then the laboratory's frame
    one, two = light.vectors.to(device, kind.to_complex())[:, None].unbind(-1)
    if tilt is not None:
        condenser = torch.polar(torch.ones_like(tilt), -tilt)
        one, two = one * condenser, two * condenser.conj()
    laboratory = torch.stack((cos * one - sin * two, sin * one + cos * two), -1)
    x, y = _behind(lenses, laboratory, components).unbind(3)
    # behind them: the objective's prism in its own frame, then the analyser
    beam = torch.polar(torch.ones_like(half), half + scalar(bias, half) / 2)[:, None]
    beams = beam * (cos * x + sin * y), beam.conj() * (cos * y - sin * x)
    first, second = analyser.vectors.to(device, kind)[:, :, None, None, None, None, None].unbind(1)
    return shares, (first * beams[0] + second * beams[1]).flatten(0, 1)


def _unpolarised(lenses: Tensor, components: int) -> States:
    """The states of a bright field: half of the light comes in along x and half along y, and all of it is seen."""
    real = lenses.real if lenses.is_complex() else lenses
    behind = _behind(lenses, torch.eye(2, dtype=real.dtype, device=real.device)[:, None], components)
    return real.new_full((4,), 0.5), behind.movedim(3, 1).flatten(0, 1)


def _behind(
    lenses: Inexact[Tensor, "#source 2 2 #y #x"], light: Inexact[Tensor, "state #source 2"], components: int
) -> Inexact[Tensor, "state source component 2 y x"]:
    """Light of unit amplitude (x, y) behind the lenses, for each component of a spectrum."""
    # the specimen turns +x towards +y, and so +y towards −x
    parts = [light, torch.stack((-light[..., 1], light[..., 0]), -1)] if components == 2 else [light]
    x, y = torch.stack(parts, 2)[..., None, None, None].unbind(3)
    return lenses[:, None, :, 0] * x + lenses[:, None, :, 1] * y
