"""What lenses do to polarisation: strain, losses at their surfaces, and the turn at a high aperture.

All matrices are in the laboratory's frame: axis 1 is +x, axis 2 is +y, and angles count from +x towards +y. Strain and
losses are Zernike polynomials over the objective's pupil times the Pauli matrices σ_z = diag(1, −1), whose axes lie
along x and y, and σ_x = [[0, 1], [1, 0]], whose axes lie at ±45°. Light meets the losses first, then the strain:

    J = exp(½i(Γ1 σ_z + Γ2 σ_x)) · exp(½(D1 σ_z + D2 σ_x))/√cosh|D|.

The first factor is a retarder of |Γ| whose slow axis lies at ½·atan2(Γ2, Γ1). The second factor passes the intensities
1 ± tanh|D| along and across the axis at ½·atan2(D2, D1), whose mean is 1. A loss that is the same for all polarisations
belongs to the objective's apodisation instead. In this form the second factor is smooth at D = 0, unlike exp(−½|D|).

At a high aperture the lenses turn polarisation too. In the specimen, a wave of direction k is polarised across k; in
the pupils, across the axis. Aplanatic lenses turn the one into the other by the shortest turn of z to k, which keeps s
and tilts p. The 3×2 matrix M(k) is that turn's effect on x and y. A dipole radiates the transverse part (1 − kkᵀ) of
its field, so a scalar amplitude S scattered from k0 into k becomes the matrix S·M(k)ᵀM(k0). This is exact as Δn → 0; in
stronger specimens it is as good as the assumption that light is scattered once. With k = (t, c), t = p/n,

    M(k)ᵀM(k0) = T(t)T(t0) + t t0ᵀ,    T(t) = 1 − t tᵀ/(1 + c),

which is regular on the axis, and 1 for k = k0. Bent rays carry their polarisation themselves, see `torchdic.rays`.

R. C. Jones, J. Opt. Soc. Am. 32, 486 (1942); S.-Y. Lu and R. A. Chipman, J. Opt. Soc. Am. A 13, 1106 (1996) for the
polar decomposition; B. Richards and E. Wolf, Proc. R. Soc. A 253, 358 (1959) for the lenses' turn.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Inexact
from torch import Tensor

from torchdic.instrument.zernike import zernike
from torchdic.scalar import number, scalar

PauliZernike = Mapping[int, Sequence[float | Tensor]]


@dataclass(frozen=True, eq=False)
class JonesPupil:
    """What the lenses do to polarisation, see the module's docstring; what is None or False costs nothing.

    retardance: birefringence of strain in the objective's pupil as {Noll index: (Γ1, Γ2)} in rad, rms over the pupil. A
    lens that is strained about its axis, and slow along the radius, has {6: (g, 0), 5: (0, g)} with g > 0.
    diattenuation: losses in the objective's pupil as {Noll index: (D1, D2)}. Fresnel losses at steep surfaces, which
    pass p better than s, have {6: (g, 0), 5: (0, g)} with g > 0.
    depolarisation: whether condenser and objective turn polarisation between pupil and specimen, as they do at a high
    aperture.

    Γ and D are numbers or 0-d tensors; tensors are learned. Like all phases in rad they hold at each wavelength.
    Raises ValueError for a Noll index below 1, and for a value that isn't a pair or isn't finite.
    """

    retardance: PauliZernike | None = None
    diattenuation: PauliZernike | None = None
    depolarisation: bool = False

    def __post_init__(self) -> None:
        for name in ("retardance", "diattenuation"):
            for noll, pair in (getattr(self, name) or {}).items():
                if isinstance(noll, bool) or not isinstance(noll, int) or noll < 1:
                    raise ValueError(f"{name} {noll!r}: a Noll index is a whole number from 1")
                if len(pair) != 2:
                    raise ValueError(f"{name} {noll}: {len(pair)} values, it takes 2: along x and y, and at 45°")
                for value in pair:
                    plain = number(value)
                    if not math.isfinite(plain):
                        raise ValueError(f"{name} {noll}: {plain} must be a finite number")

    @property
    def strained(self) -> bool:
        """Whether the lenses have Zernike terms; these need a pupil, of known radius."""
        return bool(self.retardance) or bool(self.diattenuation)

    def lenses(self, pupil: Float[Tensor, "source 2 y x"]) -> Inexact[Tensor, "source 2 2 y x"] | None:
        """The matrices of strain and losses; real without retardance, None where the lenses have no Zernike terms.

        pupil: places (y, x) in the pupil, in units of its radius.
        """
        elements = []
        if self.retardance:
            elements.append(retarding(_pauli_zernike(self.retardance, pupil)))
        if self.diattenuation:
            elements.append(diattenuating(_pauli_zernike(self.diattenuation, pupil)))
        if not elements:
            return None
        return elements[0] if len(elements) == 1 else product(*elements)


def retarding(gamma: Float[Tensor, "2 source y x"]) -> Complex[Tensor, "source 2 2 y x"]:
    """exp(½i(Γ1 σ_z + Γ2 σ_x)) = cos(|Γ|/2) + i·sinc(|Γ|/2)·½(Γ1 σ_z + Γ2 σ_x)."""
    # its gradient at 0 is 0, and that is right: only even functions of it follow
    half = torch.linalg.vector_norm(gamma, dim=0) / 2
    one = half.cos()
    z, x = torch.sinc(half / math.pi) * gamma / 2
    zero = torch.zeros_like(one)
    return torch.complex(_matrix(one, one, zero), _matrix(z, -z, x))


def diattenuating(d: Float[Tensor, "2 source y x"]) -> Float[Tensor, "source 2 2 y x"]:
    """exp(½(D1 σ_z + D2 σ_x))/√cosh|D|, with the exponential cosh(|D|/2) + sinhc(|D|/2)·½(D1 σ_z + D2 σ_x)."""
    half = torch.linalg.vector_norm(d, dim=0) / 2
    there = half > 0
    sinhc = torch.where(there, torch.sinh(half) / torch.where(there, half, 1), 1)
    norm = (2 * half).cosh().rsqrt()
    one = half.cosh() * norm
    z, x = sinhc * norm * d / 2
    return _matrix(one + z, one - z, x)


def turn(
    momentum: Float[Tensor, "source 2 y x"], direct: Float[Tensor, "source 2"], background: Tensor
) -> Float[Tensor, "source 2 2 y x"]:
    """M(k)ᵀM(k0): how the lenses turn the polarisation of light that is scattered from the direction k0 into k.

    momentum: p of the scattered waves, n·sinθ as (y, x). direct: p0 of each source. background: index of the medium.
    """
    t, t0 = momentum.flip(1) / background, direct.flip(1)[:, :, None, None] / background
    return product(_tilt(t), _tilt(t0)) + t[:, :, None] * t0[:, None]


def product(
    left: Inexact[Tensor, "#source 2 2 #y #x"], right: Inexact[Tensor, "#source 2 2 #y #x"]
) -> Inexact[Tensor, "source 2 2 y x"]:
    """The product of matrices at each wave; light meets the right one first."""
    return left[:, :, :1] * right[:, :1] + left[:, :, 1:] * right[:, 1:]


def _tilt(t: Tensor) -> Tensor:
    """T(t): what the shortest turn of z to k does to x and y within their plane."""
    squared = 1 - t.square().sum(1)
    # rounding may take a grazing wave to 0, where the root has no slope
    cosine = torch.where(squared > 0, torch.where(squared > 0, squared, 1).sqrt(), 0)
    outer = t[:, :, None] * t[:, None] / (1 + cosine)[:, None, None]
    return torch.eye(2, dtype=t.dtype, device=t.device)[:, :, None, None] - outer


def _pauli_zernike(coefficients: PauliZernike, pupil: Tensor) -> Tensor:
    """The factors of σ_z and σ_x over the pupil, (2, source, y, x)."""
    rho, theta = pupil.square().sum(1).sqrt(), torch.atan2(pupil[:, 0], pupil[:, 1])
    total = rho.new_zeros(())
    for noll, pair in coefficients.items():
        c = torch.stack([scalar(value, rho) for value in pair])
        total = total + c[:, None, None, None] * zernike(noll, rho, theta)
    return total


def _matrix(first: Tensor, second: Tensor, off: Tensor) -> Tensor:
    """Symmetric matrices (source, 2, 2, y, x) from their elements (source, y, x)."""
    return torch.stack((first, off, off, second), 1).unflatten(1, (2, 2))
