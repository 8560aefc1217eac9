"""Which pixels of a recording count: not the saturated ones, nor those that a user leaves out."""

import numpy as np
from jaxtyping import Bool

from torchdic.errors import StackError
from torchdic.files.format import Stack


def counted_pixels(
    stack: Stack, mask: Bool[np.ndarray, "..."] | None = None
) -> Bool[np.ndarray, "prism focus y x"] | None:
    """The pixels of a stack that count (True); None where all do.

    A pixel at the largest value that the file's bit depth can hold is saturated: its intensity is unknown.
    mask: the user's, True where a pixel counts, broadcastable to (prism, focus, y, x); None is all.
    Raises StackError where the mask doesn't fit the stack, or where no pixel of a prism counts.
    """
    counted = np.ones(stack.data.shape, bool) if stack.saturation is None else stack.data < stack.saturation
    if mask is not None:
        try:
            counted = counted & np.broadcast_to(mask, counted.shape)
        except ValueError as error:
            raise StackError(f"{stack.source}: the mask has shape {mask.shape}, the data {counted.shape}") from error
    for prism, images in enumerate(counted):
        if not images.any():
            raise StackError(f"{stack.source}: no pixel of prism {prism} counts: all are saturated or masked")
    return None if counted.all() else counted
