"""The weight of a quadratic prior: from the noise where it is known, and otherwise from the data alone.

Let a least-squares problem min Σ|d − A x|² + w·Σ|x|² be split into components along the eigenvectors of AᴴA, with
eigenvalues s and energies e of the data along them. The prior lets the share s/(s + w) of each component pass. So
    residual(w) = outside + Σ e·(w/(s + w))²,    fitted(w) = Σ s/(s + w),
where `outside` is the energy of the data that no x reaches, and `fitted` counts the numbers that the data determine.

The discrepancy takes the weight whose residual is the noise's, variance·freedom. It smooths too much, since even the
right x is fitted to some of the noise. Counted, the residual is variance·(freedom − fitted(w)) instead.

V. A. Morozov, Soviet Math. Dokl. 7, 414 (1966), for the discrepancy; A. M. Thompson, J. C. Brown, J. W. Kay and D. M.
Titterington, IEEE Trans. Pattern Anal. Mach. Intell. 13, 326 (1991), for the counted one; G. H. Golub, M. Heath and
G. Wahba, Technometrics 21, 215 (1979), for generalised cross-validation; M. A. Lukas, Inverse Problems 22, 1883 (2006),
for its robust form.
"""

import math
import sys
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from scipy.optimize import minimize_scalar, root_scalar
from torch import Tensor

Rule = Literal["discrepancy", "cross-validation"]

# Weights are sought from this part of the greatest eigenvalue to the inverse of it. What a smaller weight would let
# pass is weaker by a factor of 300 than what is seen best: no model is that exact.
_REACH = 1e-5

# Eigenvalues below this part of the greatest are 0 but for rounding.
_ROUNDING = 1e-13

# The part of cross-validation's weight below which a discrepancy's shows the model's error instead of the noise.
_TRUSTED = 0.1

# Weights per decade at which cross-validation is computed before its minimum is refined.
_PER_DECADE = 4


@dataclass(frozen=True, eq=False)
class Components:
    """A least-squares problem in the components of the module's docstring.

    values: eigenvalues s. energies: e of the data along them. counts: how many real numbers each stands for, in the sum
    over all of them. outside: energy of the data that no x reaches. freedom: how many real numbers the data are.
    """

    values: Float[Tensor, " n"]
    energies: Float[Tensor, " n"]
    counts: Float[Tensor, " n"]
    outside: float
    freedom: int

    @classmethod
    def of(cls, values: Tensor, energies: Tensor, counts: Tensor, total: float, freedom: int) -> "Components":
        """The components, in float64. total: energy of all data. The other arguments are as above, and may broadcast.

        Eigenvalues that are 0 but for rounding have no energy.
        """
        values, energies, counts = (
            v.flatten() for v in torch.broadcast_tensors(values.double(), energies.double(), counts.double())
        )
        seen = values > _ROUNDING * values.amax().clamp_min(torch.finfo(torch.float64).tiny)
        values, energies, counts = values[seen], energies[seen], counts[seen]
        return cls(values, energies, counts, max(total - float((counts * energies).sum()), 0.0), freedom)

    def residual(self, weight: float) -> float:
        """Σ|d − A x|² of the x that the weight gives."""
        kept = weight / (self.values + weight)
        return self.outside + float((self.counts * self.energies * kept.square()).sum())

    def fitted(self, weight: float) -> float:
        """How many real numbers of the data the weight lets pass."""
        return float((self.counts * (self.values / (self.values + weight))).sum())

    def noise(self, weight: float) -> float:
        """The variance of the noise in one real number of the data, for which the residual of a weight speaks."""
        return self.residual(weight) / (self.freedom - self.fitted(weight))


def choose_weight(
    components: Components, variance: float | None, *, counted: bool = False, robustness: float = 1.0
) -> tuple[float, Rule]:
    """The weight of a quadratic prior, and the rule by which it is chosen.

    variance: of the noise in one real number of the data; None where it is unknown. counted: whether the discrepancy
    counts the fitted numbers. robustness: of `cross_validated`.
    The discrepancy's weight is infinite where x = 0 leaves no more than the noise. Where the noise is unknown, or
    reached by no weight that is at least a tenth of cross-validation's, the latter is taken: there the model's errors
    and not the noise hold the residual up.
    """
    validated = cross_validated(components, robustness)
    if variance is None:
        return validated, "cross-validation"

    def excess(log_weight: float) -> float:
        weight = math.exp(log_weight)
        expected = components.freedom - (components.fitted(weight) if counted else 0)
        return components.residual(weight) - variance * expected

    least, top = math.log(_TRUSTED * validated), math.log(float(components.values.max()) / _REACH)
    if excess(top) <= 0:
        return math.inf, "discrepancy"
    if excess(least) > 0:
        return validated, "cross-validation"
    return math.exp(root_scalar(excess, bracket=(least, top), xtol=1e-6).root), "discrepancy"


def cross_validated(components: Components, robustness: float = 1.0) -> float:
    """The weight for which generalised cross-validation is least.

    It is residual/(freedom − fitted)²·(γ + (1 − γ)·Σ (s/(s + w))²/freedom), γ the robustness in (0, 1]. With 1 it is
    the plain one, whose weight goes to 0 and x to infinity where the model errs much more than the noise.
    """
    greatest = math.log(float(components.values.max()))
    low, high = greatest + math.log(_REACH), greatest - math.log(_REACH)

    def score(log_weight: float) -> float:
        weight = math.exp(log_weight)
        passed = components.values / (components.values + weight)
        left = components.freedom - components.fitted(weight)
        unstable = float((components.counts * passed.square()).sum()) / components.freedom
        residual = max(components.residual(weight), sys.float_info.min / robustness)
        return math.log(residual * (robustness + (1 - robustness) * unstable)) - 2 * math.log(left)

    steps = math.ceil((high - low) / math.log(10) * _PER_DECADE)
    ladder = [low + (high - low) * i / steps for i in range(steps + 1)]
    scores = [score(t) for t in ladder]
    best = scores.index(min(scores))
    below, above = ladder[max(best - 1, 0)], ladder[min(best + 1, steps)]
    return math.exp(minimize_scalar(score, bounds=(below, above), method="bounded").x)
