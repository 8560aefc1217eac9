"""Which pixels of a recording count: not the saturated ones, the stuck ones, nor those that a user leaves out."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Real, Shaped
from scipy import ndimage

from torchdic.errors import StackError
from torchdic.files.format import Stack

# The largest part of a setting's pixels that may be saturated or stuck: of more nothing could be said by the others.
MOST_SATURATED = 0.5


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The pixels of a stack that a fit leaves out, and why.

    counted: the pixels that count (True); None where all do.
    masked: pixels, in all images together, that the user's mask leaves out. saturated: those of the others that are at
    the camera's full scale. stuck: pixels of the camera that don't follow the light, which count in no image.
    share: of all pixels of all images.
    """

    counted: Bool[np.ndarray, "prism focus y x"] | None = None
    masked: int = 0
    saturated: int = 0
    stuck: int = 0
    share: float = 0.0

    def __str__(self) -> str:
        """All reasons in one line; empty where no pixel is left out."""
        parts = [
            (self.stuck, f"{_pixels(self.stuck, 'stuck')} of the camera"),
            (self.saturated, _pixels(self.saturated, "saturated")),
            (self.masked, f"{_pixels(self.masked, 'masked')} by the user"),
        ]
        named = ", ".join(words for number, words in parts if number)
        return f"left out of the fit: {named} ({self.share:.2%} of the stack)" if named else ""


def _pixels(number: int, kind: str) -> str:
    return f"{number} {kind} pixel{'' if number == 1 else 's'}"


def left_out(
    stack: Stack, mask: Bool[np.ndarray, "..."] | None = None, stuck: Bool[np.ndarray, "y x"] | None = None
) -> LeftOut:
    """The pixels of a stack that a fit leaves out: by a user's mask, because they are saturated, and the stuck ones.

    mask: True where a pixel counts, as of `counted_pixels`. stuck: True where a pixel of the camera is, see
    `recon.recording.stuck_pixels`. Raises StackError as `counted_pixels` does, and where more than half of a prism's
    pixels are saturated or stuck among those that the mask leaves: the others would be explained by nearly any volume.
    """
    counted = counted_pixels(stack, mask, stuck)
    if counted is None:
        return LeftOut()
    wanted = np.ones(counted.shape, bool) if mask is None else np.broadcast_to(mask, counted.shape)
    sound = wanted if stuck is None else wanted & ~stuck
    for prism, (kept, images) in enumerate(zip(wanted, counted, strict=True), start=1):
        lost = int((kept & ~images).sum())
        if lost > MOST_SATURATED * kept.sum():
            raise StackError(
                f"{stack.source}: {lost / kept.sum():.1%} of prism {prism}'s pixels are saturated or stuck: at most "
                f"{MOST_SATURATED:.0%} may be left out so; the others say too little of a volume"
            )
    number = 0 if stuck is None else int(stuck.sum())
    return LeftOut(
        counted,
        masked=int((~wanted).sum()),
        saturated=int((sound & ~counted).sum()),
        stuck=number,
        share=float(1 - counted.mean()),
    )


def counted_pixels(
    stack: Stack, mask: Bool[np.ndarray, "..."] | None = None, stuck: Bool[np.ndarray, "y x"] | None = None
) -> Bool[np.ndarray, "prism focus y x"] | None:
    """The pixels of a stack that count (True); None where all do.

    A pixel at the largest value that the file's bit depth can hold is saturated: its intensity is unknown.
    mask: the user's, True where a pixel counts, broadcastable to (prism, focus, y, x); None is all.
    stuck: True where a pixel of the camera is; None is none.
    Raises StackError where the mask doesn't fit the stack, or where no pixel of a prism counts.
    """
    counted = np.ones(stack.data.shape, bool) if stack.saturation is None else stack.data < stack.saturation
    if mask is not None:
        try:
            counted = counted & np.broadcast_to(mask, counted.shape)
        except ValueError as error:
            raise StackError(f"{stack.source}: the mask has shape {mask.shape}, the data {counted.shape}") from error
    if stuck is not None:
        counted = counted & ~stuck
    for prism, images in enumerate(counted):
        if not images.any():
            raise StackError(f"{stack.source}: no pixel of prism {prism + 1} counts: all are saturated or masked")
    return None if counted.all() else counted


def median_of_known(images: Real[np.ndarray, "focus y x"]) -> Float[np.ndarray, "y x"]:
    """Each pixel's median over the planes in which it isn't NaN, float64; NaN where it is in all."""
    known = np.isfinite(images)
    if known.all():
        return np.median(images, axis=0).astype(np.float64)
    anything = known.any(0)
    return np.where(anything, np.nanmedian(np.where(anything, images, 0), axis=0), np.nan)


def nearest_counted(image: Shaped[np.ndarray, "y x"], counted: Bool[np.ndarray, "y x"]) -> Shaped[np.ndarray, "y x"]:
    """An image with the nearest pixel that counts in place of each that doesn't; as it is where none counts.

    No misfit reads such values: they serve what reads whole images, such as pictures and the start of a descent.
    """
    if counted.all() or not counted.any():
        return image
    nearest = ndimage.distance_transform_edt(~counted, return_distances=False, return_indices=True)
    assert nearest is not None
    return image[tuple(nearest)]
