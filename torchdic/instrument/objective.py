"""The objective: aperture, Zernike aberrations, apodisation, and a layer for which it is not designed."""

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
    """A plane-parallel layer between specimen and objective whose index is not the one that the objective expects.

    For example a cover glass that is too thick or too thin, or light focused into a medium other than the immersion.

    thickness: µm; below 0 where that much of the layer is missing.
    index: refractive index of the layer.
    design_index: refractive index for which the objective is designed in its place.

    They are numbers or 0-d tensors; tensors are learned. Raises ValueError for a thickness that isn't finite or an
    index below 1.
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
        """The phase k0·t·(√(n² − |p|²) − √(n_d² − |p|²)) in rad; 0 where the wave is evanescent in either index.

        momentum: p of each wave, n·sinθ as (y, x). wavelength: in vacuum, µm.

        It is exact. It contains the piston k0·t·(n − n_d), which no image shows, and a defocus: for small angles the
        plane z_f + t·n0·(1/n − 1/n_d) is sharp instead of z_f. The rest is the spherical aberration of Gibson & Lanni,
        J. Opt. Soc. Am. A 8, 1601 (1991).
        """
        t, n, design = (scalar(v, momentum) for v in (self.thickness, self.index, self.design_index))
        transverse = momentum.square().sum(1)
        propagates = (transverse < n.square()) & (transverse < design.square())
        transverse = torch.where(propagates, transverse, 0)  # keeps roots of negative numbers out of the gradient
        roots = (n.square() - transverse).sqrt() + (design.square() - transverse).sqrt()
        # the difference of the two roots, written without cancellation
        return torch.where(propagates, 2 * math.pi / wavelength * t * (n - design) * (n + design) / roots, 0)


@dataclass(frozen=True, eq=False)
class Objective:
    """An objective.

    na: numerical aperture.
    aberrations: Zernike coefficients {Noll index: rad}, rms phase over the pupil; numbers or 0-d tensors, of which
    tensors are learned; None is a perfect lens.
    apodisation: "aplanatic" for lenses that obey the sine condition and conserve energy, see `apodise`; None is a pupil
    of even transmission.
    layer: a layer for which the objective is not designed; None is no such layer.

    An aperture may exceed the index of the medium or of the layer, as that of an oil objective on a specimen in water
    does. No wave runs there at a higher n·sinθ than the index, so that the pupil is dark beyond it, see `reach`; the
    Zernike terms keep the aperture as their unit radius. Raises ValueError for an aperture that isn't positive or
    exceeds the layer's design_index, which the objective's own light would not cross, and for a Noll index below 1.
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
            design = number(self.layer.design_index)
            if self.na > design:
                raise ValueError(f"objective NA {self.na:g} exceeds the layer's design_index {design:g}")

    def reach(self, background: float = math.inf) -> float:
        """The radius of the part of the pupil that light can fill: the aperture, or an index if that is lower.

        background: refractive index of the medium; without it only the layer's index counts.
        """
        return min(self.na, background, math.inf if self.layer is None else number(self.layer.index))

    def aperture(self, momentum: Float[Tensor, "source 2 y x"]) -> Tensor:
        """Which waves lie within the aperture (source, y, x) and run through the layer; its edge counts as inside.

        momentum: of each wave, n·sinθ as (y, x).
        """
        rounding, squared = 8 * torch.finfo(momentum.dtype).eps, momentum.square().sum(1)
        inside = squared <= self.na**2 * (1 + rounding)
        if self.layer is None:
            return inside
        return inside & (squared < scalar(self.layer.index, squared).detach().square())

    def phase(self, momentum: Float[Tensor, "source 2 y x"]) -> Float[Tensor, "source y x"] | None:
        """The aberrations' phase in rad; None for a perfect lens. momentum: of each wave, n·sinθ as (y, x)."""
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
        """The factor of each wave within the aperture; None where there are no aberrations, apodisation or layer.

        momentum: of each wave, n·sinθ as (y, x).
        direct: of each source's own wave.
        wavelength: in vacuum, µm.
        background: refractive index of the medium.
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
    """The aplanatic amplitude √(cosθ/cosθ0) of a wave at θ in light of a source at θ0; 0 where it is evanescent.

    momentum: of each wave, n·sinθ as (y, x).
    direct: of each source's own wave.
    background: refractive index of the medium.

    Detection: a plane wave of amplitude A carries the flux |A|²·cosθ through a plane of focus. Behind the objective all
    of this flux runs along the axis, so A gains √cosθ (Richards & Wolf, Proc. R. Soc. A 253, 358, 1959; the waves of a
    point source have the amplitude 1/cosθ by Weyl's expansion, so that they fill a pupil as 1/√cosθ). Illumination: an
    aplanatic condenser with an evenly lit pupil sends equal flux in every direction n·sinθ0, with amplitude 1/√cosθ0.
    The factor of the direct light is 1, so apodisation leaves an empty field unchanged.
    """
    squared = background**2 - momentum.square().sum(1)
    squared0 = background**2 - direct.square().sum(-1)
    propagates = squared > 0
    ratio = torch.where(propagates, squared, 1) / squared0[:, None, None]
    return torch.where(propagates, ratio.sqrt().sqrt(), 0)
