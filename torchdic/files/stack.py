"""Recorded stacks and volumes of Δn, read and written by the suffix of their files."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchdic.errors import StackError, StackWarning
from torchdic.files.tiff import _by, _check_finite, _check_structure, _read, _tifffile_logs_as_debug, _write_ome
from torchdic.grid import Grid


@dataclass(frozen=True)
class Stack:
    """A recorded stack as its file holds it.

    data: (prism, focus, y, x) in the stored dtype (integer or float), finite. pixel_size: (y, x) in µm, None
    where the file doesn't say. focus_step: µm between planes, above 0, None where the file doesn't say. bits:
    bits per pixel, which may be fewer than the dtype's (a 12-bit camera). names: of the prisms, () where the
    file has none. source: the file, for messages. Raises StackError where data is not 4-D.
    """

    data: Shaped[np.ndarray, "prism focus y x"]
    pixel_size: tuple[float, float] | None = None
    focus_step: float | None = None
    bits: int | None = None
    names: tuple[str, ...] = ()
    source: str = "stack"

    def __post_init__(self) -> None:
        if self.data.ndim != 4:
            raise StackError(f"{self.source}: data has {self.data.ndim} axes, a stack has 4 (prism, focus, y, x)")

    @property
    def is_integer(self) -> bool:
        """Whether the pixels are counts of a camera (float ones are relative to the empty bright field)."""
        return self.data.dtype.kind in "iu"

    @property
    def saturation(self) -> int | None:
        """The largest value that an integer pixel can hold; None for float."""
        if not self.is_integer:
            return None
        limit = int(np.iinfo(self.data.dtype).max)
        return min(limit, 2**self.bits - 1) if self.bits and self.data.dtype.kind == "u" else limit


def read_stack(path: str | os.PathLike[str]) -> Stack:
    """Read a stack of greyscale images; its axes and sizes come from the file.

    OME-TIFF and ImageJ TIFF: the C axis is the prism, Z the focus. Plain TIFF: 2-D is one plane, 3-D is
    (focus, y, x), 4-D is (prism, focus, y, x). Compressed files too. Sizes come from OME-XML or, in an ImageJ
    TIFF, from the resolution, unit and spacing; the resolution of any other TIFF is a printer's and is left
    aside. Raises StackError for a file that is missing, no TIFF, truncated, empty, coloured, of more
    dimensions or of another dtype than integer and float, or with pixels that are not finite. Warns
    StackWarning of a unit that is no length.
    """
    path = Path(path)
    _check_structure(path)
    with _tifffile_logs_as_debug():
        try:
            stack = _read(path)
        except (StackError, StackWarning):  # the latter where warnings are errors
            raise
        except Exception as error:
            # bytes gone wrong raise anything, from struct.error to a codec's own error class
            reason = (str(error).splitlines() or [""])[0]
            raise StackError(f"{path}: cannot be read as TIFF: {type(error).__name__}: {reason}") from error
    _check_finite(stack.data, path)
    return stack


def write_stack(
    path: str | os.PathLike[str],
    data: np.ndarray | Tensor,
    pixel_size: tuple[float, float] | None = None,
    focus_step: float | None = None,
    *,
    names: Sequence[str] = (),
    compression: Literal["zlib", "lzw"] | None = None,
) -> None:
    """Write a stack as OME-TIFF, whole or not at all.

    data: (prism, focus, y, x), (focus, y, x) or (y, x), in its own dtype. pixel_size: (y, x) in µm.
    focus_step: µm; None where it is unknown or unequal. names: one per prism. Raises StackError for other
    shapes, a dtype that OME lacks, pixels that are not finite, and where it cannot write.
    """
    path = Path(path)
    array = data.detach().cpu().numpy() if isinstance(data, Tensor) else np.asarray(data)
    if array.ndim not in (2, 3, 4):
        raise StackError(
            f"{path}: data has {array.ndim} axes, a stack has (prism, focus, y, x), the first two optional"
        )
    array = array.reshape((1,) * (4 - array.ndim) + array.shape)
    if names and len(names) != len(array):
        raise StackError(f"{path}: {len(names)} names for {len(array)} prisms; a name belongs to one prism")
    dy, dx = pixel_size or (None, None)
    _write_ome(path, array, (focus_step, dy, dx), tuple(names), compression)


def read_volume(path: str | os.PathLike[str]) -> tuple[Float[Tensor, "z y x"], Grid]:
    """Read a volume written by `write_volume`: (z, y, x) as float32, and its grid.

    Raises StackError as `read_stack` does, and for a file of more than one channel or without a voxel size.
    """
    stack = read_stack(path)
    if len(stack.data) != 1:
        raise StackError(f"{path}: holds {len(stack.data)} channels, a volume has one")
    if stack.pixel_size is None or not stack.focus_step:
        raise StackError(f"{path}: has no voxel size; a volume needs PhysicalSizeX, Y and Z above 0")
    delta = torch.from_numpy(stack.data[0].astype(np.float32))
    nz, ny, nx = delta.shape
    return delta, Grid(shape=(nz, ny, nx), spacing=(stack.focus_step, *stack.pixel_size))


def write_volume(
    path: str | os.PathLike[str],
    delta: np.ndarray | Tensor,
    grid: Grid,
    *,
    name: str = "delta n",
    compression: Literal["zlib", "lzw"] | None = None,
) -> None:
    """Write a volume (z, y, x) as OME-TIFF float32, the grid's voxel size in µm, whole or not at all.

    Raises StackError where delta's shape is not the grid's, for voxels that are not finite, and where it
    cannot write.
    """
    path = Path(path)
    array = delta.detach().cpu().numpy() if isinstance(delta, Tensor) else np.asarray(delta)
    if array.shape != grid.shape:
        raise StackError(f"{path}: the volume has {_by(array.shape)} voxels, its grid {_by(grid.shape)}")
    if array.dtype.kind not in "iuf":
        raise StackError(f"{path}: voxels are {array.dtype}, a volume is real")
    _write_ome(path, array[None].astype(np.float32), grid.spacing, (name,), compression)
