"""The Nomarski prism: two beams, displaced by the shear and out of phase by the bias.

A prism is given by shear and bias, by the polariser of de Sénarmont's compensator, or by its wedges. Two wedges of
angle ψ of a birefringent crystal are cemented with their optic axes crossed. The beams, each polarised along one of the
axes, get the path differences ±(n_e − n_o)·x·tanψ, where x is counted from the line along which both wedges are equally
thick. To first order in the birefringence this is the split angle ε = 2(n_e − n_o)·tanψ. Light of frequency f crosses
the back focal plane at x = λ·f_obj·f. So with a prism centred at ξ beam 1 leads by
2π·(ε/λ)·(λ f_obj f − ξ) = 2π f·s + bias:
    s = ε·f_obj,    bias = −2π s·ξ/(λ f_obj).

G. Nomarski, J. Phys. Radium 16, 9S (1955); W. Lang, Zeiss Information 70, 114 (1968).
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.scalar import number, scalar

# Ordinary and extraordinary index at 546.1 nm, by the dispersion equations of G. Ghosh, Opt. Commun. 163, 95 (1999).
MATERIALS = {"quartz": (1.54614, 1.55531), "calcite": (1.66160, 1.48765)}


@dataclass(frozen=True, eq=False)
class Prism:
    """A Nomarski prism with its compensator.

    shear: full displacement (y, x) in µm between the two beams.
    bias: phase in rad by which beam 1 leads. Beam 1 is displaced by −shear/2, so that it sees U(x + shear/2).
    axis: angle in rad from +x towards +y along which beam 1 is polarised; beam 2 is polarised across it. None is the
    direction of the shear, or +x for a shear of exactly 0. It matters only where lenses act on polarisation, see
    `torchdic.instrument.polarised_lenses`.

    Numbers or tensors; tensors are learned. Raises ValueError where a value is not finite or the shear isn't a pair.
    """

    shear: tuple[float | Tensor, float | Tensor] | Float[Tensor, " 2"]
    bias: float | Tensor
    axis: float | Tensor | None = None

    def __post_init__(self) -> None:
        if len(self.shear) != 2:
            raise ValueError(f"shear has {len(self.shear)} components: it must be (y, x) in µm")
        named = {"shear y": self.shear[0], "shear x": self.shear[1], "bias": self.bias, "axis": self.axis}
        for name, value in named.items():
            if value is None:
                continue
            plain = number(value)
            if not math.isfinite(plain):
                raise ValueError(f"{name} {plain} must be a finite number")

    @classmethod
    def senarmont(
        cls,
        shear: tuple[float | Tensor, float | Tensor] | Float[Tensor, " 2"],
        polariser: float | Tensor,
        *,
        axis: float | Tensor | None = None,
    ) -> "Prism":
        """A centred prism behind de Sénarmont's compensator: the bias is twice the polariser's angle.

        shear: full displacement (y, x) in µm between the two beams.
        polariser: angle in rad by which the polariser is turned from its crossed position, at 45° to the prism's axes,
        towards beam 2's axis. Behind it stands a quarter-wave plate whose slow axis is at 45°.
        axis: of beam 1's polarisation, see `Prism`.
        """
        return cls(shear, 2 * polariser, axis)

    @classmethod
    def from_wedge(
        cls,
        angle: float | Tensor,
        focal_length: float | Tensor,
        wavelength: float | Tensor,
        *,
        material: Literal["quartz", "calcite"] | None = None,
        indices: tuple[float | Tensor, float | Tensor] | None = None,
        offset: float | Tensor = 0.0,
        direction: tuple[float, float] = (0.0, 1.0),
        axis: float | Tensor | None = None,
    ) -> "Prism":
        """The prism of two cemented wedges, see the module's docstring.

        angle: ψ in rad of each wedge.
        focal_length: of the objective, f_tube/M, in µm.
        wavelength: in vacuum, µm.
        material: the wedges' crystal, with its indices at 546 nm; or instead
        indices: (n_o, n_e) of the crystal.
        offset: ξ in µm by which the prism is displaced along `direction`.
        direction: (y, x), of any length, in which the wedge that is extraordinary for beam 1 grows thicker.
        axis: of beam 1's polarisation, see `Prism`.

        Numbers or 0-d tensors; tensors are learned. Raises ValueError for a wedge angle that isn't between −π/2 and
        π/2, a focal length or wavelength that isn't positive, a direction of length 0, an unknown material, and where
        both or neither of material and indices are given.
        """
        if (material is None) == (indices is None):
            raise ValueError("a wedge needs either its material or its indices (n_o, n_e)")
        if indices is None:
            if material not in MATERIALS:
                raise ValueError(f"material {material!r} must be one of {', '.join(map(repr, MATERIALS))}")
            indices = MATERIALS[material]
        for name, value in (("focal length", focal_length), ("wavelength", wavelength)):
            if not (0 < number(value) < math.inf):
                raise ValueError(f"{name} {float(value)} µm must be above 0")
        if not (abs(number(angle)) < math.pi / 2):
            raise ValueError(f"wedge angle {float(angle)} rad must lie between −π/2 and π/2")
        length = math.hypot(*direction)
        if not (0 < length < math.inf):
            raise ValueError(f"direction {direction} (y, x) must have a length above 0")
        ordinary, extraordinary = indices
        slope = angle.tan() if isinstance(angle, Tensor) else math.tan(angle)
        shear = 2 * (extraordinary - ordinary) * slope * focal_length
        bias = -2 * math.pi * shear * offset / (wavelength * focal_length)
        return cls((shear * (direction[0] / length), shear * (direction[1] / length)), bias, axis)

    def transfer(self, frequencies: Float[Tensor, "*source 2 y x"]) -> Float[Tensor, "*source y x"]:
        """sin(π f·s + bias/2): interference of the two beams behind a crossed analyser, without a constant factor i.

        frequencies: in 1/µm; the envelope's f if a condenser prism cancels the tilt's phase, else the field's f + f_s.
        """
        return torch.sin(self._half_difference(frequencies))

    def parallel(self, frequencies: Float[Tensor, "*source 2 y x"]) -> Float[Tensor, "*source y x"]:
        """cos(π f·s + bias/2): interference behind a parallel analyser; a crossed analyser stops this light."""
        return torch.cos(self._half_difference(frequencies))

    def shear_phase(self, frequencies: Float[Tensor, "*source 2 y x"]) -> Float[Tensor, "*source y x"]:
        """π f·s: half the phase between the beams, without the bias. frequencies: in 1/µm."""
        y, x = self._shear(frequencies)
        return math.pi * (frequencies[..., 0, :, :] * y + frequencies[..., 1, :, :] * x)

    def polarised_along(self, like: Tensor) -> Float[Tensor, " 2"]:
        """(cos, sin) of the angle from +x towards +y along which beam 1 is polarised, in the dtype of `like`."""
        if self.axis is not None:
            axis = scalar(self.axis, like)
            return torch.stack((axis.cos(), axis.sin()))
        y, x = self._shear(like)
        squared = y.square() + x.square()
        nowhere = squared == 0
        length = torch.where(nowhere, 1, squared).sqrt()
        return torch.stack((torch.where(nowhere, 1, x / length), torch.where(nowhere, 0, y / length)))

    def _half_difference(self, frequencies: Tensor) -> Tensor:
        half_bias = scalar(self.bias, frequencies) / 2
        return self.shear_phase(frequencies) + half_bias

    def _shear(self, like: Tensor) -> tuple[Tensor, Tensor]:
        y, x = (scalar(s, like) for s in self.shear)
        return y, x
