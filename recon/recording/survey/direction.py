"""The direction of shear, from the dipole that every specimen makes: one side brighter than the field, one darker.

A weak phase φ shows as I ≈ background + ½ sin(bias) s·∇φ. Integrated by parts over a specimen that stands alone, its
first moment is ∫(I − background) x d²x = −½ sin(bias) s ∫φ d²x: along the shear, whatever the specimen's shape. Of a
spectrum it is the slope at frequency 0, where defocus has no effect. So an elongated specimen doesn't turn it, as it
turns the direction of the spectrum's power (`recon.recording.shear_axis`), and all planes show the same.
"""

import cmath
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage import filters

from recon.recording.background import background_surface, noise_level
from recon.recording.shear_axis import estimate_shear_axis

# Pixels over which images are smoothed before specimens are told from the field, and median contrasts (the noise of the
# field) above which there is one at least.
_SMOOTH, _ABOVE_FIELD = 1.5, 1.5

# Contrast of a field, relative to its light, that is rounding.
_EVEN = 1e-6

# Contrast at the field's edge, relative to a specimen's greatest, from which the edge cuts it.
_CUT = 0.3

# Pixels around a specimen that belong to it: narrow and wide, by which the moment should not change.
_AROUND = (3, 6)

# Total degrees of the field's background around it, by which the moment should not change either.
_ORDERS = (0, 1)

# Share of the field without any specimen that a background needs.
_FREE = 0.2

# A smaller specimen, in pixels, is a speck of dust or noise.
_SMALLEST = 30

# Share of the field in specimens, or their number, from which on their own directions are taken to cancel each other.
_CROWDED, _MANY = 0.5, 8

# What is left of the moment of |I − background| in that of I − background: less is chance, or bright field. Recorded
# fibres, which lie in all directions, leave 0.1, cells and beads 0.3 to 0.7, a measured bright field 0.06.
_FAINT = 0.08

# Standard deviations of the planes' and backgrounds' directions over the error of their mean, as measured on recorded
# beads, cells and fibres: they share the specimen, so they are not independent.
_DEPENDENT = 2.0

# A direction that is less certain, in rad, is none.
_LOST = 0.6

# Nor does a spectrum tell it better than this: specimens that lie alike turn it, which nothing shows.
_SPECTRAL = math.radians(20.0)

# No image tells its axis better, rad: pixels and lamp are not that even.
_BEST = math.radians(1.0)


@dataclass(frozen=True)
class ShearDirection:
    """The direction of shear in images of one prism setting.

    angle: rad, from +x toward +y (down the screen), in [0, 2π) where `signed`, else in [0, π).
    uncertainty: its standard deviation, rad.
    signed: whether the sign is known: the shear points along the angle if Δn is positive as a whole and 0 < bias < π.
        Shear and bias reversed together give the same image, so that bias's sign isn't known by itself.
    specimens: how many stood alone and were used; 0 where the axis is that of the spectrum's power.
    """

    angle: float
    uncertainty: float
    signed: bool
    specimens: int

    @property
    def vector(self) -> tuple[float, float]:
        """The unit vector (y, x)."""
        return math.sin(self.angle), math.cos(self.angle)


def shear_direction(
    images: Float[np.ndarray, "focus y x"], pixel_size: tuple[float, float] = (1.0, 1.0)
) -> ShearDirection | None:
    """The direction of shear in the planes of one setting; None where they show none.

    images: flattened, in any unit, without stuck pixels. pixel_size: (y, x), in any length.

    Where specimens stand alone in the field, it is that of their summed dipoles. Its uncertainty comes from how it
    changes from plane to plane and with what is taken as background, and from the noise. A field that is crowded has
    the axis of the power of its sharpest spectrum, which a direction of the specimens' own would turn: it is uncertain
    by at least half of what the axes of coarse and of fine detail differ by, and by 20°. A few specimens that the
    field's edge cuts show none.
    """
    contrast = _contrast(images)
    core = _standing_out(contrast)
    found = _dipole(images, contrast, core, pixel_size)
    if found is None and (core.mean() > _CROWDED or _numbered(core)[1] >= _MANY):
        return _spectral(images, pixel_size)
    return found


def specimens(images: Float[np.ndarray, "focus y x"]) -> Bool[np.ndarray, "y x"]:
    """Where in the field there is a specimen (True): its contrast in any plane stands out of the field's.

    images: flattened, about 1.
    """
    return _standing_out(_contrast(images))


def _contrast(images: np.ndarray) -> Float[np.ndarray, "y x"]:
    """The rms over the planes of what each smoothed pixel differs from the field by."""
    total = np.zeros(images.shape[1:])
    for image in images:
        smooth = ndimage.gaussian_filter(image, _SMOOTH)
        total += (smooth - np.median(smooth)) ** 2
    return np.sqrt(total / len(images))


def _standing_out(contrast: Float[np.ndarray, "y x"]) -> Bool[np.ndarray, "y x"]:
    """Where the contrast is a specimen's."""
    if float(np.ptp(contrast)) <= _EVEN:
        return np.zeros(contrast.shape, bool)
    threshold = max(float(filters.threshold_triangle(contrast)), _ABOVE_FIELD * float(np.median(contrast)))
    filled = ndimage.binary_fill_holes(contrast > threshold)
    assert filled is not None
    return filled


def _dipole(
    images: np.ndarray,
    contrast: Float[np.ndarray, "y x"],
    core: Bool[np.ndarray, "y x"],
    pixel_size: tuple[float, float],
) -> ShearDirection | None:
    """The direction of the summed dipoles of the specimens that stand alone; None where there are none."""
    moments, number, longest, magnitude = [], 0, 0.0, 0.0
    for around in _AROUND:
        labels, count = _alone(core, contrast, around)
        if count == 0 or float((labels == 0).mean()) < _FREE:
            return None
        lever = _levers(labels, count, pixel_size)
        number, longest = max(number, count), max(longest, float(np.linalg.norm(lever)))
        for order in _ORDERS:
            for image in images:
                light = (image - background_surface(np.where(labels == 0, image, np.nan), order)) * lever
                moments.append(complex(light.sum()))
                magnitude += float(np.abs(light).sum())
    if abs(sum(moments)) < _FAINT * magnitude:
        return None
    # what noise gives the mean of all planes' moments along one direction
    noise = (noise_level(images) or 0.0) * longest / math.sqrt(2 * len(images))
    return _direction_of(np.array(moments), noise, number, _DEPENDENT if len(images) > 1 else 1.0)


def _direction_of(moments: np.ndarray, noise: float, number: int, dependent: float) -> ShearDirection | None:
    """The direction of complex moments (x + iy); None where it is too uncertain.

    noise: standard deviation of their mean. number: of specimens. dependent: what divides the moments' scatter.
    """
    mean = complex(moments.mean())
    if mean == 0:
        return None
    across = (moments / (mean / abs(mean))).imag / abs(mean)  # each one's part across the mean direction
    scatter = float(np.sqrt((across**2).mean())) / dependent
    uncertainty = math.hypot(scatter, noise / abs(mean), _BEST)
    if uncertainty > _LOST:
        return None
    return ShearDirection(cmath.phase(-mean) % (2 * math.pi), uncertainty, signed=True, specimens=number)


def _alone(core: Bool[np.ndarray, "y x"], contrast: Float[np.ndarray, "y x"], around: int) -> tuple[np.ndarray, int]:
    """The specimens that the field's edge doesn't cut, numbered from 1; the field is 0, what doesn't count is −1.

    around: pixels around a specimen that belong to it; the edge may cut these. A specimen is cut where its contrast at
    the edge is 0.3 of its greatest, as for `recon.recording.cut_field`.
    Returns the numbers of the pixels, and how many specimens there are.
    """
    labels, count = _numbered(ndimage.binary_dilation(core, iterations=around))
    inside, edge = np.where(core, contrast, 0), np.ones(labels.shape, bool)
    edge[1:-1, 1:-1] = False
    numbers = np.arange(count + 1)
    greatest, cut_at = (
        np.asarray(ndimage.maximum(values, labels, numbers)) for values in (inside, np.where(edge, inside, 0))
    )
    cut = set(np.flatnonzero(cut_at > _CUT * greatest))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    left = [n for n in range(1, count + 1) if n not in cut and sizes[n] >= _SMALLEST]
    renumbered = np.full(count + 1, -1)
    renumbered[0] = 0
    renumbered[left] = np.arange(1, len(left) + 1)
    return renumbered[labels], len(left)


def _numbered(mask: Bool[np.ndarray, "y x"]) -> tuple[np.ndarray, int]:
    """The connected parts of a mask, numbered from 1, and how many there are."""
    found: Any = ndimage.label(mask)
    return np.asarray(found[0]), int(found[1])


def _levers(labels: np.ndarray, count: int, pixel_size: tuple[float, float]) -> np.ndarray:
    """Each pixel's place x + iy from the middle of its specimen; 0 outside of them.

    The levers of a specimen sum to 0, so that a constant error of its background leaves its moment as it is.
    """
    rows, columns = (np.arange(n) * side for n, side in zip(labels.shape, pixel_size, strict=True))
    place, inside = columns[None, :] + 1j * rows[:, None], labels > 0
    which = labels[inside]
    sizes = np.maximum(np.bincount(which, minlength=count + 1), 1)
    y, x = (np.bincount(which, part[inside], minlength=count + 1) / sizes for part in (place.imag, place.real))
    lever = np.zeros(labels.shape, complex)
    lever[inside] = place[inside] - (x + 1j * y)[which]
    return lever


def _spectral(images: np.ndarray, pixel_size: tuple[float, float]) -> ShearDirection | None:
    """The axis of the spectrum's power in the image whose detail is the finest; None where it shows none."""
    sharpest = max(images, key=lambda image: float((ndimage.gaussian_laplace(image, 1.0) ** 2).mean()))
    coarse = ndimage.gaussian_filter(sharpest, 2 * _SMOOTH)
    try:
        axis = estimate_shear_axis(sharpest, pixel_size)
        other = estimate_shear_axis(coarse, pixel_size)
    except ValueError:
        return None
    apart = abs((axis.angle - other.angle + math.pi / 2) % math.pi - math.pi / 2)
    uncertainty = max(axis.uncertainty, apart / 2, _SPECTRAL)
    return None if uncertainty > _LOST else ShearDirection(axis.angle, uncertainty, signed=False, specimens=0)
