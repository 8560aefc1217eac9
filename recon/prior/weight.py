"""The prior's weight: it follows the noise.

The true specimen leaves the noise's misfit (V. A. Morozov's discrepancy principle). A volume that leaves less follows
the noise, and gets more weight; one that leaves more is held back by the prior, and gets less. Where less weight
doesn't help, it is the model that errs, and the weight stays.

A per cent of the noise's variance changes the weight by a third, and before the fit no noise is known as well as that.
The residual tells it: what the specimen scatters lies at low frequencies, noise is as strong at high ones. Where the
residual's high frequencies are as strong as all, it is white, and no more of the specimen is left in it.
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

# The weight at first times the specimen's contrast.
BEGUN = 2.0

# Part of what isn't noise that even the best volume leaves: voxels and directions are finite.
MODEL = 5e-4

# A specimen whose part of the misfit is less than this many standard errors of the noise's isn't seen.
SURE = 2.0

# The weight moves by the misfit's ratio to its aim to this power, by TWICE at most. Where that is too far, as it is on
# bright stacks, whose misfit hangs on the weight, the weight swings about its place: each time a long move turns back,
# half of it is the most, and where it goes on, AGAIN times it.
GAIN, TWICE, AGAIN = 15.0, 2.0, 1.2

# A misfit that fell by more than this share in the last step is still on its way.
FALLING = 0.03

# Where the misfit is more than BEYOND times its aim, and the last lower weight has LEFT more than this share of what
# lies above the aim, not the priors hold the misfit up but the model: other optics, or light that it can't follow.
# Above SEEN the priors may still hide the specimen altogether.
BEYOND, LEFT, SEEN = 1.2, 0.75, 0.25

# Each move leaves this part of the way to a weight that is known from elsewhere, in logarithms. The way shows in the
# volume: with the last weight at once it is another one than that of a fit whose weight was lower at first.
FARTHER = 0.7

# Frequencies above this many cycles per pixel, along y or x, are high.
HIGH = 0.35

# The residual's noise is believed within these factors of the noise that was measured in the images: below lies what is
# smooth from pixel to pixel, above what the model can't show.
LEAST, MOST = 0.985, 1.2

# Weight times the width of an edge that is usual. The noise of finite images is known to within its standard error.
# Within UNSURE of these, where weights a factor of FAR apart lead to all but the same misfit, the usual weight is
# preferred.
USUAL, UNSURE, FAR = 1.0, 1.0, math.e

# What the weight was from a step on, the misfit and the residual's whiteness there, and why it was changed, or not.
WeightRecord = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Inside:
    """The part of the images by which a weight goes. misfit: of that part. rows, columns: its pixels."""

    misfit: Misfit
    rows: slice
    columns: slice

    def of(self, images: Float[Tensor, "prism focus y x"]) -> Float[Tensor, "prism focus row column"]:
        """The part of images."""
        return images[..., self.rows, self.columns]


@dataclass(frozen=True)
class FollowsNoise:
    """The common weight of the priors as a descent goes on.

    noise_misfit: what noise alone leaves of the misfit, as it was measured in the images; None where it wasn't: then
    the residual alone tells it. pixels: of all images, that count. first: the weight at first; None is chosen by the
    specimen's contrast. held: whether the weight stays as it is, as where other images are fitted in the same way.
    inside: the part of the images that misfit and pixels are of, where the others show what the volume can't explain;
    None is all. towards: a weight known from elsewhere, to which this one goes whatever the noise; None is none.
    """

    noise_misfit: float | None
    pixels: int
    first: float | None = None
    held: bool = False
    inside: Inside | None = None
    towards: float | None = None

    def heeded(self, images: Float[Tensor, "prism focus y x"], value: float) -> float:
        """The misfit by which the weight goes. images: the model's. value: of the misfit of them all."""
        return value if self.inside is None else float(self.inside.misfit(self.inside.of(images)))

    def white(self, images: Float[Tensor, "prism focus y x"], misfit: Misfit) -> float:
        """The whiteness of the residual by which the weight goes. images: the model's. misfit: of them all."""
        part = self.inside
        return whiteness(images, misfit) if part is None else whiteness(part.of(images), part.misfit)

    def aim(self, misfit: float, white: float, usual: float) -> float:
        """The misfit that is aimed at.

        misfit, white: of the current volume, see `whiteness`. usual: the weight over the usual one.
        """
        noise = misfit * white
        if self.noise_misfit is not None:
            noise = min(max(noise, LEAST * self.noise_misfit), MOST * self.noise_misfit)
        error = math.sqrt(2 / self.pixels)
        if noise * (1 + SURE * error) >= 1:  # an empty volume explains the images
            return max(1.0, noise)
        unsure = UNSURE * error * min(max(math.log(usual) / math.log(FAR), -1.0), 1.0)
        return noise * (1 - unsure) + MODEL * max(0.0, 1 - noise)

    def next(
        self, past: Sequence[WeightRecord], misfit: float, before: float | None, white: float, width: float
    ) -> tuple[float, str]:
        """The next weight, and the reason.

        past: records of the weights so far, the oldest first. misfit: of the current volume. before: the misfit one
        accepted step earlier; None at first. white: `whiteness` of the current residual. width: of an edge, in Δn.
        """
        weights = [record["tv"] for record in past]
        weight = weights[-1]
        if self.held:
            return weight, "held"
        if self.towards is not None:
            return self.towards * (weight / self.towards) ** FARTHER, "on its way to one that is known"
        aim = self.aim(misfit, white, weight * width / USUAL)
        if before is not None and misfit < (1 - FALLING) * before and misfit > aim:
            return weight, "the misfit still falls"
        if BEYOND * aim < misfit < SEEN and (held := _in_vain(past, misfit, aim)) is not None:
            return held, "the model holds the misfit up"
        longest = reach(weights)
        factor = math.exp(min(max(GAIN * math.log(aim / misfit), -longest), longest))
        return weight * factor, "the volume follows the noise" if factor > 1 else "the priors hold the volume back"


def _in_vain(past: Sequence[WeightRecord], misfit: float, aim: float) -> float | None:
    """The weight before the last lower one, where that has hardly brought the misfit nearer to its aim."""
    for earlier, later in reversed(list(pairwise(past))):
        if later["tv"] < earlier["tv"]:
            return earlier["tv"] if misfit - aim > LEFT * (later["misfit"] - aim) else None
    return None


def record(
    step: int, weight: float | None, reason: str, misfit: float = math.nan, white: float = math.nan
) -> WeightRecord:
    """A record of the weight as plain values, for checkpoints and metrics. step: counted from 1."""
    return {"step": step, "tv": weight, "misfit": misfit, "white": white, "reason": reason}


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


def whiteness(images: Float[Tensor, "prism focus y x"], misfit: Misfit) -> float:
    """Power of the residual's high frequencies over that of all, per frequency: 1 for noise that is white.

    images: the model's. Each image's mean residual is taken out; masked pixels count as 0. 1 for images that are too
    small to have high frequencies.
    """
    residual = misfit.where_counted(images - misfit.data)
    residual = (residual - residual.mean((2, 3), keepdim=True)) / misfit.variance.sqrt()
    y, x = (torch.fft.fftfreq(n, device=residual.device).abs() for n in residual.shape[2:])
    high = torch.maximum(y[:, None], x) > HIGH
    power = torch.fft.fft2(residual).abs().square().mean((0, 1))
    overall = float(power.mean())
    return float(power[high].mean()) / overall if bool(high.any()) and overall > 0 else 1.0
