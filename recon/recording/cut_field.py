"""Whether the specimen goes on beyond the field of a recording, and how much wider its volume must then be."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from recon.recording.background import noise_level
from torchdic import Grid, Microscope

# The frame's width in pixels, and the length along it of a block: a stuck pixel doesn't move a block's median, and
# what an objective resolves doesn't average out in it.
_WIDTH, _LENGTH = 2, 4

# Of a block's median of normal noise: its standard deviation in that of a pixel, as measured.
_MEDIAN = 0.41

_SURE = 5.0  # standard deviations: 1 in 2 million blocks of noise is beyond

# Contrast at the border, relative to the greatest within. For beads and balls that come near the border a periodic
# model of the field alone leaves 0.1 % of the variance at 0.1, and 1 % at 0.3.
_SHARE = 0.3

_MOST = 1 / 3  # of a side


def reaches_border(data: Float[np.ndarray, "prism focus y x"], noise: Sequence[float] | None = None) -> bool:
    """Whether the images show the specimen at their border.

    data: flattened and scaled, in any unit. noise: standard deviation of the noise of each prism's images, in that
    unit; None is measured in the images.

    The outermost two pixels are divided into blocks of 2 × 4 pixels. The specimen is at the border where a block's
    median differs from that of its image by 5 standard deviations of the noise, and by 0.3 of the greatest difference
    of any block of the prism's images: light that a specimen well inside scatters as far as the border is less.
    Raises ValueError for images of less than 8 × 8 pixels, or another number of noises than of prisms.
    """
    if min(data.shape[2:]) < 2 * _LENGTH:
        raise ValueError(f"images of {data.shape[2]} × {data.shape[3]} pixels have no frame: it takes 8 × 8")
    levels = [noise_level(images) or 0.0 for images in data] if noise is None else list(noise)
    if len(levels) != len(data):
        raise ValueError(f"noise has {len(levels)} values for {len(data)} prisms")
    return any(_at_border(images, level) for images, level in zip(data, levels, strict=True))


def margin_beyond(grid: Grid, microscope: Microscope, background: float) -> int:
    """Voxels by which a volume should be wider on each side than the field of images that the specimen goes beyond.

    grid: of the field. background: index of the medium.

    Light through the middle of the volume at the steepest angle θ of the condenser or the objective leaves it by half
    its depth times tanθ to the side. The margin is that, and a third of the shorter side at most.
    """
    apertures = [part.na for part in (microscope.condenser, microscope.objective) if part is not None]
    steepest = min(max(apertures, default=0.0) / background, 1.0)
    cosine = math.sqrt(1 - steepest**2)
    most = int(_MOST * min(grid.shape[1:]))
    spread = grid.extent[0] / 2 * steepest
    if spread >= cosine * most * min(grid.spacing[1:]):
        return most
    return math.ceil(spread / (cosine * min(grid.spacing[1:])))


def needed_margin(
    data: Float[np.ndarray, "prism focus y x"],
    noise: Sequence[float] | None,
    grid: Grid,
    microscope: Microscope,
    background: float,
) -> int:
    """`margin_beyond` where the specimen `reaches_border`, else 0."""
    return margin_beyond(grid, microscope, background) if reaches_border(data, noise) else 0


def _at_border(images: Float[np.ndarray, "focus y x"], noise: float) -> bool:
    """Whether one prism's images show the specimen at their border."""
    contrast = images - np.median(images, axis=(1, 2), keepdims=True)
    turned = contrast.swapaxes(1, 2)
    sides = (contrast[:, :_WIDTH], contrast[:, -_WIDTH:], turned[:, :_WIDTH], turned[:, -_WIDTH:])
    border = max(float(_block_medians(side).max()) for side in sides)
    return border > max(_SURE * _MEDIAN * noise, _SHARE * float(_block_medians(contrast).max()))


def _block_medians(contrast: Float[np.ndarray, "focus y x"]) -> Float[np.ndarray, "focus row column"]:
    """The magnitude of each block's median; the last blocks end at the image's last pixels."""
    planes, ny, nx = contrast.shape
    rows, columns = (np.unique([*range(0, n - side + 1, side), n - side]) for n, side in ((ny, _WIDTH), (nx, _LENGTH)))
    windows = np.lib.stride_tricks.sliding_window_view(contrast, (_WIDTH, _LENGTH), axis=(1, 2))
    blocks = windows[:, rows][:, :, columns].reshape(planes, len(rows), len(columns), -1)
    return np.abs(np.median(blocks, axis=-1))
