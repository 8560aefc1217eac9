"""The polarising optics of a DIC microscope, where they are not ideal."""

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.instrument.jones import apply, leaky, linear, retarder, train
from torchdic.instrument.polarised_lenses import JonesPupil
from torchdic.scalar import number


class PureStates(NamedTuple):
    """Light, or what an analyser passes, as a sum of pure states: shares (state,) and Jones vectors (state, 2)."""

    shares: Float[Tensor, " state"]
    vectors: Float[Tensor, "state 2"] | Complex[Tensor, "state 2"]


@dataclass(frozen=True, eq=False)
class Polarisation:
    """What is not ideal about the polarising optics of a DIC microscope; what is None is ideal, and costs nothing.

    polariser_extinction, analyser_extinction: the share of crossed intensity that polariser and analyser let pass, from
    0 up to below 1.
    analyser_error: angle in rad by which the analyser is turned from its crossed position.
    retardance_error: rad by which the plate of de Sénarmont's compensator exceeds a quarter wave. To give it, even as
    0, says that the compensator sets each prism's bias: the polariser is then turned by half the bias.
    pupil: what the lenses between polariser and analyser do to polarisation.

    All but the pupil are numbers or 0-d tensors; tensors are learned. They act on DIC images alone, because a bright
    field has no polarisers. The pupil acts on bright field too, whose light is then unpolarised.
    Raises ValueError where a value is not finite or an extinction lies outside [0, 1).

    The polariser stands at 45° + t to the prism's axes, the plate's slow axis at 45°, the analyser at −45° + e. With
    K = diag(e^{iϑ}, e^{−iϑ}) the two beams, ϑ = π f·s + bias/2, W = A†A of the analyser (`torchdic.instrument.jones`)
    and J the light's coherency matrix in front of the beams, I = tr(W K J K†). So I = sin²ϑ if all is ideal. For an
    analyser off by e the amplitude is i·sinϑ·cos e + cosϑ·sin e. A plate of retardance π/2 + δ makes the beams'
    intensities 1 ± sin(bias)·sin δ and their interference cos(bias) + i·sin(bias)·cos δ; an empty field shows neither.
    """

    polariser_extinction: float | Tensor | None = None
    analyser_extinction: float | Tensor | None = None
    analyser_error: float | Tensor | None = None
    retardance_error: float | Tensor | None = None
    pupil: JonesPupil | None = None

    def __post_init__(self) -> None:
        for name, value in self.declared.items():
            plain = number(value)
            if not math.isfinite(plain):
                raise ValueError(f"{name} {plain} must be a finite number")
            if name.endswith("extinction") and not (0 <= plain < 1):
                raise ValueError(f"{name} {plain} must be at least 0 and below 1: a share of crossed light")

    @property
    def declared(self) -> dict[str, float | Tensor]:
        """What is given about polariser, analyser and plate, by name; empty where they are ideal."""
        given = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "pupil"}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def states(self) -> int:
        """How many pure states add up to a DIC image: polariser and analyser have one each, or two if they leak."""
        return (1 if self.polariser_extinction is None else 2) * (1 if self.analyser_extinction is None else 2)

    def form(self, bias: float | Tensor) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Complex[Tensor, ""]]:
        """The coefficients (a, b, c) of the intensity as a quadratic form in two fields, in float64 on the CPU.

        S and C are the field times sinϑ and cosϑ (the frequency's): I = a·|S|² + b·|C|² + Re(c·C·S*). From
        K = cosϑ + iZ·sinϑ with Z = diag(1, −1): a = tr(WZJZ), b = tr(WJ), c = −2i·tr(WJZ). The lenses' pupil plays no
        part. float64 leaves no more than its rounding of b at extinction.

        bias: of the prism, rad.
        """
        analyser, light, plate = self._optics(bias)
        W, J = (leaky(*element).to(torch.complex128) for element in (analyser, light))
        if plate is not None:
            # ϑ contains the bias that an ideal compensator would give: the last element takes it out again
            plate = train(plate, retarder(-_double(bias), 0.0))
            J = train(plate.mH, J, plate)
        Z = torch.tensor([1.0, -1.0], dtype=torch.float64)
        WJ = W * J.mT  # elementwise: the trace of a product
        return (WJ * (Z[:, None] * Z)).sum().real, WJ.sum().real, -2j * (WJ * Z[:, None]).sum()

    def intensity(
        self, crossed: Complex[Tensor, "source y x"], parallel: Complex[Tensor, "source y x"], bias: float | Tensor
    ) -> Float[Tensor, "source y x"]:
        """The intensity of two scalar beams.

        crossed, parallel: the fields S and C of `form`, behind sinϑ and cosϑ.
        bias: of the prism, rad.
        """
        kinds = (crossed.real.dtype, crossed.real.dtype, crossed.dtype)
        a, b, c = (v.to(crossed.device, kind) for v, kind in zip(self.form(bias), kinds, strict=True))
        return a * _squared(crossed) + b * _squared(parallel) + (c * parallel * crossed.conj()).real

    def pure_states(self, bias: float | Tensor) -> tuple[PureStates, PureStates, float | Tensor]:
        """The pure states of the light in front of the prisms and of the analyser, and the bias left to the prism.

        A compensator gives its bias to the light and leaves 0 to the prism. Vectors are in the frame of the prism, in
        float64 on the CPU.

        bias: as the prism declares it, rad.
        """
        analyser, light, plate = self._optics(bias)
        states = _pure_states(*light)
        if plate is not None:
            states, bias = PureStates(states.shares, apply(plate, states.vectors)), 0.0
        return states, _pure_states(*analyser), bias

    def _optics(
        self, bias: float | Tensor
    ) -> tuple[tuple[Tensor, Tensor | None], tuple[Tensor, Tensor | None], Tensor | None]:
        """Analyser and polariser (angle, extinction), and the compensator's plate or None, in float64 on the CPU."""
        p, r, e, delta = (
            None if value is None else _double(value)
            for value in (
                self.polariser_extinction,
                self.analyser_extinction,
                self.analyser_error,
                self.retardance_error,
            )
        )
        analyser = _double(-math.pi / 4) if e is None else e - math.pi / 4, r
        if delta is None:
            return analyser, (_double(math.pi / 4), p), None
        return analyser, (_double(bias) / 2 + math.pi / 4, p), retarder(delta + math.pi / 2, math.pi / 4)


def _pure_states(angle: Tensor, extinction: Tensor | None) -> PureStates:
    """The pure states of a polariser, whose projections add up to `leaky`."""
    if extinction is None:
        return PureStates(torch.ones_like(angle)[None], linear(angle)[None])
    shares = torch.stack((torch.ones_like(extinction), extinction))
    return PureStates(shares, torch.stack((linear(angle), linear(angle + math.pi / 2))))


def _double(value: float | Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device="cpu")


def _squared(field: Tensor) -> Tensor:
    return torch.view_as_real(field).square().sum(-1)
