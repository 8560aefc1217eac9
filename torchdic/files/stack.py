"""Stacks and volumes of Δn, read and written in the format that the suffix of their file names.

To add a format, write one file beside `torchdic.files.tiff` that defines a `Format`, and add it to `FORMATS`.
"""

import math
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchdic.errors import StackError, StackWarning
from torchdic.files.extras.leica import LIF
from torchdic.files.extras.nikon import ND2
from torchdic.files.extras.ome_zarr import OME_ZARR_4, OME_ZARR_5, is_zarr
from torchdic.files.extras.zeiss import CZI
from torchdic.files.format import Format, Stack, shape_text
from torchdic.files.png import PNG
from torchdic.files.tiff import TIFF
from torchdic.files.whole import WriteError, folder_written_whole, written_whole
from torchdic.grid import Grid

# The first format that has a file's suffix is used, and TIFF for a file whose suffix none of them has.
FORMATS: list[Format] = [TIFF, PNG, ND2, CZI, LIF, OME_ZARR_5, OME_ZARR_4]

# The first bytes of a JPEG, whatever its name. Reading one would take its blocks for specimen.
_JPEG = b"\xff\xd8\xff"


def format_of(path: str | os.PathLike[str]) -> Format:
    """The format of a file, by the suffix of its name; TIFF for a suffix that no format has.

    A folder that Zarr has written is OME-Zarr, whatever its name.
    """
    name = Path(path).name.lower()
    usual = OME_ZARR_4 if is_zarr(Path(path)) else TIFF
    return next((known for known in FORMATS if name.endswith(known.suffixes)), usual)


def read_stack(path: str | os.PathLike[str], series: int | None = None) -> Stack:
    """Read a stack of greyscale images. Its axes and sizes come from the file.

    path: a file in one of `FORMATS`. Compressed files are read too.
    series: which one of several stacks (series or positions) in the file, counted from 0; None for the only one.

    In OME-TIFF and ImageJ TIFF the C axis is the prism and Z the focus. In plain TIFF, 2-D data is one plane, 3-D
    is (focus, y, x) and 4-D is (prism, focus, y, x); pages that were written one by one are planes. An axis of time is
    taken as the focus where the file has no other. Sizes come from OME-XML or, in an ImageJ TIFF, from the resolution,
    the units and the spacing. The resolution of any other TIFF is meant for printing and is ignored. ImageJ's
    straight-line calibration of the values is applied.

    Raises StackError for a file that is missing, in no known format, truncated, empty or coloured, that has more
    dimensions or a dtype other than integer and float, that holds several series of which none is chosen, or that has
    pixels that are not finite.
    Warns StackWarning of a size that is no length, of time that is taken as the focus, and of a calibration.
    """
    path = Path(path)
    known = format_of(path)
    _check_openable(path, known)
    try:
        stack = known.read(path) if series is None else _read_one(known, path, series)
    except (StackError, StackWarning, MemoryError):  # StackWarning where warnings are errors
        raise
    except Exception as error:
        # damaged bytes can raise anything, from struct.error to a codec's own error class
        reason = (str(error).splitlines() or [""])[0]
        raise StackError(f"{path}: cannot be read as {known.name}: {type(error).__name__}: {reason}") from error
    _check_finite(stack.data, path)
    return stack


def equal_step(focus: Sequence[float]) -> float | None:
    """The distance in µm between focus planes, above 0; None unless they rise, or fall, in equal steps."""
    steps = [b - a for a, b in pairwise(focus)]
    if not steps or not steps[0] or max(steps) - min(steps) > 1e-6 * abs(steps[0]):
        return None
    return float(f"{abs(steps[0]):.10g}")  # differences of tenths are tenths again


def write_stack(
    path: str | os.PathLike[str],
    data: np.ndarray | Tensor,
    pixel_size: tuple[float, float] | None = None,
    focus_step: float | None = None,
    *,
    names: Sequence[str] = (),
    bits: int | None = None,
    compression: Literal["zlib", "lzw"] | None = None,
) -> None:
    """Write a stack, as OME-TIFF unless the suffix of `path` names another format. An error leaves no half a file.

    path: the file to write or replace.
    data: (prism, focus, y, x), (focus, y, x) or (y, x); stored in its own dtype.
    pixel_size: (y, x) in µm; None where it is unknown.
    focus_step: distance between planes in µm; None where it is unknown or not the same for all planes.
    names: one per prism, or none.
    bits: of the camera, where they are fewer than those of the dtype.
    compression: None stores the pixels as they are.

    Raises StackError for other shapes, a dtype that the format does not have, pixels that are not finite, sizes
    that are not above 0, a format that is only read, and a place that cannot be written to.
    """
    path = Path(path)
    array = _as_array(data)
    if array.ndim not in (2, 3, 4):
        raise StackError(
            f"{path}: data has {array.ndim} axes, a stack has (prism, focus, y, x), the first two optional"
        )
    array = array.reshape((1,) * (4 - array.ndim) + array.shape)
    if names and len(names) != len(array):
        raise StackError(f"{path}: {len(names)} names for {len(array)} prisms; each prism has one name")
    _write(path, Stack(array, pixel_size, focus_step, bits, tuple(names), str(path)), compression)


def read_volume(path: str | os.PathLike[str]) -> tuple[Float[Tensor, "z y x"], Grid]:
    """Read a volume that `write_volume` wrote: Δn (z, y, x) as float32, and its grid in µm.

    Raises StackError as `read_stack` does, and for a file of more than one channel or without a voxel size.
    """
    stack = read_stack(path)
    if len(stack.data) != 1:
        raise StackError(f"{path}: holds {len(stack.data)} channels, a volume has one")
    if stack.pixel_size is None or not stack.focus_step:
        raise StackError(f"{path}: has no voxel size; a volume says how long a voxel is along x, y and z")
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
    """Write a volume in float32, as OME-TIFF unless the suffix of `path` names another format.

    path: the file to write or replace. An error leaves no half a file.
    delta: (z, y, x), real. One in float32 that lies in a file (numpy.memmap) is written as OME-Zarr plane by plane, and
        never held whole in memory.
    grid: of delta's shape; its spacing becomes the voxel size in µm.
    name: of the file's one channel.
    compression: None stores the voxels as they are.

    Raises StackError where delta's shape is not the grid's, for voxels that are not finite, a format that is only
    read, and a place that cannot be written to.
    """
    path = Path(path)
    array = _as_array(delta)
    if array.shape != grid.shape:
        raise StackError(f"{path}: the volume has {shape_text(array.shape)} voxels, its grid {shape_text(grid.shape)}")
    if array.dtype.kind not in "iuf":
        raise StackError(f"{path}: voxels are {array.dtype}, a volume holds real numbers")
    voxels = array[None].astype(np.float32, copy=False)
    _write(path, Stack(voxels, grid.spacing[1:], grid.spacing[0], names=(name,), source=str(path)), compression)


def _read_one(known: Format, path: Path, series: int) -> Stack:
    if known.read_series is None:
        raise StackError(f"{path}: series {series}: a file in {known.name} holds one")
    return known.read_series(path, series)


def _as_array(data: np.ndarray | Tensor) -> np.ndarray:
    return data.detach().cpu().numpy() if isinstance(data, Tensor) else np.asarray(data)


def _write(path: Path, stack: Stack, compression: str | None) -> None:
    """Write a stack in its file's format beside its final place, and then move it there in one step."""
    known = format_of(path)
    if known.write is None:
        raise StackError(f"{path}: {known.name} can be read but not written; choose a name that ends in .ome.tif")
    _check_writable(path, stack, known.dtypes)
    try:
        with (folder_written_whole if known.folder else written_whole)(path) as partial:
            known.write(partial, stack, compression)
    except WriteError as error:
        raise StackError(str(error)) from error


def _check_openable(path: Path, known: Format) -> None:
    if known.folder and path.is_dir():
        return
    try:
        with path.open("rb") as file:
            size, head = os.fstat(file.fileno()).st_size, file.read(len(_JPEG))
    except FileNotFoundError as error:
        raise StackError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise StackError(f"{path}: is a folder; a stack is one file, which torchdic new makes of a folder") from error
    except OSError as error:
        raise StackError(f"{path}: cannot be opened: {error.strerror or error}") from error
    if known.folder:
        raise StackError(f"{path}: is a file; {known.name} is a folder of files: unpack it")
    if size == 0:
        raise StackError(f"{path}: is empty, 0 bytes")
    if head == _JPEG:
        raise StackError(
            f"{path}: is a JPEG, whose compression has changed its greys; export the recording again as TIFF, which "
            "keeps them: from the microscope's program, or open its own file in Fiji, File > Save As > Tiff…"
        )


def _check_writable(path: Path, stack: Stack, dtypes: tuple[str, ...]) -> None:
    """Raise StackError for what no reader of stacks would accept."""
    data = stack.data
    if data.dtype.name not in dtypes:
        raise StackError(f"{path}: pixels are {data.dtype}, the file can hold {', '.join(dtypes)}")
    if data.size == 0:
        raise StackError(f"{path}: would be empty, {shape_text(data.shape)}; a stack has at least one pixel")
    _check_finite(data, path)
    for axis, length in zip("zyx", (stack.focus_step, *(stack.pixel_size or ())), strict=False):
        if length is not None and not (math.isfinite(length) and length > 0):
            raise StackError(f"{path}: a size of {length} µm along {axis} must be above 0")


def _check_finite(data: np.ndarray, path: Path) -> None:
    if data.dtype.kind != "f":
        return
    bad = nan = 0
    for plane in data.reshape(-1, *data.shape[-2:]):  # data may lie in a file, and be larger than memory
        bad += plane.size - int(np.isfinite(plane).sum())
        nan += int(np.isnan(plane).sum())
    if bad:
        raise StackError(f"{path}: {bad} of {data.size} pixels are not finite ({nan} NaN, {bad - nan} infinite)")
