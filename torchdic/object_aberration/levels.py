"""Space-variant defocus: each object point spreads with its own defocus (Kagalwala & Kanade, Eq. 6).

Light of the point x' of the field U at the reference plane reaches the lens as if the point lay nearer by δ(x'):
    S(f) = Σ_x' U(x')·exp(−2πi f·x')·exp(−i k0 δ(x') q(f)),    q = p_z(f + f_s) − p_z0.
This is no convolution. The last factor is therefore interpolated between K levels δ_k that span the field's δ:
    S(f) = Σ_k F[U·w_k](f)·exp(−i k0 δ_k q(f)),    Σ_k w_k = 1.
The levels are the Chebyshev nodes, and w_k(δ) are their Lagrange polynomials, which are smooth in δ (hat functions are
not). For a phase that spans ±b rad the coefficients are Bessel functions, 2|J_j(b)| ≤ 2(b/2)^j/j!. So from K ≥ b on the
error is below
    4·Σ_{j ≥ K} |J_j(b)| ≤ 8·(b/2)^K/K!,    b = k0·max|q|·(δ_max − δ_min)/2.
K is the smallest number for which this is a rounding error: 9 levels for b = 1 in float32. As many hat functions, in
steps of 0.25 rad, leave an error of 1 %.

δ is the object's aberration for an axial ray, the same for all sources. It stands in for the amplitude that straight
rays lack. Rays with their amplitude and waves have it already, and would count it twice.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.instrument.microscope import Microscope
from torchdic.object_aberration.wavefront import CAREFUL, effective_defocus
from torchdic.plane_waves import exp_i, to_spectrum
from torchdic.scalar import number
from torchdic.specimen.volume import Volume

# Largest number of levels: δ is without bound where light leaves collimated.
MOST_LEVELS = 128

# Smallest phase in rad that the levels span: in a narrower one, rounding would hide the slopes.
LEAST_SPAN = 0.1


@dataclass(frozen=True, eq=False)
class Levels:
    """Depths by which object points seem nearer, and how each point is shared among them.

    defocus: the levels δ_k in µm, (level,).
    share: w_k of each point, (level, y, x).
    """

    defocus: Float[Tensor, " level"]
    share: Float[Tensor, "level y x"]

    def spread(
        self,
        field: Complex[Tensor, "source *component y x"],
        wavelength: float,
        difference: Float[Tensor, "source y x"],
    ) -> Complex[Tensor, "source *component y x"]:
        """The spectrum of a field in which each point spreads with its own defocus.

        field: (source, y, x) or (source, component, y, x).
        wavelength: in vacuum, µm.
        difference: p_z(f + f_s) − p_z0, (source, y, x).
        """
        k0 = 2 * math.pi / wavelength
        difference = difference.reshape(len(difference), *[1] * (field.ndim - 3), *difference.shape[1:])
        parts = (
            to_spectrum(field * share) * exp_i(-k0 * defocus * difference)
            for defocus, share in zip(self.defocus, self.share, strict=True)
        )
        return sum(parts, start=torch.zeros_like(field))


def object_levels(volume: Volume, plane: float, microscope: Microscope, fidelity: Fidelity, least: int = 2) -> Levels:
    """Levels of the volume's own aberration at depth `plane` (µm), by the method that the fidelity names.

    volume: with its padding.
    microscope: of one wavelength.
    least: smallest number of levels.
    The rays for the map are those of `CAREFUL`, traced by rk4 through a cubic spline, in the fidelity's steps. A cone's
    half angle is asin(NA_c/n0). It only says where to look, so it carries no gradient. Raises ValueError for a cone
    without a condenser's aperture, and as `effective_defocus` and `levels` do.
    """
    n0 = number(volume.background)
    half_angle = None
    if fidelity.object_aberration == "cone":
        na = 0.0 if microscope.condenser is None else microscope.condenser.na
        if na == 0:
            raise ValueError(
                'object_aberration "cone" takes its half angle from the condenser, whose NA must be above 0'
            )
        half_angle = math.asin(min(na / n0, 1.0))
    careful = replace(CAREFUL, steps=fidelity.steps, memory=fidelity.memory)
    assert fidelity.object_aberration is not None
    defocus = effective_defocus(
        volume, plane, fidelity=careful, method=fidelity.object_aberration, half_angle=half_angle
    )
    momentum, _ = microscope.sources(fidelity.sources, dtype=volume.delta.dtype, device=volume.delta.device)
    steepest = float(momentum.detach().norm(dim=-1).max())
    objective = microscope.objective
    reach = n0 if objective is None else min(n0, max(objective.na, steepest))
    # the exact difference; the paraxial one is smaller
    rate = 2 * math.pi / microscope.wavelength * (n0 - math.sqrt(n0**2 - reach**2))
    return levels(defocus, rate, least=least)


def levels(defocus: Float[Tensor, "y x"], rate: float, tolerance: float | None = None, *, least: int = 2) -> Levels:
    """Levels for a field's δ (y, x) in µm.

    defocus: δ.
    rate: largest change of the phase, in rad per µm of δ.
    tolerance: largest error of the factor exp(−i k0 δ q). None is a rounding error of δ's dtype.
    least: smallest number of levels.
    The depths of the levels carry no gradient, because the field does not depend on them, except for rounding. Raises
    ValueError if δ is not finite, or needs more than MOST_LEVELS.
    """
    low, high = (float(v) for v in torch.aminmax(defocus.detach()))
    if not (math.isfinite(low) and math.isfinite(high)):
        raise ValueError("object_aberration is without bound: light of some object point leaves the volume collimated")
    half = max((high - low) / 2, LEAST_SPAN / rate)
    count = max(least, _count(rate * half, tolerance or torch.finfo(defocus.dtype).eps))
    if count > MOST_LEVELS:
        raise ValueError(
            f"object_aberration from {low:.4g} to {high:.4g} µm asks for {count} levels, more than {MOST_LEVELS}: "
            "light of some object points leaves the volume almost collimated"
        )
    angle = math.pi * (torch.arange(count, dtype=torch.float64) + 0.5) / count
    centre = (low + high) / 2
    # Lagrange's polynomial of node k: Σ' (2/K)·T_m(t_k)·T_m(t), the first term halved
    matrix = 2 / count * torch.cos(angle[:, None] * torch.arange(count))
    matrix[:, 0] /= 2
    t = (defocus - centre) / half
    chebyshev = [torch.ones_like(t), t]
    for _ in range(count - 2):
        chebyshev.append(2 * t * chebyshev[-1] - chebyshev[-2])
    share = torch.tensordot(matrix.to(t), torch.stack(chebyshev), 1)
    return Levels((centre + half * angle.cos()).to(t), share)


def _count(span: float, tolerance: float) -> int:
    """The number of levels that interpolate exp(iφ), |φ| ≤ span, to the tolerance; see the module's docstring."""
    count = max(2, math.ceil(span))
    while math.log(8) + count * math.log(span / 2) - math.lgamma(count + 1) > math.log(tolerance):
        count += 1
    return count
