"""The pixel value at which a camera is saturated, which may lie below the largest value that the dtype can hold."""

import numpy as np

# Bit depths of cameras. Where the brightest pixel is the largest value of one of them, no other value tells saturation.
_CAMERAS = (8, 10, 12, 14, 16)


def full_scale(data: np.ndarray, bits: int | None = None) -> int:
    """The largest value that the camera behind integer pixels can give.

    data: integers of any shape, not empty.
    bits: the camera's bit depth; None where it isn't known. A depth that the pixels exceed is passed over: it is wrong,
        or they are left-aligned, as those of 12 bits that were multiplied by 16.
    """
    size, top = int(np.iinfo(data.dtype).max).bit_length(), int(data.max())
    if bits is not None and 0 < bits <= size and top < 2**bits:
        return 2**bits - 1
    if int(data.min()) >= 0 and top > 0:
        empty = _empty_low_bits(data)
        if top >> empty in {2**depth - 1 for depth in _CAMERAS if depth < size}:
            return top
        if data.dtype.kind == "u" and 0 < empty <= size // 2:
            return 2**size - 2**empty
    return int(np.iinfo(data.dtype).max)


def _empty_low_bits(data: np.ndarray) -> int:
    """How many of the lowest bits are 0 in every pixel. At least one pixel is above 0."""
    used = int(np.bitwise_or.reduce(data, axis=None))
    return (used & -used).bit_length() - 1
