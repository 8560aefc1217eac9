"""The images of a folder as the page shows them: measured, modelled and what is left, by plane and prism setting."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from recon.report.figures import OUTSIDE
from recon.report.html.folder import Folder, list_in
from recon.report.html.packed import Thinning, in_levels, packed
from recon.report.html.words import prism_words, short

# Pixels of all images on a page together, at most; and pixels of an image below which planes are left out instead.
MOST_PIXELS, LEAST_PIXELS = 4_000_000, 160 * 160

PAIRS, STACK = "images.ome.tif", "stack.ome.tif"


@dataclass(frozen=True, eq=False)
class Images:
    """The images of a folder.

    shown: as the page's script takes them. residual: measured less modelled images (prism, focus, y, x), None where
    there are no models. pixel: its size (y, x) in µm, None where the file has none. shape: (prism, focus, y, x) in the
    file. prisms: in words. thinned: what is left out for viewing, in words; empty for nothing.
    """

    shown: dict[str, Any]
    residual: Float[np.ndarray, "prism focus y x"] | None
    pixel: tuple[float, float] | None
    shape: tuple[int, int, int, int]
    prisms: tuple[str, ...]
    thinned: str


def images_of(folder: Folder, acquisition: dict[str, Any]) -> Images | None:
    """The images that a folder holds; None where there are none. acquisition: that of its configuration."""
    stack = folder.stack(PAIRS)
    if stack is not None and len(stack.data) % 2 == 0:
        pairs = stack.data.astype(np.float32, copy=False)
        measured, modelled = pairs[0::2], pairs[1::2]
        kinds = {"measured": measured, "modelled": modelled}
        residual = measured - modelled
    elif (stack := folder.stack(STACK)) is not None:
        kinds, residual = {"simulated": stack.data.astype(np.float32, copy=False)}, None
    else:
        return None
    pixel = stack.pixel_size
    first = next(iter(kinds.values()))
    prisms, planes = first.shape[:2]
    everything = len(kinds) + (residual is not None)
    step, thinning = _thinned(first.shape, pixel or (1.0, 1.0), everything)
    named = tuple(_names(acquisition, prisms))
    shown: dict[str, Any] = {
        "prisms": list(named),
        "planes": [_plane(acquisition, stack.focus_step, number, planes) for number in range(0, planes, step)],
        "size": [len(thinning.places(axis, n, 1.0)) for axis, n in enumerate(first.shape[2:])],
        "aspect": first.shape[3] * (pixel or (1, 1))[1] / (first.shape[2] * (pixel or (1, 1))[0]),
        "width": None if pixel is None else first.shape[3] * pixel[1],
        "kinds": list(_greys(kinds, step, thinning)),
    }
    if residual is not None:
        shown["kinds"].append(_residual(residual, step, thinning))
        shown["rms"] = [[float(f"{np.sqrt(np.mean(i**2)):.4g}") for i in prism[::step]] for prism in residual]
    return Images(shown, residual, pixel, (prisms, planes, *first.shape[2:]), named, _words(step, thinning))


def _greys(kinds: dict[str, np.ndarray], step: int, thinning: Thinning) -> Iterator[dict[str, Any]]:
    """What was measured and what was modelled, on one scale of grey for each prism."""
    first = next(iter(kinds.values()))
    limits = [np.quantile(prism, (OUTSIDE, 1 - OUTSIDE)).tolist() for prism in first]
    for name, stack in kinds.items():
        thin = (thinning.of(prism[::step].copy()) for prism in stack)
        levels = [in_levels(prism, *scale) for prism, scale in zip(thin, limits, strict=True)]
        yield {"name": name, "colours": "gray", "limits": limits, "values": packed(np.stack(levels))}


def _residual(residual: np.ndarray, step: int, thinning: Thinning) -> dict[str, Any]:
    """What the model leaves, on one scale for all images, in which no difference is the middle."""
    largest = max(float(np.quantile(np.abs(prism), 1 - OUTSIDE)) for prism in residual) or 1.0
    levels = [in_levels(thinning.of(prism[::step].copy()), -largest, largest) for prism in residual]
    limits = [[-largest, largest]] * len(residual)
    return {"name": "residual", "colours": "RdBu_r", "limits": limits, "values": packed(np.stack(levels))}


def _thinned(shape: Sequence[int], pixel: Sequence[float], kinds: int) -> tuple[int, Thinning]:
    """Which planes are shown, each step-th, and how their pixels are thinned."""
    prisms, planes, height, width = shape
    most = max(1, MOST_PIXELS // (kinds * prisms * min(LEAST_PIXELS, height * width)))
    step = -(-planes // most)
    each = MOST_PIXELS // (kinds * prisms * -(-planes // step))
    return step, Thinning.within(max(1, each), (height, width), pixel)


def _words(step: int, thinning: Thinning) -> str:
    parts = []
    if step > 1:
        parts.append(f"every {step}th plane" if step > 3 else f"every {('second', 'third')[step - 2]} plane")
    if thinning.is_any:
        parts.append(f"means of {thinning.words} pixels")
    return f"For viewing, the images are thinned to {' and '.join(parts)}; the file has them all." if parts else ""


def _names(acquisition: dict[str, Any], number: int) -> Iterator[str]:
    """Each prism setting in words, where the configuration describes as many."""
    prisms = list_in(acquisition, "prisms")
    known = prisms if len(prisms) == number else [""] * number
    for count, prism in enumerate(known, 1):
        words = prism_words(prism)
        yield f"{count} of {number}{f': {words}' if words else ''}"


def _plane(acquisition: dict[str, Any], step: float | None, number: int, planes: int) -> str:
    """A focus plane in words: where it is, else how far from the first."""
    focus, place = list_in(acquisition, "focus"), f"{number + 1} of {planes}"
    if len(focus) == planes:
        return f"{place}: focus {short(focus[number])} µm"
    return f"{place}: {short(number * step)} µm from the first" if step else place
