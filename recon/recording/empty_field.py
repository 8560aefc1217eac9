"""An image of the empty field, by which a stack is divided: lamp, optics and camera without the specimen."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy import ndimage

from recon.recording.background import noise_level
from recon.recording.masks import nearest_counted
from recon.recording.stuck_pixels import stuck_pixels
from torchdic.errors import StackError
from torchdic.files.format import Stack

# A pixel below this part of the field's level is dark: dead, or behind a stop.
_DARK = 0.1

# Where a larger part of the pixels is dark, hot or saturated, it is no image of an empty field.
_MOST_BAD = 0.5

# The field's noise shouldn't exceed this part of that of an image of the stack: it is the same in all planes, so that
# the fit doesn't average over it.
_QUIET = 0.2

# The field is smoothed until it is so quiet, by a Gaussian of these standard deviations in pixels: the narrowest that
# smooths at all, and the widest. Beyond that dust in the light's way would be lost, and the noise is counted instead.
_NARROWEST, _WIDEST = 0.6, 4.0


@dataclass(frozen=True)
class EmptyField:
    """The empty field of each prism.

    images: (prism, y, x), mean of its frames, without dark counts; bad pixels have the value of the nearest good one.
    noise: standard deviation of the noise of each.
    pattern: share of each one's variance from pixel to pixel that all of its frames have, as that of unequal pixels; 0
        for one frame, which can't tell it from noise.
    bad: pixels (y, x) of the camera by which nothing can be divided: dark, hot, stuck or saturated; None is none.
    source: the file, for messages.
    """

    images: Float[np.ndarray, "prism y x"]
    noise: tuple[float, ...]
    pattern: tuple[float, ...]
    bad: Bool[np.ndarray, "y x"] | None
    source: str

    def quiet(self, prism: int, noise: float | None) -> tuple[Float[np.ndarray, "y x"], float]:
        """A prism's empty field, smoothed as far as its noise asks for, and the noise that is left.

        noise: standard deviation of the noise of an image of the stack over its level; None smooths nothing.
        """
        image, own = self.images[prism], self.noise[prism]
        if noise is None or own == 0:
            return image, own
        wanted = _QUIET * noise * abs(float(np.median(image)))
        if own <= wanted:
            return image, own
        # a Gaussian of s pixels leaves 1/(2√π s) of white noise
        width = _WIDEST if wanted == 0 else min(max(own / (wanted * 2 * math.sqrt(math.pi)), _NARROWEST), _WIDEST)
        impulse = np.zeros(2 * math.ceil(4 * width) + 1)
        impulse[len(impulse) // 2] = 1
        left, kept = float((ndimage.gaussian_filter(impulse, width) ** 2).sum()), self.pattern[prism]
        smooth = ndimage.gaussian_filter(image, width, mode="nearest")
        # Wiener's filter: of what was smoothed away, the share that isn't noise is put back
        return smooth + kept * (image - smooth), own * (left + kept * (1 - left))


def empty_field(stack: Stack, of: Stack, offset: float = 0.0, ratio: float | None = None) -> EmptyField:
    """The empty field in a file, for the images of a stack.

    stack: of the file: one image for all prisms, one for each, or frames of these, as a stack has planes; frames are
        averaged. As many images without channels as there are prisms are one for each.
    of: the stack that will be divided. offset: counts that the camera gives in the dark.
    ratio: how far a pixel may stand out of its neighbours, as for `stuck_pixels`; None looks for no hot pixels.
    Raises StackError where the file has other pixels than the stack or images for another number of prisms, where it
    is dark, or where half of it is dark, hot or saturated.
    """
    frames = _frames(stack, of)
    bad = np.zeros(frames.shape[2:], bool)
    if ratio is not None:
        bad |= stuck_pixels(frames, ratio)
    if stack.saturation is not None:
        bad |= (frames >= stack.saturation).any((0, 1))
    images = frames.mean(1, dtype=np.float64) - offset
    for prism, image in enumerate(images):
        level = float(np.median(image))
        if level <= 0:
            raise StackError(
                f"{stack.source}: the empty field of prism {prism + 1} minus the offset {offset:g} is {level:.4g}: "
                "it must be above 0, in the unit of the stack"
            )
        bad |= image < _DARK * level
    if bad.mean() > _MOST_BAD:
        raise StackError(
            f"{stack.source}: {bad.mean():.0%} of the empty field are dark, hot or saturated: there is no light to "
            "divide by"
        )
    sound = np.stack([nearest_counted(image, ~bad) for image in images])
    noise = tuple(map(_noise_of_mean, frames))
    pattern = tuple(_pattern(image, own) for image, own in zip(sound, noise, strict=True))
    return EmptyField(sound, noise, pattern, bad if bad.any() else None, stack.source)


def _frames(stack: Stack, of: Stack) -> Real[np.ndarray, "prism frame y x"]:
    """The frames of each prism of the stack `of`."""
    frames, prisms = stack.data, len(of.data)
    if frames.shape[2:] != of.data.shape[2:]:
        ours, theirs = (f"{ny} × {nx}" for ny, nx in (frames.shape[2:], of.data.shape[2:]))
        raise StackError(f"{stack.source} has {ours} pixels (y × x), {of.source} {theirs}: an empty field has the same")
    channels, planes = frames.shape[:2]
    if channels == prisms:
        return frames
    if channels > 1:
        raise StackError(f"{stack.source} has {channels} channels: an empty field has one, or one for each of {prisms}")
    if planes == prisms:
        return frames.swapaxes(0, 1)
    return np.broadcast_to(frames, (prisms, *frames.shape[1:]))


def _noise_of_mean(frames: Real[np.ndarray, "frame y x"]) -> float:
    """The noise of the mean of frames, from what differs between them; of one frame as of any image."""
    if len(frames) == 1:
        return noise_level(frames) or 0.0
    between = noise_level(np.diff(frames.astype(np.float64), axis=0)) or 0.0
    return between / math.sqrt(2 * len(frames))


def _pattern(image: Float[np.ndarray, "y x"], noise: float) -> float:
    """The share of an image's variance from pixel to pixel that isn't noise."""
    all_of_it = noise_level(image) or 0.0
    return max(0.0, 1 - (noise / all_of_it) ** 2) if all_of_it > 0 else 0.0
