"""The plane waves behind the specimen, and the objective's pupil that they meet.

The image and the weak specimen's transfer functions (`torchdic.linear`) both take the pupil from here.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Inexact
from torch import Tensor

from torchdic.fidelity import Defocus
from torchdic.grid import Grid
from torchdic.instrument.objective import Objective
from torchdic.plane_waves import axial_difference, paraxial_difference


@dataclass(frozen=True, eq=False)
class Waves:
    """The plane waves behind the specimen: for each source, those at the frequencies f of its envelope.

    grid: the array that holds the envelopes.
    wavelength: in vacuum, µm.
    background: refractive index of the medium, 0-d.
    momentum: p0 = n·sinθ of each source (source, 2), as (y, x).
    frequencies: f in 1/µm, either the same for all sources (2, y, x) or each source's own (source, 2, y, x).
    """

    grid: Grid
    wavelength: float
    background: Tensor
    momentum: Float[Tensor, "source 2"]
    frequencies: Float[Tensor, "*source 2 y x"]

    def transverse_momentum(self) -> Float[Tensor, "source 2 y x"]:
        """The transverse momentum p = p0 + λf of each wave, n·sinθ as (y, x)."""
        return self.momentum[:, :, None, None] + self.wavelength * self.frequencies

    def field_frequencies(self) -> Float[Tensor, "source 2 y x"]:
        """The field's frequency f + p0/λ of each wave in 1/µm; f is that of the envelope."""
        return self.frequencies + self.momentum[:, :, None, None] / self.wavelength


@dataclass(frozen=True, eq=False)
class Pupil:
    """What the objective's pupil does to the waves behind the specimen.

    passes: which waves pass; they propagate and lie within the aperture.
    transfer: the factor on each wave that passes (aberrations, apodisation, layer); None where there is none.
    difference: p_z − p_z0 of each wave; a defocus of ζ µm multiplies the wave by exp(i·k0·ζ·difference).
    pz: p_z of each wave; 0 where the wave is evanescent.
    """

    passes: Bool[Tensor, "source y x"]
    transfer: Inexact[Tensor, "source y x"] | None
    difference: Float[Tensor, "source y x"]
    pz: Float[Tensor, "source y x"]

    @classmethod
    def of(cls, objective: Objective | None, waves: Waves, defocus: Defocus = "exact") -> "Pupil":
        """The pupil of an objective; without an objective every wave that propagates passes.

        defocus: whether `difference` is exact or of second order in p.
        """
        light = waves.grid, waves.wavelength, waves.background, waves.momentum, waves.frequencies
        difference, pz = axial_difference(*light)
        if defocus == "paraxial":
            difference = paraxial_difference(*light)
        passes, transfer = pz > 0, None
        if objective is not None:
            transverse = waves.transverse_momentum()
            passes = passes & objective.aperture(transverse)
            transfer = objective.transfer(transverse, waves.momentum, waves.wavelength, waves.background)
        return cls(passes, transfer, difference, pz)

    def through(self, spectrum: Inexact[Tensor, "source component y x"]) -> Inexact[Tensor, "source component y x"]:
        """The spectrum behind the pupil."""
        if self.transfer is not None:
            spectrum = spectrum * self.transfer[:, None]
        return torch.where(self.passes[:, None], spectrum, 0)
