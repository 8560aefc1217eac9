"""Arrays as the page holds them: 8 bits a value, deflated, in base64; large ones are thinned to block means first."""

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Shaped

# The largest of the values that are kept.
LEVELS = 255

# The part of a volume's values at either end that scales leave out: a few voxels that stand out don't decide them.
BEYOND = 2e-4


@dataclass(frozen=True)
class Thinning:
    """How an array is thinned for viewing: to the means of blocks, which are cut off at the array's ends.

    blocks: values of a block along each axis; 1 everywhere changes nothing.
    """

    blocks: tuple[int, ...]

    @classmethod
    def within(cls, most: int, shape: Sequence[int], spacing: Sequence[float]) -> "Thinning":
        """The blocks, as even in size as can be, of which at most so many are left. spacing: of the axes' values."""
        blocks = [1] * len(shape)
        while np.prod(_left(shape, blocks)) > most:
            can = [axis for axis, n in enumerate(shape) if blocks[axis] < n]
            finest = min(can, key=lambda axis: blocks[axis] * spacing[axis])
            blocks[finest] += 1
        return cls(tuple(blocks))

    @property
    def is_any(self) -> bool:
        """Whether anything is left out."""
        return any(block > 1 for block in self.blocks)

    @property
    def words(self) -> str:
        """The blocks' size, as 2 × 4 × 4."""
        return " × ".join(map(str, self.blocks))

    def of(self, array: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """The means of an array's blocks; the last axes are those of the blocks."""
        first = array.ndim - len(self.blocks)
        for axis, block in enumerate(self.blocks, first):
            if block > 1:
                n = array.shape[axis]
                starts = np.arange(0, n, block)
                sizes = np.diff(np.append(starts, n)).astype(array.dtype)
                array = np.add.reduceat(array, starts, axis)
                array /= sizes.reshape([-1 if i == axis else 1 for i in range(array.ndim)])
        return array

    def places(self, axis: int, number: int, spacing: float) -> list[float]:
        """The centres of an axis' blocks, from the middle of its `number` values, in the spacing's unit."""
        starts = np.arange(0, number, self.blocks[axis])
        ends = np.append(starts[1:], number)
        return [round(float(place), 6) for place in ((starts + ends) / 2 - number / 2) * spacing]


def _left(shape: Sequence[int], blocks: Sequence[int]) -> list[int]:
    return [-(-n // block) for n, block in zip(shape, blocks, strict=True)]


def in_levels(array: Float[np.ndarray, "..."], low: float, high: float) -> Shaped[np.ndarray, "..."]:
    """Values as whole numbers from 0 for the low one to LEVELS for the high one; what is beyond is cut off."""
    span = high - low
    scaled = (array - low) / span * LEVELS if span > 0 else np.zeros_like(array)
    return np.clip(scaled.round(), 0, LEVELS).astype(np.uint8)


def reach(values: Float[np.ndarray, "..."]) -> tuple[float, float]:
    """The least and the greatest value but for those few that stand out, and for 0, which is always within."""
    low, high = np.quantile(values, (BEYOND, 1 - BEYOND))
    low, high = min(0.0, float(low)), max(0.0, float(high))
    return (low, high) if high > low else (min(0.0, float(values.min())), max(0.0, float(values.max())))


def packed(data: bytes | np.ndarray) -> str:
    """Bytes, deflated, as text that the page's script unpacks."""
    raw = data if isinstance(data, bytes) else np.ascontiguousarray(data).tobytes()
    return base64.b64encode(zlib.compress(raw, 6)).decode("ascii")
