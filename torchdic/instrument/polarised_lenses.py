"""A pupil of Jones matrices: strain in the lenses, losses at their surfaces, and the turn at a high aperture.

All matrices are in the laboratory's frame: axis 1 is +x, axis 2 is +y, angles count from +x towards +y. What the lenses
do is given by Zernike polynomials times the Pauli matrices σ_z = diag(1, −1), of axes along x and y, and
σ_x = [[0, 1], [1, 0]], of axes at ±45°. Light meets the losses, then the strain:

    J = exp(½i(Γ1 σ_z + Γ2 σ_x)) · exp(½(D1 σ_z + D2 σ_x))/√cosh|D|.

The first factor is a retarder of |Γ| whose slow axis lies at ½·atan2(Γ2, Γ1). The second passes the intensities
1 ± tanh|D| along and across the axis at ½·atan2(D2, D1), whose mean is 1: what the lenses take from all polarisations
alike is a matter of the objective's apodisation, and the factor has no kink at D = 0, as exp(−½|D|) would.

At a high aperture the lenses turn polarisation too. A wave of direction k is polarised across k, in the specimen, and
across the axis, in the pupils; aplanatic lenses turn the one into the other by the shortest turn of z to k, which keeps
s and tilts p. M(k) (3×2) is that turn's effect on x and y. A scalar amplitude S scattered from k0 into k becomes, since
a dipole radiates the transverse part (1 − kkᵀ) of its field, the matrix S·M(k)ᵀM(k0): exact as Δn → 0, and for stronger
specimens as good as light that is scattered once. With k = (t, c), t = p/n,

    M(k)ᵀM(k0) = T(t)T(t0) + t t0ᵀ,    T(t) = 1 − t tᵀ/(1 + c),

regular on the axis and 1 for k = k0. Bent rays carry their polarisation themselves, see `torchdic.rays`.

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

    retardance: strain's birefringence in the objective's pupil as {Noll index: (Γ1, Γ2)} in rad, rms over the pupil; a
    curved lens strained about its axis, slow along the radius, has {6: (g, 0), 5: (0, g)}. diattenuation: {Noll index:
    (D1, D2)}, likewise; Fresnel losses at steep surfaces, which pass p better than s, have g > 0 there. Numbers or 0-d
    tensors, which are learned; as all phases in rad they hold at each wavelength. depolarisation: whether condenser
    and objective turn polarisation between pupil and specimen, as they do at a high aperture.
    Raises ValueError for a Noll index below 1, and a value that isn't a pair or not finite.
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
        """Whether the lenses have Zernike terms, which need the pupil's radius."""
        return bool(self.retardance) or bool(self.diattenuation)

    @property
    def ideal(self) -> bool:
        """Whether nothing is declared: the pupil is then a scalar."""
        return not (self.strained or self.depolarisation)

    def lenses(self, pupil: Float[Tensor, "source 2 y x"]) -> Inexact[Tensor, "source 2 2 y x"] | None:
        """The lenses' matrices at (y, x) in the pupil, in units of its radius; real without retardance.

        None: the lenses have no Zernike terms.
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
    half = torch.linalg.vector_norm(gamma, dim=0) / 2  # whose gradient at 0 is 0, as that of what is even in it
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
    """M(k)ᵀM(k0), the lenses' turn of a wave of transverse momentum p (y, x) that the direct one, p0, excites."""
    t, t0 = momentum.flip(1) / background, direct.flip(1)[:, :, None, None] / background
    return product(_tilt(t), _tilt(t0)) + t[:, :, None] * t0[:, None]


def product(
    left: Inexact[Tensor, "#source 2 2 #y #x"], right: Inexact[Tensor, "#source 2 2 #y #x"]
) -> Inexact[Tensor, "source 2 2 y x"]:
    """The product of two fields of matrices, light meeting the right one first."""
    return left[:, :, :1] * right[:, :1] + left[:, :, 1:] * right[:, 1:]


def _tilt(t: Tensor) -> Tensor:
    """T(t), what the shortest turn of z to k does within the plane."""
    cosine = (1 - t.square().sum(1)).sqrt()
    outer = t[:, :, None] * t[:, None] / (1 + cosine)[:, None, None]
    return torch.eye(2, dtype=t.dtype, device=t.device)[:, :, None, None] - outer


def _pauli_zernike(coefficients: PauliZernike, pupil: Tensor) -> Tensor:
    """The two parts of a Pauli–Zernike series over the pupil, (2, source, y, x)."""
    rho, theta = pupil.square().sum(1).sqrt(), torch.atan2(pupil[:, 0], pupil[:, 1])
    total = rho.new_zeros(())
    for noll, pair in coefficients.items():
        c = torch.stack([scalar(value, rho) for value in pair])
        total = total + c[:, None, None, None] * zernike(noll, rho, theta)
    return total


def _matrix(first: Tensor, second: Tensor, off: Tensor) -> Tensor:
    """Symmetric matrices of their elements, (source, 2, 2, y, x)."""
    return torch.stack((first, off, off, second), 1).unflatten(1, (2, 2))
