"""The prior's weight: it follows the noise.

The true specimen leaves the noise's misfit (V. A. Morozov's discrepancy principle). A volume that leaves less follows
the noise, and gets more weight; one that leaves more is held back by the prior, and gets less.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit.base import Misfit
from recon.misfit.level import image_means

# Part of what isn't noise that even the best volume leaves: voxels and directions are finite.
MODEL = 7e-4

# The weight moves by the misfit's ratio to its aim to this power, by TWICE at most.
GAIN, TWICE = 15.0, 2.0

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
    white. first: the weight at first; None is chosen by the specimen's contrast.
    """

    noise_misfit: float | None
    first: float | None = None

    @property
    def aim(self) -> float | None:
        """The misfit that is aimed at."""
        return None if self.noise_misfit is None else self.noise_misfit + MODEL * max(0.0, 1 - self.noise_misfit)

    def next(self, weight: float, misfit: float, before: float | None, correlation: float) -> tuple[float, str]:
        """The next weight, and the reason.

        misfit: of the current volume. before: the misfit one accepted step earlier; None at first. correlation: of the
        current residual, see `correlation`.
        """
        aim = self.aim
        falling = before is not None and misfit < (1 - FALLING) * before
        if falling and (aim is None or misfit > aim):
            return weight, "the misfit still falls"
        if aim is None or (misfit > HELD_UP * aim and correlation <= WHITE):
            if aim is not None and correlation >= -WHITE:
                return weight, "the residual is white, though above the noise"
            factor = math.exp(min(max(-CORRELATION_GAIN * correlation, -math.log(TWICE)), math.log(TWICE)))
            return weight * factor, "towards a white residual"
        return weight * min(max((aim / misfit) ** GAIN, 1 / TWICE), TWICE), "towards the noise"


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
