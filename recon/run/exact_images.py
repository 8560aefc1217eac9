"""Images of a known specimen from its exact field."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic import Acquisition, Fidelity, Grid, Microscope, image_field
from torchdic.instrument.microscope import limited
from torchdic.memory.free import check_room, free_bytes

# The exact field is computed on an array that is wider than the grid by this fraction on each side. Its images are
# cropped to the grid, so that light which leaves the grid at one side doesn't come back in at the other.
WIDENING = 0.5

# Sources whose fields are held at once.
SOURCES_AT_ONCE = 16
# Bytes that they take at most for each pixel of that array: for each source, and for each image.
OF_SOURCE, OF_IMAGE = 48, 16


@runtime_checkable
class ExactSpecimen(Protocol):
    """A specimen that knows the exact field behind it."""

    @property
    def background(self) -> float:
        """Index of the medium around it."""
        ...

    def field(
        self,
        grid: Grid,
        wavelength: float,
        points: Tensor,
        plane: float = 0.0,
        *,
        padding: float,
        na: float | None,
    ) -> Complex[Tensor, "source y x"]:
        """The envelopes (source, y, x) of the sources' light at depth `plane` (µm), on the grid's pixels.

        wavelength: in µm.
        points: directions (source, 2) in NA units (y, x).
        padding: times the grid's own width within which the field is computed.
        na: aperture to which the field is limited; None keeps all waves.
        """
        ...


def check_room_for_exact(grid: Grid, acquisition: Acquisition, fidelity: Fidelity) -> None:
    """Raise ShortOfMemoryError where images from an exact field would take more memory than is free."""
    _, ny, nx = (n + 2 * round(WIDENING * n) for n in grid.shape)
    images = len(acquisition.prisms) * len(acquisition.focus)
    wanted = ny * nx * (OF_SOURCE * min(fidelity.sources, SOURCES_AT_ONCE) + OF_IMAGE * images)
    check_room(wanted, free_bytes(torch.device("cpu")), f"Images from the exact field on {ny}×{nx} pixels")


@torch.no_grad()
def exact_images(
    specimen: ExactSpecimen, grid: Grid, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity
) -> Float[Tensor, "prism focus y x"]:
    """Images of a specimen from its exact field, float64. None of torchdic's propagations takes part.

    specimen: knows its exact field.
    grid: its (y, x) pixels are the images', unless the microscope's camera has pixels of its own. The field is computed
    on an array that is wider by half of the grid's on each side.
    microscope, acquisition: as for `torchdic.image`; the camera's noise and counts are left out.
    fidelity: only its number of sources counts.
    Raises ShortOfMemoryError where there is no room for them.
    """
    check_room_for_exact(grid, acquisition, fidelity)
    if microscope.spectrum is not None:
        colours = microscope.colours()
        return torch.stack(
            [share * exact_images(specimen, grid, p, acquisition, fidelity) for p, share in colours]
        ).sum(0)
    _, ny, nx = grid.shape
    top, left = round(WIDENING * ny), round(WIDENING * nx)  # the same on both sides, so that the centre stays
    wide = grid.widened(top, left)
    lit = limited(microscope, specimen.background)
    points, weights = lit.sources(fidelity.sources, dtype=torch.float64, device=torch.device("cpu"))
    na = None
    if microscope.objective is not None:
        na = min(1.05 * microscope.objective.reach(), specimen.background)
    total = torch.zeros(len(acquisition.prisms), len(acquisition.focus), *wide.shape[1:], dtype=torch.float64)
    for some, share in zip(points.split(SOURCES_AT_ONCE), weights.split(SOURCES_AT_ONCE), strict=True):
        part = replace(microscope.lit_from(some, share), camera=None)
        field = specimen.field(wide, microscope.wavelength, some, padding=1.0, na=na)
        images = image_field(field, wide, part, acquisition, background=specimen.background)
        total += float(share.sum()) * images
    camera = microscope.camera
    if camera is not None and camera.pixel_size is not None:
        return camera.integrate(total, grid.spacing[1:], (ny, nx))
    return total[..., top : top + ny, left : left + nx]
