"""Stacks of which `torchdic new` writes no configuration, because their images can't be compared with a model's."""

from dataclasses import replace

import numpy as np

from recon.config.schema import ConfigError
from recon.recording.masks import MOST_SATURATED
from recon.recording.survey.survey import Survey
from torchdic.errors import StackError
from torchdic.files.format import Stack

# A background is about 0 where it is below this many standard deviations of the noise.
_ABOUT = 2.0

# A pixel is surely below 0 by this many of them; of light alone no pixel is, save for a part of them this small.
_SURELY, _FEW = 6.0, 2e-3


def check_recorded(stack: Stack) -> None:
    """Raise StackError where a setting's images show nothing: of one value, or more than half saturated."""
    for number, images in enumerate(stack.data):
        low, limit = float(images.min()), stack.saturation
        if low == images.max():
            raise StackError(
                f"{stack.source}: all pixels of setting {number + 1} are {low:g}: nothing is recorded in them"
            )
        share = 0.0 if limit is None else float((images >= limit).mean())
        if share > MOST_SATURATED:
            raise StackError(
                f"{stack.source}: {share:.1%} of setting {number + 1}'s pixels are saturated, at {limit:g}: their "
                f"intensity is unknown, and at most {MOST_SATURATED:.0%} may be; record it with less light"
            )


def put_back(stack: Stack, offset: float | None) -> Stack:
    """The stack with what was subtracted from it put back, where an offset below 0 says how much.

    Raises ConfigError for one of counts that can't be below 0.
    """
    if offset is None or offset >= 0:
        return stack
    if stack.data.dtype.kind == "u":
        raise ConfigError(f"--offset {offset:g} must be at least 0: {stack.source} has no counts below 0")
    full = stack.saturation
    data = (stack.data - np.float64(offset)).astype(np.float32)
    return replace(stack, data=data, full_scale=None if full is None else full - offset)


def check_background(stack: Stack, found: Survey, offset: float | None) -> None:
    """Raise StackError where a background isn't light above the dark counts, as where it has been subtracted.

    stack: with what was subtracted put back. offset: counts in the dark as given; None is 0.
    """
    dark = max(offset or 0.0, 0.0)
    noises = [setting.noise or 0.0 for setting in found.settings]
    above = [setting.level - dark for setting in found.settings]
    brightest = int(np.argmax(above))
    if dark:
        wrong = next((n for n, noise in enumerate(noises) if above[n] < -_ABOUT * noise), None)
        wrong = brightest if wrong is None and above[brightest] <= _ABOUT * noises[brightest] else wrong
        if wrong is not None:
            raise StackError(
                f"{stack.source}: --offset {dark:g} must be below the images' background, which is "
                f"{found.settings[wrong].level:.4g} in setting {wrong + 1}: the counts of a dark image are fewer"
            )
        return
    sound = ~found.dead
    for number, (level, noise) in enumerate(zip(above, noises, strict=True)):
        below = float((stack.data[number][:, sound] < -_SURELY * noise).mean()) if sound.any() else 0.0
        if level < -_ABOUT * noise or below > _FEW or above[brightest] <= _ABOUT * noises[brightest]:
            raise StackError(
                f"{stack.source}: setting {number + 1}'s background is {level:.3g} (noise {noise:.2g}), with "
                f"{(stack.data[number] < 0).mean():.0%} of its pixels below 0: the background has been subtracted; "
                f"the model needs the raw counts{_or_an_offset(stack, offset)}"
            )


def _or_an_offset(stack: Stack, offset: float | None) -> str:
    if stack.data.dtype.kind == "u":
        return ""
    if offset is not None and offset < 0:
        return f", or more put back than --offset {offset:g} does"
    return ", or what was subtracted put back, such as 580 by --offset -580"
