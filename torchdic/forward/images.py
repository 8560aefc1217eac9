"""The whole microscope: from a specimen to the images of its prisms and focus planes."""

import sys
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import STANDARD, Fidelity
from torchdic.forward.foresee import Foreseen, allotted, allotted_to_fields, levels_of
from torchdic.grid import Grid
from torchdic.imaging.intensity import Imaging
from torchdic.imaging.passband import interpolate
from torchdic.instrument.camera import Camera
from torchdic.instrument.microscope import Acquisition, Microscope, check_apertures, check_sampling
from torchdic.memory.batches import sum_over_sources
from torchdic.object_aberration.levels import Levels
from torchdic.plane_waves import axial_difference, paraxial_difference, to_spectrum
from torchdic.propagation.bent_rays import ray_field, reference_plane
from torchdic.propagation.projection import project
from torchdic.propagation.wave import split_step
from torchdic.scalar import number, scalar
from torchdic.specimen.volume import Volume


def image(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity = STANDARD
) -> Float[Tensor, "prism focus y x"]:
    """Images of a volume, relative to the empty bright field.

    Pixels are the volume's (y, x) voxel centres, or those of a camera that has a pixel size. Raises ValueError where an
    aperture exceeds the medium's index, and ShortOfMemoryError where it would take more memory than is free; warns with
    SamplingWarning where the voxels are coarser than the light.
    """
    check_apertures(microscope, number(volume.background), volume.delta.dtype)
    check_sampling(microscope, volume.grid)
    plan = allotted(volume, microscope, acquisition, fidelity)
    colours = microscope.colours()
    plane = reference_plane(volume, fidelity)
    padded = _padded(volume, fidelity.padding)
    levels: list[Levels | None] = [None] * len(colours)
    if fidelity.object_aberration is not None:
        levels = [levels_of(padded, plane, part, fidelity) for part, _ in colours]
        plan = allotted(volume, microscope, acquisition, fidelity, max(len(part.defocus) for part in levels if part))
    images = [
        share * _image(padded, plane, part, acquisition, fidelity, own, plan)
        for (part, share), own in zip(colours, levels, strict=True)
    ]
    return images[0] if len(images) == 1 else torch.stack(images).sum(0)


def _image(
    volume: Volume,
    plane: float,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
    levels: Levels | None,
    plan: Foreseen,
) -> Float[Tensor, "prism focus y x"]:
    """`image` of a padded volume in light of one wavelength."""
    momentum, weights = microscope.sources(fidelity.sources, dtype=volume.delta.dtype, device=volume.delta.device)
    fields = None if fidelity.propagation == "wave" else volume.sampled(fidelity.interpolation)
    imaging = Imaging(
        volume.grid, volume.background, plane, microscope, acquisition, fidelity.defocus, fidelity.band_limit
    )
    # whether steps are computed again has been decided
    within = replace(fidelity, memory=1 if plan.slabs else sys.maxsize)

    def intensity(momentum: Tensor, weights: Tensor) -> Tensor:
        spectrum = propagate(
            volume, microscope.wavelength, momentum, plane, within, levels, fields, turned=microscope.turns_polarisation
        )
        components = spectrum.reshape(len(momentum), -1, *spectrum.shape[-2:])
        return imaging.intensity(components, momentum, weights)

    total = sum_over_sources(intensity, (momentum, weights), plan.sources)
    return _seen(total, volume.grid, fidelity.padding, microscope.camera)


def propagate(
    volume: Volume,
    wavelength: float,
    momentum: Float[Tensor, "source 2"],
    plane: float,
    fidelity: Fidelity,
    levels: Levels | None = None,
    fields: Sequence[Float[Tensor, "z y x"]] | None = None,
    *,
    turned: bool = False,
) -> Complex[Tensor, "source *component y x"]:
    """Spectrum of each source's envelope behind the specimen, referred to depth `plane` (the last face for a wave).

    levels: of the defocus with which each point of a field that rays make spreads. fields: `Volume.sampled`, where it
    serves several calls. turned: whether bent rays carry
    their polarisation. Theirs is then (source, 2, y, x), the components along +x and +y of light that comes in along
    +x; the other ways across the specimen stay scalar.
    """
    if fidelity.propagation == "wave":
        return split_step(volume, wavelength, momentum, fidelity)
    if fidelity.propagation == "projection":
        field = project(volume, wavelength, momentum, plane, fidelity, fields)
    else:
        field = ray_field(volume, wavelength, momentum, plane, fidelity, fields, turned=turned)
    if levels is None:
        return to_spectrum(field)
    if fidelity.defocus == "paraxial":
        difference = paraxial_difference(volume.grid, wavelength, volume.background, momentum)
    else:
        difference, _ = axial_difference(volume.grid, wavelength, volume.background, momentum)
    return levels.spread(field, wavelength, difference)


def image_field(
    transmission: Tensor,
    grid: Grid,
    microscope: Microscope,
    acquisition: Acquisition,
    *,
    background: float | Tensor,
    fidelity: Fidelity = STANDARD,
) -> Float[Tensor, "prism focus y x"]:
    """Images of a thin complex transmission at z = 0, relative to the empty bright field.

    transmission: (y, x), the same for every source, or (source, y, x), each source's own envelope (its tilt removed) in
    the order of the microscope's sources. grid: its pixels (the number of slices plays no part). background: index of
    the medium. Raises ValueError as `image` does, where a shape is not the grid's, and for light of a spectrum, in each
    of whose wavelengths a transmission is another one.
    """
    if microscope.spectrum is not None:
        raise ValueError(
            f"a transmission belongs to one wavelength, the spectrum has {len(microscope.spectrum.wavelengths)}: "
            "sum the images over Microscope.colours()"
        )
    if not transmission.is_complex():
        transmission = torch.complex(transmission, torch.zeros_like(transmission))
    real = transmission.real
    check_apertures(microscope, number(background), real.dtype)
    check_sampling(microscope, grid)
    momentum, weights = microscope.sources(fidelity.sources, dtype=real.dtype, device=real.device)
    expected = (*((len(weights),) if transmission.ndim == 3 else ()), *grid.shape[1:])
    if tuple(transmission.shape) != expected:
        raise ValueError(f"transmission has shape {tuple(transmission.shape)}, the grid and sources ask for {expected}")
    n0 = scalar(background, real)
    pad = fidelity.padding
    grid = grid.widened(pad, pad)
    plan = allotted_to_fields(transmission, grid, n0, len(weights), microscope, acquisition, fidelity)
    spectra = to_spectrum(F.pad(transmission, (pad,) * 4, value=1.0))

    imaging = Imaging(grid, n0, 0.0, microscope, acquisition, fidelity.defocus, fidelity.band_limit)

    def intensity(momentum: Tensor, weights: Tensor, spectra: Tensor) -> Tensor:
        return imaging.intensity(spectra[:, None], momentum, weights)

    own = spectra if spectra.ndim == 3 else spectra.expand(len(weights), -1, -1)
    total = sum_over_sources(intensity, (momentum, weights, own), plan.sources)
    return _seen(total, grid, pad, microscope.camera)


def _padded(volume: Volume, pad: int) -> Volume:
    if pad == 0:
        return volume
    fields = [None if f is None else F.pad(f, (pad,) * 4) for f in (volume.delta, volume.absorption)]
    assert fields[0] is not None
    return Volume(volume.grid.widened(pad, pad), fields[0], volume.background, fields[1])


def _seen(images: Tensor, grid: Grid, pad: int, camera: Camera | None) -> Tensor:
    """The images on the grid's pixels without their padding, on the camera's pixels if it has any."""
    _, ny, nx = grid.shape
    images = interpolate(images, (ny, nx))
    if camera is not None and camera.pixel_size is not None:
        return camera.integrate(images, grid.spacing[1:], (ny - 2 * pad, nx - 2 * pad))
    return images if pad == 0 else images[..., pad:-pad, pad:-pad]
