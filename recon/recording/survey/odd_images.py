"""Images of a recording that can hardly be what was recorded: blank, copies of one another, or clipped."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from torchdic.files.format import Stack

# Noise leaves few pixels at the largest value and hardly more than at the next one. Where they are more than these
# parts of all pixels, and of those at the next value, a camera or a program has clipped what was brighter.
_AT_TOP, _OF_NEXT = 0.01, 4

# So many neighbours at the lowest value of an image are blank where the next value is higher by more than this part of
# what the median is, and by more than so many times what the next ones are apart: dark light grades into it.
_NEIGHBOURS, _GAP, _APART = 9, 0.1, 4.0


def odd_images(
    stack: Stack, counted: Bool[np.ndarray, "prism focus y x"] | None = None, prism: str = "prism"
) -> Iterator[str]:
    """A line for what is likely wrong with images of a stack: of counts, no two can be alike by chance.

    counted: the pixels that count (True), None is all; an image without any is left aside. prism: what a setting is
    called. Floats may be of a model without noise: of them only parts that are 0 are told. Nothing is said of a stack
    with a setting that is of one value altogether, which is refused elsewhere.
    """
    if any(images.min() == images.max() for images in stack.data):
        return
    yield from _blank(stack.data, counted, prism)
    if not stack.is_integer:
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


def _blank(data: np.ndarray, counted: Bool[np.ndarray, "prism focus y x"] | None, prism: str) -> Iterator[str]:
    """A line for parts in which nothing is recorded: a program has shifted images, or a part of a file is missing."""
    found = []
    for place in np.ndindex(*data.shape[:2]):
        image = data[place]
        known = np.ones(image.shape, bool) if counted is None else counted[place]
        if not known.any():
            continue
        low, middle = (float(of(image[known])) for of in (np.min, np.median))
        at = known & (image == low)
        if middle == low or at.sum() < _NEIGHBOURS or (low != 0 and data.dtype.kind == "f"):
            continue
        above = image[known & (image > low)]
        if (gap := float(above.min()) - low) <= _GAP * (middle - low):
            continue
        steps = np.diff(np.unique(above)[:5].astype(float))
        parts: Any = ndimage.label(at, np.ones((3, 3)))
        size = int(np.bincount(parts[0][at]).max())
        if size >= _NEIGHBOURS and len(steps) and gap > _APART * float(np.median(steps)):
            found.append((f"{prism} {place[0] + 1}, plane {place[1] + 1}", size, low, low + gap))
    if found:
        name, size, low, following = found[0]
        more = f", and {len(found) - 1} further images have such parts" if len(found) > 1 else ""
        yield (
            f"{name}: {size} neighbouring pixels are {low:g}, and none is between that and {following:g}{more}: "
            "nothing is recorded there, as where a program has shifted images or a part of a file is missing; leave "
            "these pixels out (data.mask)"
        )


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
