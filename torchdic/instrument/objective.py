"""The objective's pupil: aperture, Zernike aberrations, apodisation and a layer that the design does not expect."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.instrument.zernike import zernike
from torchdic.plane_waves import exp_i
from torchdic.scalar import number, scalar


@dataclass(frozen=True, eq=False)
class Layer:
    """A plane-parallel layer between specimen and objective where the objective's design expects another index.

    A cover glass too thick or too thin, or light that is focused some depth into a medium other than the immersion.
    thickness: µm; below 0 where that much of the layer is missing. index: of the layer. design_index: of what the
    design has in its place. Numbers or 0-d tensors, which are learned. Raises ValueError for a thickness that isn't
    finite or an index below 1.
    """

    thickness: float | Tensor
    index: float | Tensor
    design_index: float | Tensor

    def __post_init__(self) -> None:
        thickness = number(self.thickness)
        if not math.isfinite(thickness):
            raise ValueError(f"layer thickness {thickness} µm must be a finite number")
        for name, value in (("index", number(self.index)), ("design_index", number(self.design_index))):
            if not (1 <= value < math.inf):
                raise ValueError(f"layer {name} {value} must be a refractive index of at least 1")

    def phase(self, momentum: Float[Tensor, "source 2 y x"], wavelength: float) -> Float[Tensor, "source y x"]:
        """k0·t·(√(n² − |p|²) − √(n_d² − |p|²)) in rad at each transverse momentum p; 0 where either is evanescent.

        It is exact, and whole: it keeps its piston k0·t·(n − n_d), which no image shows, and its defocus, by which for
        small angles the plane z_f + t·n0·(1/n − 1/n_d) is sharp instead of z_f. Beyond these it is the spherical
        aberration of Gibson & Lanni, J. Opt. Soc. Am. A 8, 1601 (1991).
        """
        t, n, design = (scalar(v, momentum) for v in (self.thickness, self.index, self.design_index))
        transverse = momentum.square().sum(1)
        propagates = (transverse < n.square()) & (transverse < design.square())
        transverse = torch.where(propagates, transverse, 0)  # keeps roots of negative numbers out of the gradient
        roots = (n.square() - transverse).sqrt() + (design.square() - transverse).sqrt()
        # the difference of the roots without cancellation
        return torch.where(propagates, 2 * math.pi / wavelength * t * (n - design) * (n + design) / roots, 0)


@dataclass(frozen=True, eq=False)
class Objective:
    """An objective.

    na: numerical aperture. aberrations: Zernike coefficients {Noll index: rad}, rms phase over the pupil; numbers or
    0-d tensors, which are learned; None for a perfect lens. apodisation: "aplanatic" for lenses that obey the sine
    condition and conserve energy, see `apodise`; None for a pupil of even transmission. layer: what the light crosses
    though the design expects another index; None where the design is met.
    Raises ValueError for an aperture that isn't positive or beyond the layer's indices, or a Noll index below 1.
    """

    na: float
    aberrations: Mapping[int, float | Tensor] | None = None
    apodisation: Literal["aplanatic"] | None = None
    layer: Layer | None = None

    def __post_init__(self) -> None:
        if not (0 < self.na < float("inf")):
            raise ValueError(f"objective NA {self.na} must be above 0")
        for index, value in (self.aberrations or {}).items():
            if isinstance(index, bool) or not isinstance(index, int) or index < 1:
                raise ValueError(f"aberration {index!r}: a Noll index is a whole number from 1")
            coefficient = number(value)
            if not math.isfinite(coefficient):
                raise ValueError(f"aberration {index}: {coefficient} rad must be a finite number")
        if self.apodisation not in (None, "aplanatic"):
            raise ValueError(f"apodisation {self.apodisation!r} must be 'aplanatic' or absent")
        if self.layer is not None:
            lowest = min(number(self.layer.index), number(self.layer.design_index))
            if self.na > lowest:
                raise ValueError(f"objective NA {self.na:g} exceeds the layer's index {lowest:g}")

    def aperture(self, momentum: Float[Tensor, "source 2 y x"]) -> Tensor:
        """Which transverse momenta n·sinθ the pupil lets through, shape (source, y, x); its edge counts as inside."""
        rounding = 8 * torch.finfo(momentum.dtype).eps
        return momentum.square().sum(1) <= self.na**2 * (1 + rounding)

    def phase(self, momentum: Float[Tensor, "source 2 y x"]) -> Float[Tensor, "source y x"] | None:
        """The aberrations' phase in rad at each transverse momentum, or None for a perfect lens."""
        if not self.aberrations:
            return None
        pupil = momentum / self.na
        rho, theta = pupil.square().sum(1).sqrt(), torch.atan2(pupil[:, 0], pupil[:, 1])
        terms = [scalar(value, rho) * zernike(index, rho, theta) for index, value in self.aberrations.items()]
        return torch.stack(terms).sum(0)

    def transfer(
        self,
        momentum: Float[Tensor, "source 2 y x"],
        direct: Float[Tensor, "source 2"],
        wavelength: float,
        background: Tensor,
    ) -> Float[Tensor, "source y x"] | Complex[Tensor, "source y x"] | None:
        """What multiplies the field's spectrum within the aperture; None: nothing does.

        momentum: n·sinθ of the field's waves, direct: of each source's own one. wavelength: in vacuum, µm. background:
        index of the medium.
        """
        phases = [self.phase(momentum), None if self.layer is None else self.layer.phase(momentum, wavelength)]
        present = [phase for phase in phases if phase is not None]
        amplitude = None if self.apodisation is None else apodise(momentum, direct, background)
        if not present:
            return amplitude
        transfer = exp_i(present[0] if len(present) == 1 else present[0] + present[1])
        return transfer if amplitude is None else transfer * amplitude


def apodise(
    momentum: Float[Tensor, "source 2 y x"], direct: Float[Tensor, "source 2"], background: Tensor
) -> Float[Tensor, "source y x"]:
    """The aplanatic amplitude √(cosθ/cosθ0) of each wave at θ that an illuminating wave at θ0 excites.

    Detection: a plane wave of amplitude A carries the flux |A|²·cosθ through a plane of focus, and behind the objective
    all of it along the axis: A gains √cosθ (Richards & Wolf, Proc. R. Soc. A 253, 358, 1959; a point source's waves
    have the amplitude 1/cosθ by Weyl's expansion, so that they fill a pupil as 1/√cosθ). Illumination: an evenly lit
    pupil of an aplanatic condenser sends equal flux in every direction n·sinθ0, of the amplitude 1/√cosθ0. The direct
    light gains 1, so an empty field is what it is without. 0 where a wave is evanescent.
    """
    squared = background**2 - momentum.square().sum(1)
    squared0 = background**2 - direct.square().sum(-1)
    propagates = squared > 0
    ratio = torch.where(propagates, squared, 1) / squared0[:, None, None]
    return torch.where(propagates, ratio.sqrt().sqrt(), 0)
