"""A camera's dead, hot and stuck pixels, found in a stack: they stand out in the same way in all of its images."""

import math

import numpy as np
from jaxtyping import Bool, Float, Real
from scipy import integrate, ndimage, special

from recon.recording.background import noise_level
from recon.recording.masks import median_of_known, nearest_counted
from torchdic import Microscope

# The neighbours of a pixel: the square of 5 × 5 around it, without itself.
_RING = np.ones((5, 5), bool)
_RING[2, 2] = False

# Of how many standard deviations of an image's noise a pixel stands out in the mean of all, and in each image.
_SURE, _SEEN = 6.0, 4.0

# Share of the images in which it does.
_NEARLY_ALL = 0.9

# A pixel's neighbours are judged by the one that deviates third most: two more stuck pixels among them change nothing,
# and a spot that the objective resolves lights four.
_THIRD = 3

# How much further than a spot that the objective resolves a pixel stands out of its neighbours, and the least and the
# greatest ratio of both: of pixels that are finer than the light, and of those so coarse that a spot lights one alone.
_FURTHER, _LEAST, _MOST = 2.0, 4.0, 20.0

# A pixel of more λ/NA holds the whole spot: of 1 λ/NA already the ratio is the greatest.
_WIDE = 4.0

# Rounds in which the pixels found are taken out and others are looked for beside them.
_ROUNDS = 3


def sharpest(microscope: Microscope, pixel_size: tuple[float, float], background: float) -> float:
    """How far a pixel of a specimen's image may stand out of its neighbours, relative to these.

    pixel_size: (y, x) in µm. background: refractive index of the medium.

    No detail is sharper than the objective's pass-band permits, 2·NA/λ: the smallest spot is the Airy pattern
    (2J₁(v)/v)², v = 2π·NA·r/λ. A spot in the middle of a pixel lights that and, by a smaller share, the next ones. The
    ratio is twice the inverse of this share, at least 4 and at most 20. Without an objective it is 20.
    """
    if microscope.objective is None:
        return _MOST
    width = max(pixel_size)
    scale = 2 * math.pi * microscope.objective.reach(background) / microscope.wavelength
    if scale * width > 2 * math.pi * _WIDE:
        return _MOST

    def light(centre: float) -> float:
        def airy(x: float, y: float) -> float:
            v = scale * math.hypot(x, y)
            return (2 * special.j1(v) / v) ** 2 if v > 0 else 1.0

        low, high = centre - width / 2, centre + width / 2
        return float(integrate.dblquad(airy, -width / 2, width / 2, low, high, epsrel=1e-3)[0])

    share = light(width) / light(0.0)
    return min(max(_FURTHER / share, _LEAST), _MOST)


def stuck_pixels(
    images: Real[np.ndarray, "prism focus y x"],
    ratio: float,
    counted: Bool[np.ndarray, "prism focus y x"] | None = None,
) -> Bool[np.ndarray, "y x"]:
    """The pixels of a camera that don't follow the light (True): dead, hot, or stuck at a value.

    images: as recorded, not flattened. ratio: how far a specimen's pixel may stand out of its neighbours, see
    `sharpest`. counted: the pixels (True) of which the images say anything; None is all.

    A pixel is stuck where the mean over the prisms of the median over the planes differs from the median of its 24
    neighbours by 6 standard deviations of an image's noise, and by `ratio` times what the third most deviating of them
    does; and where at least 9 in 10 images differ to the same side by 4. A specimen's detail is spread over several
    pixels, goes out of focus, and is dark with one bias or shear where it is bright with another. Where the images
    have no noise, rounding takes its place. Images of less than 5 × 5 pixels have no stuck pixels.
    """
    found = np.zeros(images.shape[2:], bool)
    if min(found.shape) < len(_RING):
        return found
    known = images if counted is None else np.where(counted, images, np.nan)
    noise = np.array([noise_level(prism) or 0.0 for prism in known])
    typical = np.mean([median_of_known(prism) for prism in known], axis=0)
    rounding = 1e-5 * float(np.nanmax(np.abs(typical))) if np.isfinite(typical).any() else 0.0
    noise = np.maximum(noise, rounding)
    unknown = ~np.isfinite(typical)
    for _ in range(_ROUNDS):
        level, beside = _around(nearest_counted(typical, ~(found | unknown)))
        apart = typical - level
        least = np.maximum(_SURE * math.sqrt(float((noise**2).mean())), ratio * beside)
        candidates = (np.abs(apart) > least) & ~found & ~unknown
        new = [place for place in np.argwhere(candidates) if _persists(known, noise, place, float(apart[tuple(place)]))]
        if not new:
            break
        found[tuple(np.transpose(new))] = True
    return found


def _around(image: Float[np.ndarray, "y x"]) -> tuple[Float[np.ndarray, "y x"], Float[np.ndarray, "y x"]]:
    """The median of each pixel's neighbours, and how far the third most deviating one is from it."""
    # beyond an edge the pixels at two from it go on, so that none is its own neighbour
    rows, columns = ([3, 2, *range(n), n - 3, n - 4] for n in image.shape)
    wide, number = image[np.ix_(rows, columns)], int(_RING.sum())
    level, highest, lowest = (
        ndimage.rank_filter(wide, rank, footprint=_RING)[2:-2, 2:-2]
        for rank in (number // 2, number - _THIRD, _THIRD - 1)
    )
    return level, np.maximum(highest - level, level - lowest)


def _persists(images: np.ndarray, noise: np.ndarray, place: np.ndarray, apart: float) -> bool:
    """Whether a pixel stands out to the same side in nearly all images in which it is known."""
    y, x = (int(index) for index in place)
    rows, columns = (slice(max(index - 2, 0), index + 3) for index in (y, x))
    window = images[:, :, rows, columns].astype(np.float64)
    inner = y - rows.start, x - columns.start
    pixel = window[:, :, inner[0], inner[1]].copy()
    window[:, :, inner[0], inner[1]] = np.nan
    anything = np.isfinite(window).any((2, 3)) & np.isfinite(pixel)
    if not anything.any():
        return False
    level = np.nanmedian(window.reshape(*window.shape[:2], -1)[anything], axis=-1)
    least = np.broadcast_to(_SEEN * noise[:, None], anything.shape)[anything]
    return float((math.copysign(1.0, apart) * (pixel[anything] - level) > least).mean()) >= _NEARLY_ALL
