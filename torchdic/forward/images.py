"""The whole microscope: from a specimen to the images of its prisms and focus planes."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.forward.foresee import allot, allot_fields, check_fits
from torchdic.forward.own_part import own_part
from torchdic.forward.passage import FieldPassage, Passage
from torchdic.grid import Grid
from torchdic.instrument.microscope import Acquisition, Microscope, check_sampling, in_medium
from torchdic.memory.shortage import halved_once
from torchdic.propagation.presets import STANDARD
from torchdic.ranks.shared import shared
from torchdic.scalar import number, scalar
from torchdic.specimen.volume import Volume


def image(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity = STANDARD
) -> Float[Tensor, "prism focus y x"]:
    """Images of a volume, relative to the empty bright field.

    volume: the specimen.
    microscope: what takes the images.
    acquisition: the prisms and focus planes to image.
    fidelity: how carefully to compute.
    The result has the shape (prism, focus, y, x). Its pixels are the volume's (y, x) voxel centres, or those of a
    camera that has a pixel size. Where an aperture exceeds the medium's index, the part beyond the index is dark, and
    ApertureWarning says so. Raises ValueError for a condenser of which no wave enters the medium, and
    ShortOfMemoryError if the computation needs more memory than is free. Warns with SamplingWarning if the voxels are
    coarser than the light, and with ShortageWarning where a GPU's memory runs out and batches are halved.
    """
    n0 = number(volume.background)
    microscope = in_medium(microscope, n0, volume.delta.dtype)
    check_sampling(microscope, volume.grid, n0)
    return shared(_image, _part_of_image, volume, microscope, acquisition, fidelity)


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

    transmission: (y, x) if it is the same for every source. (source, y, x) is each source's own envelope (the field
        without the source's tilt), in the order of the microscope's sources.
    grid: the transmission's pixels. The number of slices has no effect.
    microscope, acquisition, fidelity: as for `image`.
    background: index of the medium.
    The result has the shape (prism, focus, y, x). Raises ValueError as `image` does, if a shape is not the grid's or a
    value not finite, and for light of a spectrum, because the transmission would differ between its wavelengths.
    """
    if microscope.spectrum is not None:
        raise ValueError(
            f"a transmission belongs to one wavelength, the spectrum has {len(microscope.spectrum.wavelengths)}: "
            "sum the images over Microscope.colours()"
        )
    if not transmission.is_complex():
        transmission = torch.complex(transmission, torch.zeros_like(transmission))
    real = transmission.real
    microscope = in_medium(microscope, number(background), real.dtype)
    check_sampling(microscope, grid, number(background))
    momentum, _ = microscope.sources(fidelity.sources, dtype=real.dtype, device=real.device)
    expected = (*((len(momentum),) if transmission.ndim == 3 else ()), *grid.shape[1:])
    if tuple(transmission.shape) != expected:
        raise ValueError(f"transmission has shape {tuple(transmission.shape)}, the grid and sources ask for {expected}")
    if not bool(torch.isfinite(transmission.detach()).all()):
        raise ValueError(f"transmission holds {int((~torch.isfinite(transmission)).sum())} values that are not finite")
    n0 = scalar(background, real)
    passage = FieldPassage(transmission, grid, n0, microscope, acquisition, fidelity)
    return shared(_image_of_field, _part_of_image_of_field, passage)


def _image(volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity) -> Tensor:
    """An image by this process."""
    scene = volume, microscope, acquisition, fidelity

    def images() -> Tensor:
        if fidelity.object_aberration is None:
            batches = allot(*scene)
            return Passage.through(*scene).images(batches)
        check_fits(*scene)
        passage = Passage.through(*scene)
        return passage.images(allot(*scene, passage.most_levels))

    return halved_once(images, volume.delta.device)


def _part_of_image(volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity) -> Tensor:
    """A rank's part of an image."""
    return own_part(lambda lit, few, _: _image(volume, lit, few, fidelity), microscope, acquisition, fidelity)


def _image_of_field(passage: FieldPassage) -> Tensor:
    return halved_once(lambda: passage.images(allot_fields(passage)), passage.transmission.device)


def _part_of_image_of_field(passage: FieldPassage) -> Tensor:
    """A rank's part of an image of a field."""
    transmission = passage.transmission

    def images(lit: Microscope, few: Acquisition, directions: Sequence[int]) -> Tensor:
        own = transmission if transmission.ndim == 2 else transmission[list(directions)]
        return _image_of_field(replace(passage, transmission=own, microscope=lit, acquisition=few))

    return own_part(images, passage.microscope, passage.acquisition, passage.fidelity)
