"""Images of a recording that can hardly be what was recorded: of one value, or copies of one another."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool

from torchdic.files.format import Stack


def odd_images(
    stack: Stack, counted: Bool[np.ndarray, "prism focus y x"] | None = None, prism: str = "prism"
) -> Iterator[str]:
    """A line for what is likely wrong with whole images of a stack of counts, of which no two can be alike by chance.

    counted: the pixels that count (True), None is all; an image without any is left aside. prism: what a setting is
    called. Floats may be of a model without noise: of them nothing is said.
    """
    if stack.data.dtype.kind not in "iu":
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
