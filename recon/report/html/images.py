"""The images of a folder as the page shows them: measured, modelled and what is left, by plane and prism setting."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from recon.report.figures import OUTSIDE
from recon.report.html.folder import Folder, list_in
from recon.report.html.packed import Thinning, in_levels, packed
from recon.report.html.plots import Spectrum, spectrum
from recon.report.html.words import prism_words, short
from torchdic.files.format import Stack

# Pixels of all images on a page together, at most; and pixels of an image below which planes are left out instead.
MOST_PIXELS, LEAST_PIXELS = 4_000_000, 160 * 160

# Pixels along a side of images that are too small for a spectrum.
SMALLEST = 8

PAIRS, STACK = "images.ome.tif", "stack.ome.tif"


@dataclass(frozen=True, eq=False)
class Images:
    """The images of a folder.

    shown: as the page's script takes them. shape: (prism, focus, y, x) in the file. prisms: in words. thinned: what is
    left out for viewing, in words; empty for nothing. has_models: whether there are modelled images, and residuals.
    spectra: of each prism's residual, as of `spectrum`; empty where there are none, or pixels of unknown size.
    """

    shown: dict[str, Any]
    shape: tuple[int, int, int, int]
    prisms: tuple[str, ...]
    thinned: str
    has_models: bool
    spectra: tuple[Spectrum, ...]


def images_of(folder: Folder, acquisition: dict[str, Any]) -> Images | None:
    """The images that a folder holds; None where there are none. acquisition: that of its configuration."""
    found = _read(folder)
    if found is None:
        return None
    stack, kinds = found
    has_models = len(kinds) == 2
    prisms, planes, height, width = shape = next(iter(kinds.values())).shape
    pixel = stack.pixel_size or (1.0, 1.0)
    step, thinning = _thinned(shape, pixel, len(kinds) + has_models)
    named = tuple(_names(acquisition, prisms))
    shown: dict[str, Any] = {
        "prisms": list(named),
        "planes": [_plane(acquisition, stack.focus_step, number, planes) for number in range(0, planes, step)],
        "size": [len(thinning.places(axis, n, 1.0)) for axis, n in enumerate((height, width))],
        "aspect": width * pixel[1] / (height * pixel[0]),
        "width": None if stack.pixel_size is None else width * pixel[1],
        "kinds": list(_greys(kinds, step, thinning)),
    }
    spectra: tuple[Spectrum, ...] = ()
    if has_models:
        shown["kinds"].append(_residual(kinds, step, thinning))
        shown["rms"] = [[_rms(image) for image in prism[::step]] for prism in _residuals(**kinds)]
        if stack.pixel_size is not None and min(height, width) >= SMALLEST:
            spectra = tuple(spectrum(prism, pixel) for prism in _residuals(**kinds))
    return Images(shown, shape, named, _words(step, thinning), has_models, spectra)


def _read(folder: Folder) -> tuple[Stack, dict[str, np.ndarray]] | None:
    """The stack that a folder holds, and its images by what they are: measured and modelled, or simulated."""
    if (stack := folder.stack(PAIRS)) is not None:
        if len(stack.data) % 2 == 0:
            return stack, {"measured": stack.data[0::2], "modelled": stack.data[1::2]}
        folder.damaged.append(f"{PAIRS}: holds {len(stack.data)} channels, no measured and modelled ones in turn")
    if (stack := folder.stack(STACK)) is not None:
        return stack, {"simulated": stack.data}
    return None


def _greys(kinds: dict[str, np.ndarray], step: int, thinning: Thinning) -> Iterator[dict[str, Any]]:
    """What was measured and what was modelled, on one scale of grey for each prism."""
    first = next(iter(kinds.values()))
    limits = [np.quantile(prism, (OUTSIDE, 1 - OUTSIDE)).tolist() for prism in first]
    for name, stack in kinds.items():
        thin = (thinning.of(prism[::step].astype(np.float32, copy=False)) for prism in stack)
        levels = [in_levels(prism, *scale) for prism, scale in zip(thin, limits, strict=True)]
        yield {"name": name, "colours": "gray", "limits": limits, "values": packed(np.stack(levels))}


def _residuals(measured: np.ndarray, modelled: np.ndarray) -> Iterator[Float[np.ndarray, "focus y x"]]:
    """Measured less modelled images, prism by prism."""
    for one, other in zip(measured, modelled, strict=True):
        yield (one - other).astype(np.float32, copy=False)


def _residual(kinds: dict[str, np.ndarray], step: int, thinning: Thinning) -> dict[str, Any]:
    """What the model leaves, on one scale for all images, in which no difference is the middle."""
    largest = max(float(np.quantile(np.abs(one), 1 - OUTSIDE)) for one in _residuals(**kinds)) or 1.0
    levels = [in_levels(thinning.of(one[::step]), -largest, largest) for one in _residuals(**kinds)]
    limits = [[-largest, largest]] * len(levels)
    return {"name": "residual", "colours": "RdBu_r", "limits": limits, "values": packed(np.stack(levels))}


def _rms(image: np.ndarray) -> float:
    return float(f"{np.sqrt(np.mean(image**2)):.4g}")


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
