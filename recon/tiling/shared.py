"""What all tiles of a field share, as they would in a fit of the whole: one scale of the misfit, one weight of the
priors, one contrast that they know, and one value of what is learned beside Δn.

The tiles whose images show most are the leaders. Each is fitted as any field is, but that the first one gives the
others what it has learned. Each finds a weight by its own noise, and that is known to it only roughly; their mean is
known better, and all go by it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.fit.nuisances.light import Lamp
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference, Unknown
from recon.misfit.base import Misfit
from recon.misfit.level import image_means
from recon.prior.base import contrast


@dataclass(frozen=True)
class Finding:
    """What one leader's fit says of the specimen.

    weight: of the priors in the end, and least: on its way, in the first tile's scale; None where it took too few steps
    to find one. contrast: of the specimen. squares: the sum of Δn².
    """

    weight: float | None
    least: float | None
    contrast: float
    squares: float

    @classmethod
    def by(cls, last: Step, scale: float = 1.0) -> "Finding":
        """What a leader's last step says. scale: the first tile's over its own, see `scale_over`."""
        weights = [scale * record["tv"] for record in last.weights]
        squares = float(last.delta.square().sum(dtype=torch.float64))
        found, least = (weights[-1], min(weights)) if weights else (None, None)
        return cls(found, least, contrast(last.delta), squares)


@dataclass(frozen=True, eq=False)
class LearnedByFirst:
    """What the first tile's fit says of all tiles.

    misfit: whose scale is that of all. values: of what was learned beside Δn, by name, but for the lamp: an uneven one
    is another one in each tile.
    """

    misfit: Misfit
    values: dict[str, Tensor]

    @classmethod
    def by(cls, problem: Problem, last: Step) -> "LearnedByFirst":
        """What a finished fit says. problem: the first tile's. last: its last step."""
        own = {unknown.name for unknown in problem.unknowns if is_of_tile(unknown)}
        return cls(problem.misfit, {name: value for name, value in last.values.items() if name not in own})


def is_of_tile(unknown: Unknown) -> bool:
    """Whether each tile has its own value of an unknown."""
    return isinstance(unknown, IndexDifference | Lamp)


@dataclass(frozen=True)
class SharedPriors:
    """What the priors of all tiles go by.

    weight: to which all go, from `least` on; None where no leader has found one. contrast: of the specimen.
    """

    weight: float | None
    least: float | None
    contrast: float

    @classmethod
    def by(cls, findings: Sequence[Finding]) -> "SharedPriors":
        """What leaders say together, each by its share of the specimen: the misfit depends on the weight only there."""
        typical = _mean([finding.contrast for finding in findings], findings)
        told = [(f, f.weight, f.least) for f in findings if f.weight is not None and f.least is not None]
        if not told:
            return cls(None, None, typical)
        having, weights, leasts = zip(*told, strict=True)
        weight, least = (math.exp(_mean([math.log(v) for v in values], having)) for values in (weights, leasts))
        return cls(weight, least, typical)


def scale_over(misfit: Misfit, other: Misfit) -> float:
    """What weights count for beside one misfit, over what they count for beside another one of the same images.

    Both are taken of images that show nothing: prisms that differ in what they show differ in their scales, too.
    """
    nothing = image_means(misfit.data, misfit.mask).expand_as(misfit.data)
    return float(misfit(nothing)) / float(other(nothing))


def _mean(values: Sequence[float], findings: Sequence[Finding]) -> float:
    """The mean of a value of each finding; of empty volumes, all count alike."""
    shares = [finding.squares for finding in findings]
    if sum(shares) == 0:
        shares = [1.0] * len(findings)
    return sum(share * value for share, value in zip(shares, values, strict=True)) / sum(shares)
