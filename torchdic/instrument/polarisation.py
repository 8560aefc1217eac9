"""The polarising optics of a DIC microscope, where they are not ideal."""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Complex, Float, Inexact
from torch import Tensor

from torchdic.instrument.jones import apply, leaky, linear, retarder, train
from torchdic.instrument.polarised_lenses import JonesPupil
from torchdic.scalar import number, scalar


@dataclass(frozen=True, eq=False)
class Polarisation:
    """What is not ideal about the polarising optics of a DIC microscope; what is None is ideal, and costs nothing.

    polariser_extinction, analyser_extinction: share of crossed intensity that each lets pass, 0 up to 1.
    analyser_error: rad by which the analyser is turned from its crossed position. retardance_error: rad by which the
    plate of de Sénarmont's compensator exceeds a quarter wave; to declare it, were it 0, is to say that each prism's
    bias is set by the compensator, with the polariser turned by half the bias. Numbers or 0-d tensors; tensors are
    learned. These act on DIC images alone: a bright field has no polarisers. pupil: what the lenses between do to
    polarisation, which shows in bright field too, then in unpolarised light.
    Raises ValueError where a value is not finite or an extinction lies outside [0, 1).

    The polariser stands at 45° + t to the prism's axes, the plate's slow axis at 45°, the analyser at −45° + e. With
    K = diag(e^{iϑ}, e^{−iϑ}) the two beams, ϑ = π f·s + bias/2, and J the light's coherency matrix in front of them,
    I = tr(W K J K†). So I = sin²ϑ if all is ideal, and for an analyser off by e the amplitude is
    i·sinϑ·cos e + cosϑ·sin e; a plate of retardance π/2 + δ makes the beams' intensities 1 ± sin(bias)·sin δ and
    their interference cos(bias) + i·sin(bias)·cos δ, which an empty field doesn't show.
    """

    polariser_extinction: float | Tensor | None = None
    analyser_extinction: float | Tensor | None = None
    analyser_error: float | Tensor | None = None
    retardance_error: float | Tensor | None = None
    pupil: JonesPupil | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None or field.name == "pupil":
                continue
            plain = number(value)
            if not math.isfinite(plain):
                raise ValueError(f"{field.name} {plain} must be a finite number")
            if field.name.endswith("extinction") and not (0 <= plain < 1):
                raise ValueError(f"{field.name} {plain} must be at least 0 and below 1: a share of crossed light")

    @property
    def ideal(self) -> bool:
        """Whether nothing is declared: the two beams are then a scalar pair."""
        errors = (getattr(self, field.name) for field in fields(self) if field.name != "pupil")
        return not self.vectorial and all(error is None for error in errors)

    @property
    def vectorial(self) -> bool:
        """Whether the pupil mixes the beams' polarisations, so that they are no scalar pair."""
        return self.pupil is not None and not self.pupil.ideal

    @property
    def states(self) -> int:
        """Pure states of polariser and analyser, one each or two where it leaks, that add up to a DIC image."""
        return (1 if self.polariser_extinction is None else 2) * (1 if self.analyser_extinction is None else 2)

    def form(self, bias: float | Tensor) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Complex[Tensor, ""]]:
        """The intensity's quadratic form (a, b, c) in the fields S and C behind sinϑ and cosϑ, on the CPU.

        I = a·|S|² + b·|C|² + Re(c·C·S*), from K = cosϑ + iZ·sinϑ with Z = diag(1, −1): a = tr(WZJZ), b = tr(WJ),
        c = −2i·tr(WJZ). bias: the prism's, in rad. float64, so that at extinction nothing but rounding is left of b.
        The pupil has no part in it.
        """
        analyser, light, plate = self._optics(bias)
        W, J = (leaky(*element).to(torch.complex128) for element in (analyser, light))
        if plate is not None:
            # ϑ holds the bias, as the ideal compensator gives it: the last element takes it back out
            plate = train(plate, retarder(-_double(bias), 0.0))
            J = train(plate.mH, J, plate)
        Z = torch.tensor([1.0, -1.0], dtype=torch.float64)
        WJ = W * J.mT  # elementwise: the trace of a product
        return (WJ * (Z[:, None] * Z)).sum().real, WJ.sum().real, -2j * (WJ * Z[:, None]).sum()

    def transfers(
        self,
        pupil: Inexact[Tensor, "#source 2 2 #y #x"],
        half: Float[Tensor, "source y x"],
        tilt: Float[Tensor, " source"] | None,
        axis: Float[Tensor, " 2"],
        bias: float | Tensor,
        *,
        turned: bool = False,
    ) -> tuple[Float[Tensor, " state"], Complex[Tensor, "state component source y x"]]:
        """What multiplies the spectrum for each pure state of the light, and the states' shares of the intensity.

        Behind the analyser's state w, in light of the polariser's state v, the amplitude is Σ w_b* K_b J_ba C_a v_a: J
        is the pupil in the frame of the prism, K_b = exp(±i(π(f + f_s)·s + bias/2)) the objective's prism, upper sign
        for beam 1, and C_a = exp(∓iπ f_s·s) the condenser's. Ideal polarisers have one state each, leaky ones two. A
        compensator's bias is given to the light in front of all these.

        pupil: in the laboratory's frame. half: π(f + f_s)·s. tilt: π f_s·s, or None where there is no condenser prism.
        axis: (cos, sin) of beam 1's polarisation in the laboratory. turned: whether the spectrum has the components
        along +x and +y that light along +x gets in the specimen, which turns all light alike, or is a scalar.
        """
        analyser, light, plate = self._optics(bias)
        (shares, states), (passed, analysed) = _pure_states(*light), _pure_states(*analyser)
        if plate is not None:
            states, bias = apply(plate, states), 0.0
        kind, device = half.dtype, half.device
        weights = (passed[:, None] * shares).flatten().to(device, kind)
        cos, sin = axis
        one, two = states.to(device, kind.to_complex())[:, None].unbind(-1)
        if tilt is not None:
            condenser = torch.polar(torch.ones_like(tilt), -tilt)
            one, two = one * condenser, two * condenser.conj()
        laboratory = torch.stack((cos * one - sin * two, sin * one + cos * two), -1)
        x, y = _behind(pupil, laboratory, turned).unbind(3)
        prism = torch.polar(torch.ones_like(half), half + scalar(bias, half) / 2)
        beams = prism * (cos * x + sin * y), prism.conj() * (cos * y - sin * x)
        first, second = analysed.to(device, kind)[:, :, None, None, None, None, None].unbind(1)
        return weights, (first * beams[0] + second * beams[1]).flatten(0, 1)

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

    def intensity(
        self, crossed: Complex[Tensor, "source y x"], parallel: Complex[Tensor, "source y x"], bias: float | Tensor
    ) -> Float[Tensor, "source y x"]:
        """The intensity from the fields S and C behind sinϑ and cosϑ, see `form`."""
        kinds = (crossed.real.dtype, crossed.real.dtype, crossed.dtype)
        a, b, c = (v.to(crossed.device, kind) for v, kind in zip(self.form(bias), kinds, strict=True))
        return a * _squared(crossed) + b * _squared(parallel) + (c * parallel * crossed.conj()).real


def unpolarised(
    pupil: Inexact[Tensor, "#source 2 2 #y #x"], *, turned: bool = False
) -> tuple[Float[Tensor, " state"], Inexact[Tensor, "state component source y x"]]:
    """`Polarisation.transfers` of a bright field, half of whose light comes in along x and half along y."""
    real = pupil.real if pupil.is_complex() else pupil
    behind = _behind(pupil, torch.eye(2, dtype=real.dtype, device=real.device)[:, None], turned)
    return real.new_full((4,), 0.5), behind.movedim(3, 1).flatten(0, 1)


def _behind(pupil: Tensor, light: Tensor, turned: bool) -> Tensor:
    """Light (state, source, 2) behind the pupil, (state, component, source, 2, y, x); see `Polarisation.transfers`."""
    parts = [light, torch.stack((-light[..., 1], light[..., 0]), -1)] if turned else [light]
    x, y = torch.stack(parts, 1)[..., None, None, None].unbind(3)
    return pupil[:, :, 0] * x + pupil[:, :, 1] * y


def _pure_states(angle: Tensor, extinction: Tensor | None) -> tuple[Tensor, Tensor]:
    """Shares (state,) and Jones vectors (state, 2) whose projections add up to `leaky`."""
    if extinction is None:
        return torch.ones_like(angle)[None], linear(angle)[None]
    shares = torch.stack((torch.ones_like(extinction), extinction))
    return shares, torch.stack((linear(angle), linear(angle + math.pi / 2)))


def _double(value: float | Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device="cpu")


def _squared(field: Tensor) -> Tensor:
    return torch.view_as_real(field).square().sum(-1)
