"""Images of a recording that can hardly be what was recorded: of one value, copies of one another, or clipped."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool

from torchdic.files.format import Stack

# Noise leaves few pixels at the largest value and hardly more than at the next one. Where they are more than these
# parts of all pixels, and of those at the next value, a camera or a program has clipped what was brighter.
_AT_TOP, _OF_NEXT = 0.01, 4


def odd_images(
    stack: Stack, counted: Bool[np.ndarray, "prism focus y x"] | None = None, prism: str = "prism"
) -> Iterator[str]:
    """A line for what is likely wrong with whole images of a stack of counts, of which no two can be alike by chance.

    counted: the pixels that count (True), None is all; an image without any is left aside. prism: what a setting is
    called. Floats may be of a model without noise: of them nothing is said. Nor is it of a stack with a setting that is
    of one value altogether, which is refused elsewhere.
    """
    if stack.data.dtype.kind not in "iu" or any(images.min() == images.max() for images in stack.data):
        return
    alike: dict[bytes, list[str]] = defaultdict(list)
    for place in np.ndindex(*stack.data.shape[:2]):
        image, name = stack.data[place], f"{prism} {place[0] + 1}, plane {place[1] + 1}"
        known = image if counted is None else image[counted[place]]
        if known.size and known.min() == known.max():
            yield (
                f"{name}: all its pixels are {known.flat[0]:g}, nothing is recorded in it: record it again, leave the "
                "plane out, or mask it (data.mask)"
            )
        elif known.size:
            alike[hashlib.sha256(image.tobytes()).digest()].append(name)
    copies = [names for names in alike.values() if len(names) > 1]
    if copies:
        more = f", and {len(copies) - 1} further images have copies" if len(copies) > 1 else ""
        yield (
            f"{copies[0][0]} and {copies[0][1]} are the same image, pixel by pixel{more}: likely a file or a plane was "
            "taken twice in place of another"
        )
    yield from _clipped(stack.data if counted is None else stack.data[counted], stack.saturation)


def _clipped(data: np.ndarray, saturation: float | None) -> Iterator[str]:
    """A line where pixels are clipped below the camera's full scale, so that they aren't taken as saturated."""
    top = data.max()
    share, below = float((data == top).mean()), data[data < top]
    if top == saturation or share <= _AT_TOP or not below.size:
        return
    if share > _OF_NEXT * float((data == below.max()).mean()):
        yield (
            f"{share:.1%} of the pixels have the largest value, {top:g}, and hardly any the next, {below.max():g}: "
            "what was brighter has been clipped, by the camera or by a program; take the counts from before, or leave "
            "these pixels out (data.mask)"
        )
