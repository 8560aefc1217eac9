"""Images of a known specimen: through one of the propagations, or from its exact field."""

from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic import Acquisition, Fidelity, Grid, Microscope, image_field

# The exact field is spread over an array wider by this fraction on each side and cropped after imaging: what leaves the
# volume's sides must not come back on the other one.
MARGIN = 0.5


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
        """Each source's envelope at depth `plane`, on the grid's pixels."""
        ...


@torch.no_grad()
def exact_images(
    specimen: ExactSpecimen, grid: Grid, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity
) -> Float[Tensor, "prism focus y x"]:
    """Images of a specimen from its exact field, float64: none of our propagations takes part."""
    _, ny, nx = grid.shape
    top, left = round(MARGIN * ny), round(MARGIN * nx)  # alike on both sides: the centre stays the centre
    wide = grid.widened(top, left)
    if microscope.spectrum is not None:
        colours = microscope.colours()
        return torch.stack(
            [share * exact_images(specimen, grid, p, acquisition, fidelity) for p, share in colours]
        ).sum(0)
    points, weights = microscope.sources(fidelity.sources, dtype=torch.float64, device=torch.device("cpu"))
    na = None
    if microscope.objective is not None:
        na = min(1.05 * microscope.objective.na, specimen.background)
    total = torch.zeros(len(acquisition.prisms), len(acquisition.focus), *wide.shape[1:], dtype=torch.float64)
    for some, share in zip(points.split(16), weights.split(16), strict=True):
        part = replace(microscope.lit_from(some, share), camera=None)
        field = specimen.field(wide, microscope.wavelength, some, padding=1.0, na=na)
        images = image_field(field, wide, part, acquisition, background=specimen.background)
        total += float(share.sum()) * images
    camera = microscope.camera
    if camera is not None and camera.pixel_size is not None:
        return camera.integrate(total, grid.spacing[1:], (ny, nx))
    return total[..., top : top + ny, left : left + nx]
