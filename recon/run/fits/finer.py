"""Images of a known specimen from a model that is finer than the one that fits them, or from its exact field."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from recon.run.exact_images import ExactSpecimen, exact_images
from torchdic import Acquisition, Fidelity, Grid, Microscope, Volume, image


@runtime_checkable
class Phantom(Protocol):
    """A specimen whose Δn is known everywhere."""

    @property
    def background(self) -> float:
        """Index of the medium around it."""
        ...

    def delta(self, grid: Grid, dtype: torch.dtype = ...) -> Float[Tensor, "z y x"]:
        """Δn on a grid."""
        ...


@dataclass(frozen=True)
class FinerModel:
    """A wave model on finer voxels and in a wider field than those of a reconstruction.

    A pixel is the mean of its finer ones, as a camera's integrates. In the wider field no light comes back in at the
    opposite side.
    parts: of a voxel along (z, y, x); exact fields ignore z. margin: voxels on each side by which the field is wider.
    sources: condenser directions, on other rings than the 18, 32, 40 or 128 of a reconstruction.
    """

    parts: tuple[int, int, int] = (3, 2, 2)
    margin: int = 16
    sources: int = 112

    def grid(self, grid: Grid) -> Grid:
        """The finer voxels of a reconstruction's grid, without the margin."""
        shape, spacing = grid.shape, grid.spacing
        (kz, ky, kx) = self.parts
        return Grid((kz * shape[0], ky * shape[1], kx * shape[2]), (spacing[0] / kz, spacing[1] / ky, spacing[2] / kx))

    def truth(self, specimen: Phantom, grid: Grid) -> Float[Tensor, "z y x"]:
        """Δn on a reconstruction's grid, float32: the mean of the finer voxels in each."""
        (kz, ky, kx), (nz, ny, nx) = self.parts, grid.shape
        return specimen.delta(self.grid(grid)).reshape(nz, kz, ny, ky, nx, kx).mean((1, 3, 5)).float()

    @torch.no_grad()
    def images(
        self, specimen: Phantom, grid: Grid, microscope: Microscope, acquisition: Acquisition
    ) -> Float[Tensor, "prism focus y x"]:
        """The noiseless images on the pixels of a reconstruction's grid, float32.

        microscope: without pixels of its own. The exact field makes the images of a specimen that knows one.
        """
        (_, ky, kx), (_, ny, nx) = self.parts, grid.shape
        fidelity = Fidelity("wave", sources=self.sources, order=2)
        if isinstance(specimen, ExactSpecimen):
            fine = exact_images(specimen, self.grid(grid), microscope, acquisition, fidelity)
        else:
            rows, columns = self.margin * ky, self.margin * kx
            wide = self.grid(grid).widened(rows, columns)
            volume = Volume(wide, specimen.delta(wide, dtype=torch.float32), specimen.background)
            fine = image(volume, microscope, acquisition, fidelity)
            fine = fine[..., rows : rows + ky * ny, columns : columns + kx * nx]
        return fine.unflatten(3, (nx, kx)).unflatten(2, (ny, ky)).mean((3, 5)).float()
