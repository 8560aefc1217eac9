"""The optics behind a stack of a specimen of known shape and index, such as a bead.

Where the specimen lies is fitted together with the optics, by Gauss and Newton, on the model's own images of it. The
volume is known, so that shear, bias and apertures are, too: nothing else can explain the contrast.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from recon.calibration.optics import (
    Aberrations,
    CondenserAperture,
    Displacement,
    FocusZero,
    ShearOfAxes,
    axes_of,
)
from recon.calibration.part import Part, part_of
from recon.calibration.trials.short_fits import unwarned
from recon.calibration.uncertainty import standard_deviations
from recon.fit.nuisances.base import Nuisance
from recon.fit.nuisances.bias import Bias
from recon.fit.nuisances.light import Brightness, Lamp
from recon.fit.nuisances.nearby import Nearby, formed_together
from recon.fit.nuisances.refinement import SCALE, refined
from recon.fit.problem import measured_noise
from recon.fit.setup import Setup
from recon.fit.unknowns import with_values
from recon.misfit.base import Misfit
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Acquisition, Camera, Fidelity, Grid, Microscope, Volume
from torchdic.scalar import number

# Planes of the stack, and µm of light around the specimen on each side, that its fit takes.
PLANES, AROUND = 7, 3.5

# Thickness of a slab in µm, and the part of the field's width by which the model's is wider on each side.
SLAB, MARGIN = 0.2, 0.2

# Condenser directions of each round, and how often the optics are refined in it at most: until no parameter moves by
# more than STILL of its scale. Bias and shear lie in a long valley, along which each refinement goes a part of the way.
ROUNDS = ((16, 4), (32, 10), (128, 4))
STILL = 0.01

# Depths at which the specimen is looked for, over the reach of the planes and of the volume.
DEPTHS = 9

# Noise alone correlates with the specimen's images by about 4 of its standard deviations at the best place.
SURE = 6.0


@dataclass(frozen=True)
class ModelledSpecimen:
    """A specimen of known shape and index.

    delta: gives its Δn (z, y, x) on a grid about whose centre it lies, as `delta` of a `data_synthetic.Bead` does.
    height, width: along z and across it, µm.
    """

    delta: Callable[[Grid], Tensor]
    height: float
    width: float


@dataclass(frozen=True, eq=False)
class OpticsFound:
    """What a known specimen tells.

    values: by name. "bias" (prism,) is in rad; "shear" (axis, 2) is the factor on the told length and the angle in rad
    by which it is turned from +x towards +y; "condenser" is the factor on the told NA; "focus_zero", µm, is to be added
    to the planes; "drift" (prism, focus, 2), µm (y, x), is where the specimen is in each image; "brightness" is (prism,
    focus) and "lamp" (prism, 5), see `Setup`; "aberrations" (term,), rad, are to be added to those told.
    parameters, deviations: of each value its parameter, which is the logarithm of what is a factor and the value itself
    else, and one standard deviation of that, by the images (`recon.calibration.uncertainty`) and by how far it moved
    with the last condenser directions.
    planes: which of the stack's were taken, from 0. setup: the model of these, with all values in it.
    misfit: of its images. noise: what noise leaves of it; None where that isn't known.
    """

    values: dict[str, Tensor]
    parameters: dict[str, Tensor]
    deviations: dict[str, Tensor]
    planes: tuple[int, ...]
    setup: Setup
    misfit: float
    noise: float | None


def calibrate(
    data: Float[Tensor, "prism focus y x"],
    setup: Setup,
    specimen: ModelledSpecimen,
    noise: Sequence[float] | None = None,
    mask: Bool[Tensor, "prism focus y x"] | None = None,
    zernike: Sequence[int] = (),
) -> OpticsFound:
    """Find the optics behind a stack of a known specimen, such as a bead, each with its uncertainty.

    Bias, length and direction of the shear, the condenser's aperture, and the place and brightness of each image.

    data: (prism, focus, y, x), relative to the empty bright field. setup: what is told, the signs and the prisms' order
    right; its volume's Δn plays no part. specimen: behind the images, anywhere.
    noise: standard deviation of each prism's, in the unit of the data; None is measured in them.
    mask: the pixels that count (True); None is all.
    zernike: Noll indices of the objective's aberrations that are sought too.
    Raises ValueError where the data's shape isn't the setup's, the noise isn't one number for each prism, aberrations
    are sought of no objective, all images are bright field, or the specimen isn't found.
    """
    if tuple(data.shape) != setup.shape:
        raise ValueError(f"the data have shape {tuple(data.shape)}, the acquisition and grid ask for {setup.shape}")
    levels = measured_noise(data, mask) if noise is None else noise
    if levels is not None and len(levels) != len(data):
        raise ValueError(f"the noise is given of {len(levels)} prisms, the data have {len(data)}")
    if zernike and setup.microscope.objective is None:
        raise ValueError(f"aberrations {list(zernike)} are of an objective, and the microscope has none")
    pixels = setup.pixels
    side = math.ceil((specimen.width + 2 * AROUND) / min(pixels.spacing[1:]))
    part = part_of(data, mask, pixels, side, PLANES)
    model = model_of(part, specimen, number(setup.volume.background), setup.microscope)
    return find_optics(part, model, setup.acquisition, levels, zernike)


def model_of(part: Part, specimen: ModelledSpecimen, background: float, microscope: Microscope) -> Setup:
    """The specimen about the centre of a volume that is just as deep as it, in a field wider than the part's.

    A square pixel integrates over its area, as a camera's does. The acquisition is bright field, to be replaced.
    """
    height = specimen.height
    _, dy, dx = part.grid.spacing
    slabs = max(1, math.ceil(height / SLAB))
    margin = math.ceil(MARGIN * min(part.grid.shape[1:]))
    field = Grid((slabs, *part.grid.shape[1:]), (height / slabs, dy, dx))
    wide = field.widened(margin, margin)
    camera = Camera(pixel_size=dx) if math.isclose(dy, dx) else None
    return Setup(
        Volume(wide, specimen.delta(wide).to(part.data), background),
        replace(microscope, camera=camera),
        Acquisition(),
        margin=margin,
    )


def find_optics(
    part: Part, model: Setup, declared: Acquisition, noise: Sequence[float] | None, zernike: Sequence[int] = ()
) -> OpticsFound:
    """Find bias, shear, condenser aperture, place and brightness, and aberrations, of a known specimen's images.

    part: of the stack. model: see `model_of`. declared: the whole stack's acquisition, its signs and orders right.
    noise: standard deviation of each prism's. zernike: Noll indices of the aberrations that are sought.
    Raises ValueError where all images are bright field, or the specimen isn't found.
    """
    acquisition = replace(declared, focus=[number(declared.focus[plane]) for plane in part.planes])
    setup = replace(model, acquisition=acquisition)
    misfit = GaussianMisfit(part.data, mask=part.mask)
    unknowns = _unknowns(setup)
    with unwarned():
        parameters = {u.name: u.start(setup, misfit) for u in unknowns}
        parameters |= _placed(setup, misfit, ROUNDS[0][0])
        coarse = parameters
        for sources, most in tqdm(ROUNDS, desc="bead", unit="round"):
            if zernike and len(parameters) == len(unknowns) and sources == ROUNDS[1][0]:
                unknowns.append(Aberrations(tuple(zernike)))
                parameters[unknowns[-1].name] = unknowns[-1].start(setup, misfit)
            coarse = parameters
            parameters = _settled(unknowns, parameters, setup, misfit, Fidelity("wave", sources=sources), most)
        nearby = Nearby(unknowns, parameters, setup, Fidelity("wave", sources=ROUNDS[-1][0]))
        deviations = {
            name: (deviation.square() + (parameters[name] - coarse[name]).square()).sqrt()
            for name, deviation in standard_deviations(nearby, parameters, misfit).items()
        }
    values = {u.name: u.value(parameters[u.name]) for u in unknowns}
    return OpticsFound(
        values,
        parameters,
        deviations,
        part.planes,
        with_values(unknowns, values, setup),
        float(misfit(nearby.recorded(parameters))),
        misfit.of_noise(noise),
    )


def _settled(
    unknowns: Sequence[Nuisance],
    parameters: dict[str, Tensor],
    setup: Setup,
    misfit: Misfit,
    fidelity: Fidelity,
    most: int,
) -> dict[str, Tensor]:
    """The parameters after refinements until they hardly move, or `most` of them."""
    for _ in range(most):
        before = parameters
        parameters = refined(unknowns, before, setup, misfit, fidelity)
        moved = [float((parameters[u.name] - before[u.name]).abs().max()) / (SCALE * u.step) for u in unknowns]
        if max(moved) < STILL:
            break
    return parameters


def _unknowns(setup: Setup) -> list[Nuisance]:
    found: list[Nuisance] = [
        Brightness(),
        Lamp(),
        Displacement(),
        FocusZero(),
        Bias(),
        ShearOfAxes(axes_of(setup.acquisition)),
    ]
    condenser = setup.microscope.condenser
    if condenser is not None and number(condenser.na) > 0 and condenser.points is None:
        found.append(CondenserAperture(number(setup.volume.background)))
    return found


def _placed(setup: Setup, misfit: Misfit, sources: int) -> dict[str, Tensor]:
    """The displacement and the focus zero with which the model's images correlate best with the data."""
    focus = [number(depth) for depth in setup.acquisition.focus]
    reach = (max(focus) - min(focus)) / 2 + setup.volume.grid.extent[0] / 2
    middle = (max(focus) + min(focus)) / 2
    zeros = [float(z) - middle for z in torch.linspace(-reach, reach, DEPTHS)] if len(focus) > 1 else [-middle]
    tried = [replace(setup, acquisition=replace(setup.acquisition, focus=[f + z for f in focus])) for z in zeros]
    formed = formed_together(tried, Fidelity("wave", sources=sources), planes=True)
    best, found = SURE, None
    for zero, images in zip(zeros, formed, strict=True):
        score, shift = _correlation(setup.recorded(images), misfit, setup.volume.grid.spacing[1:])
        if score > best:
            best, found = score, (zero, shift)
    if found is None:
        raise ValueError("the specimen isn't in the images: nowhere do they correlate with those of the model")
    zero, shift = found
    data = misfit.data
    return {
        FocusZero.name: data.new_tensor(zero),
        Displacement.name: data.new_tensor(shift).expand(*data.shape[:2], 2).clone(),
    }


def _correlation(
    images: Float[Tensor, "prism focus y x"], misfit: Misfit, spacing: tuple[float, float]
) -> tuple[float, tuple[float, float]]:
    """The largest correlation of images with the data at any displacement, and that displacement (y, x) in µm."""
    weight = misfit.variance.rsqrt()
    model, data = ((i - i.mean((2, 3), keepdim=True)) * weight for i in (images, misfit.data))
    spectrum = (torch.fft.rfft2(data) * torch.fft.rfft2(model).conj()).sum((0, 1))
    correlation = torch.fft.irfft2(spectrum, s=data.shape[2:])
    place = divmod(int(correlation.argmax()), data.shape[3])
    shift = [(i if i <= n // 2 else i - n) * d for i, n, d in zip(place, data.shape[2:], spacing, strict=True)]
    return float(correlation.max() / model.norm().clamp_min(1e-30)), (shift[0], shift[1])
