"""Where in a volume the specimen can be: from the edges of each section that is in focus.

A section in focus shows a specimen's edges sharp, the others blur them. So the outline of the edges in each focus
plane, filled and widened, holds the specimen's section there (Feineigle's idea of segmenting DIC stacks by sections).
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage import filters

from torchdic import Grid, Microscope

# The energy of gradients is averaged over about the smallest spot, λ/(2·NA), and at least over this many pixels.
_LEAST_WIDTH = 1.0

# Median energies of a plane (its noise, where most of it is empty) beyond which there is an edge at least.
_ABOVE_NOISE = 3.0

# Widths of the smallest spot by which the outline's gaps are closed, and by which the support is widened.
_CLOSED, _WIDENED = 3.0, 2.0


def edges_support(
    data: Float[np.ndarray, "prism focus y x"],
    focus: Sequence[float],
    grid: Grid,
    microscope: Microscope,
    background: float,
) -> Bool[np.ndarray, "z y x"]:
    """The voxels (True) in which the specimen can be, as the edges of the sections in focus tell.

    data: flattened and scaled. focus: of the planes, µm. grid: of the field, whose pixels the images have. background:
    index of the medium.

    In each plane the squared Sobel gradients, over each prism's own noise of them and averaged over the prisms, are
    thresholded for the whole stack by the triangle method (at three times the median at least), gaps are closed and
    holes filled. A slice has the support of the planes on both of its sides. All is widened by two of the objective's
    smallest spots laterally, and by the depth of focus, so that it errs on the safe side: a voxel that is left out is
    lost to the fit, one too many costs next to nothing. It is everywhere where no plane shows an edge.
    """
    aperture = microscope.objective.reach(background) if microscope.objective is not None else 1.0
    spot = microscope.wavelength / (2 * aperture)
    widths = [max(spot / spacing, _LEAST_WIDTH) for spacing in grid.spacing[1:]]
    energy = _edge_energy(data, widths)
    threshold = max(float(filters.threshold_triangle(energy)), _ABOVE_NOISE * float(np.median(energy)))
    planes = np.stack([_outline(plane > threshold, widths) for plane in energy])
    if not planes.any():
        return np.ones(grid.shape, bool)
    depths = (np.arange(grid.shape[0]) - (grid.shape[0] - 1) / 2) * grid.spacing[0]
    sections = _between(planes, np.asarray(focus, np.float64), depths)
    disc = _disc([_WIDENED * width for width in widths])
    wide = np.stack([ndimage.binary_dilation(section, disc) for section in sections])
    deep = math.ceil(2 * microscope.wavelength / aperture**2 / grid.spacing[0])
    return ndimage.binary_dilation(wide, np.ones((2 * deep + 1, 1, 1), bool))


def _edge_energy(data: np.ndarray, widths: Sequence[float]) -> Float[np.ndarray, "focus y x"]:
    """The averaged squared gradient of each plane, in units of its median over each prism's images."""
    total = np.zeros(data.shape[1:])
    for images in data.astype(np.float64):
        smooth = np.stack([ndimage.gaussian_filter(image, [width / 2 for width in widths]) for image in images])
        squares = np.stack([filters.sobel(image) ** 2 for image in smooth])
        squares = np.stack([ndimage.gaussian_filter(plane, widths) for plane in squares])
        typical = float(np.median(squares))
        total += squares / typical if typical > 0 else squares / max(float(squares.mean()), np.finfo(np.float64).tiny)
    return total / len(data)


def _outline(edges: Bool[np.ndarray, "y x"], widths: Sequence[float]) -> Bool[np.ndarray, "y x"]:
    """Edges with their gaps closed and what they enclose filled."""
    reach = math.ceil(_CLOSED * max(widths))
    # padded, because a closing that meets the array's border takes its pixels away
    closed = ndimage.binary_closing(np.pad(edges, reach), _disc([_CLOSED / 2 * width for width in widths]))
    filled = ndimage.binary_fill_holes(closed[reach:-reach, reach:-reach])
    assert filled is not None
    return filled


def _disc(radii: Sequence[float]) -> Bool[np.ndarray, "y x"]:
    """An ellipse of these radii (y, x) in pixels, as a structuring element."""
    ry, rx = (math.ceil(radius) for radius in radii)
    y, x = np.mgrid[-ry : ry + 1, -rx : rx + 1]
    return (y / max(radii[0], 1)) ** 2 + (x / max(radii[1], 1)) ** 2 <= 1.0


def _between(
    planes: Bool[np.ndarray, "focus y x"], focus: Float[np.ndarray, " focus"], depths: Float[np.ndarray, " z"]
) -> Bool[np.ndarray, "z y x"]:
    """The support of each slice: that of the nearest planes above and below; beyond the last plane that of it."""
    order = np.argsort(focus)
    place, planes = focus[order], planes[order]
    above = np.clip(np.searchsorted(place, depths, side="left"), 0, len(place) - 1)
    below = np.clip(np.searchsorted(place, depths, side="right") - 1, 0, len(place) - 1)
    return planes[above] | planes[below]
