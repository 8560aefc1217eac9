"""A recorded stack in memory, and what a file format must offer to be read into one or written from one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from torchdic.errors import StackError
from torchdic.files.described.setup import StatedSetup
from torchdic.files.full_scale import full_scale


@dataclass(frozen=True)
class Stack:
    """A recorded stack of images, as its file holds it.

    data: (prism, focus, y, x), integer or float as stored; `read_stack` gives finite values only.
    pixel_size: (y, x) in µm; None where the file does not say.
    focus_step: distance between planes in µm, above 0; None where the file does not say.
    bits: bits per pixel, which may be fewer than the dtype has (a 12-bit camera); None where the file does not say.
    names: one name per prism; () where the file has none.
    source: the file's path, for messages.
    full_scale: the value at which a camera's pixel is saturated, where a calibration of the values has moved it. Pixels
        for which it is given are counts even as floats.
    Raises StackError where data does not have 4 axes.
    """

    data: Shaped[np.ndarray, "prism focus y x"]
    pixel_size: tuple[float, float] | None = None
    focus_step: float | None = None
    bits: int | None = None
    names: tuple[str, ...] = ()
    source: str = "stack"
    full_scale: float | None = None

    def __post_init__(self) -> None:
        if self.data.ndim != 4:
            raise StackError(f"{self.source}: data has {self.data.ndim} axes, a stack has 4 (prism, focus, y, x)")

    @property
    def is_integer(self) -> bool:
        """Whether the pixels are a camera's counts. Other float pixels are relative to the empty bright field."""
        return self.data.dtype.kind in "iu" or self.full_scale is not None

    @property
    def saturation(self) -> float | None:
        """The value at which a count is saturated; None for pixels that are relative to the empty bright field."""
        if not self.is_integer:
            return None
        return full_scale(self.data, self.bits) if self.full_scale is None else self.full_scale


@dataclass(frozen=True)
class Format:
    """A file format: which files are in it, and how a stack is read from such a file or written to one.

    name: as messages call it, such as "TIFF".
    suffixes: the ends of its files' names, in lower case and with the dot.
    read: takes the path of a file that can be opened and is not empty, and returns its stack. It raises StackError
        with the path, the value and the rule for a file that is no stack. Any other exception is reported to the
        user as a file that cannot be read in this format.
    write: takes a path, a stack and the name of a compression (None for no compression). The stack's pixels are
        finite and its sizes are above 0. The path lies beside the final one and is moved there afterwards, so an
        interrupted write leaves no half a file. None for a format that is only read.
    dtypes: the names of the dtypes that `write` can store.
    read_series: as `read`, with the number of a series, counted from 0, of which a file may hold several; None for a
        format whose files hold one.
    setup: what such a file says of its microscope; None for a format that says nothing.
    folder: whether such a file is a folder of files.
    """

    name: str
    suffixes: tuple[str, ...]
    read: Callable[[Path], Stack]
    write: Callable[[Path, Stack, str | None], None] | None = None
    dtypes: tuple[str, ...] = ()
    read_series: Callable[[Path, int], Stack] | None = None
    setup: Callable[[Path], StatedSetup] | None = None
    folder: bool = False


def offer_of_series(number: int) -> str:
    """How one of several series is chosen, for messages."""
    return f"series = 0 … {number - 1} in [data], or --series of torchdic new, takes one"


def shape_text(shape: Sequence[int]) -> str:
    """A shape as messages show it: 2 × 5 × 64 × 64."""
    return " × ".join(str(n) for n in shape)
