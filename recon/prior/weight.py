"""The prior's weight: it follows the noise.

The true specimen leaves the noise's misfit (V. A. Morozov's discrepancy principle). A volume that leaves less follows
the noise, and gets more weight; one that leaves more is held back by the prior, and gets less.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit.base import Misfit
from recon.misfit.level import image_means

# Part of what isn't noise that even the best volume leaves: voxels and directions are finite.
MODEL = 7e-4

# A specimen whose part of the misfit is less than this many standard errors of the noise's isn't seen.
SURE = 2.0

# The weight moves by the misfit's ratio to its aim to this power, by TWICE at most. Where that is too far, as it is on
# bright stacks, whose misfit hangs on the weight, the weight swings about its place: each time a long move turns back,
# half of it is the most, and where it goes on, AGAIN times it.
GAIN, TWICE, AGAIN = 15.0, 2.0, 1.2

# A misfit that fell by more than this share in the last step is still on its way.
FALLING = 0.03

# Above this times its aim a misfit that no longer falls is held up by the model, or by a noise that was measured too
# low.
HELD_UP = 1.05

# Lag-1 correlation of the residual above which it still shows the specimen; gain by which the weight follows it.
WHITE, CORRELATION_GAIN = 0.005, 15.0

# What the weight was at a step, the misfit and the residual's correlation there, and why it was changed, or not.
WeightRecord = dict[str, Any]


@dataclass(frozen=True)
class FollowsNoise:
    """The common weight of the priors as a descent goes on.

    noise_misfit: what noise alone leaves of the misfit; None where the noise isn't known: then the residual is to be
    white. pixels: how many there are; noise leaves its misfit but for the statistical error that their number allows.
    first: the weight at first; None is chosen by the specimen's contrast.
    """

    noise_misfit: float | None
    pixels: float = math.inf
    first: float | None = None

    @property
    def aim(self) -> float | None:
        """The misfit that is aimed at; that of an empty volume, 1, where the noise may be all that there is."""
        if self.noise_misfit is None:
            return None
        if self.noise_misfit * (1 + SURE * math.sqrt(2 / self.pixels)) >= 1:
            return max(1.0, self.noise_misfit)
        return self.noise_misfit + MODEL * (1 - self.noise_misfit)

    def next(
        self, weight: float, misfit: float, before: float | None, correlation: float, reach: float = math.log(TWICE)
    ) -> tuple[float, str]:
        """The next weight, and the reason.

        misfit: of the current volume. before: the misfit one accepted step earlier; None at first. correlation: of the
        current residual, see `correlation`. reach: how far the weight's logarithm may move, see `reach`.
        """
        aim = self.aim
        falling = before is not None and misfit < (1 - FALLING) * before
        if falling and (aim is None or misfit > aim):
            return weight, "the misfit still falls"
        if aim is None or (misfit > HELD_UP * aim and correlation <= WHITE):
            if aim is not None and correlation >= -WHITE:
                return weight, "the residual is white, though above the noise"
            wanted, reason = -CORRELATION_GAIN * correlation, "towards a white residual"
        else:
            wanted, reason = GAIN * math.log(aim / misfit), "towards the noise"
        return weight * math.exp(min(max(wanted, -reach), reach)), reason


def reach(weights: Sequence[float]) -> float:
    """How far the logarithm of the weight may move, after these weights, the oldest first."""
    longest = math.log(TWICE)
    moves = [math.log(after / before) for before, after in pairwise(weights) if after != before]
    for last, move in pairwise(moves):
        if last * move > 0:
            longest = min(AGAIN * longest, math.log(TWICE))
        elif abs(move) > longest / 2:
            longest /= 2
    return longest


def correlation(images: Float[Tensor, "prism focus y x"], misfit: Misfit) -> float:
    """Correlation of the residual with itself one pixel further, averaged over y and x: 0 for white noise.

    images: the model's. Each image's mean residual is taken out. Pairs of pixels count of which no mask leaves one out.
    """
    residual = misfit.where_counted(images - misfit.data)
    residual = misfit.where_counted(residual - image_means(residual, misfit.mask)) / misfit.variance.sqrt()
    power = float(misfit.mean(residual.square()))
    if power == 0:
        return 0.0
    counted = misfit.where_counted(torch.ones_like(residual))
    products, pairs = (
        torch.stack([(values * values.roll(1, axis)).sum() for axis in (2, 3)]) for values in (residual, counted)
    )
    return float((products / pairs.clamp_min(1)).mean()) / power
