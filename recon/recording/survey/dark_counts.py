"""A camera's gain and dark counts, from how its noise grows with its light."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Real

from recon.recording.noise import fitted_line, variances_of_levels

# Read noise in electrons, which the noise doesn't tell apart from dark counts, and how far it may be from that. Cameras
# for microscopes have 1 to 3, older ones more.
_READ, _READ_ERROR = 2.0, 2.0

_UNSURE = 0.1  # a gain whose standard error is a larger part of it can't be told


@dataclass(frozen=True)
class DarkCounts:
    """The camera behind a stack of counts.

    gain: counts per electron. read: standard deviation of the read noise in counts, of 2 electrons, which is assumed.
    offset: counts in the dark. Each has its standard error; that of the offset holds the assumption.
    """

    gain: float
    gain_error: float
    offset: float
    offset_error: float
    read: float

    @property
    def offset_is_seen(self) -> bool:
        """Whether the offset is above 0 by more than its errors."""
        return self.offset > 3 * self.offset_error


def dark_counts(
    images: Real[np.ndarray, "*planes y x"], mask: Bool[np.ndarray, "*planes y x"] | None = None
) -> DarkCounts | None:
    """Gain and dark counts of a stack; None where its noise doesn't tell a gain.

    images: (..., y, x), counts as stored. mask: the pixels that count (True); None is all.

    The noise's variance is gain·(level − offset) + read². A line through the variances (see `noise_of_level`) gives the
    gain, and the offset as the level at which only the read noise is left.
    """
    lit = images.min((-2, -1)) < images.max((-2, -1))  # a frame that was dropped has one value, and no noise
    levels, variances, blocks = variances_of_levels(images[lit], None if mask is None else mask[lit])
    if len(levels) < 4:
        return None
    (intercept, gain), error = fitted_line(np.stack([np.ones_like(levels), levels], axis=1), variances, blocks)
    if not gain > error[1] / _UNSURE:
        return None
    offset = (_READ * gain) ** 2 / gain - intercept / gain
    # about the middle of the levels the line's height and its slope err independently
    precision = blocks / np.maximum(variances, np.finfo(np.float64).tiny) ** 2
    middle = float(np.average(levels, weights=precision))
    height = (error[0] ** 2 - (middle * error[1]) ** 2) if error[0] > middle * error[1] else 0.0
    slope = (middle - offset) * error[1] / gain
    unknown = ((_READ + _READ_ERROR) ** 2 - _READ**2) / 2 * gain
    offset_error = math.sqrt(height / gain**2 + slope**2 + unknown**2)
    return DarkCounts(float(gain), float(error[1]), float(offset), offset_error, _READ * float(gain))
