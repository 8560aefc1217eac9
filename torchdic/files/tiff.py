"""The format TIFF: read with its axes and sizes (OME, ImageJ or plain), and written as OME-TIFF."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import tifffile
from jaxtyping import Shaped

from torchdic.errors import StackError
from torchdic.files.format import Format, Stack, shape_text
from torchdic.files.tiff_sizes import sizes_and_names
from torchdic.files.tiff_structure import check_pages, check_pixels

_GREY = 1  # PhotometricInterpretation MINISBLACK: the value grows with the light

_PHOTOMETRIC = {0: "0 is white", 2: "RGB", 3: "a colour palette", 5: "CMYK", 6: "YCbCr", 8: "CIELab"}

_OME_DTYPES = ("int8", "int16", "int32", "uint8", "uint16", "uint32", "float32", "float64")


def _read(path: Path) -> Stack:
    """The stack in a TIFF."""
    check_pages(path)
    with _tifffile_logs_as_debug(), tifffile.TiffFile(path) as tif:
        (focus_step, dy, dx), names = sizes_and_names(tif, path)
        series = _only_series(tif, path)
        data = _pixels(tif, series, path)
        bits = series.keyframe.bitspersample
    data = np.ascontiguousarray(data, dtype=data.dtype.newbyteorder("="))
    return Stack(
        data,
        pixel_size=None if dy is None or dx is None else (dy, dx),
        focus_step=focus_step,
        bits=bits if isinstance(bits, int) else None,
        names=names if len(names) == len(data) else (),
        source=str(path),
    )


def _only_series(tif: tifffile.TiffFile, path: Path) -> tifffile.TiffPageSeries:
    """The one series of images in the file, arranged as its header says."""
    if not tif.series:
        raise StackError(f"{path}: holds no images")
    if len(tif.series) > 1:
        shapes = ", ".join(shape_text(series.shape) for series in tif.series)
        raise StackError(f"{path}: holds {len(tif.series)} unequal images ({shapes}); a stack is one series")
    series = tif.series[0]
    # tifffile falls back to a plain row of pages where the header is broken or promises more than is there
    if tif.is_ome and series.kind not in ("ome", "mmstack"):
        raise StackError(f"{path}: its OME-XML does not describe its pages")
    if tif.is_imagej and not tif.is_ome and series.kind not in ("imagej", "mmstack"):
        raise StackError(f"{path}: truncated: its ImageJ header promises more planes than the file holds")
    return series


def _pixels(
    tif: tifffile.TiffFile, series: tifffile.TiffPageSeries, path: Path
) -> Shaped[np.ndarray, "prism focus y x"]:
    """The series' pixels, in the file's byte order. Raises StackError where they are no greyscale stack."""
    page = series.keyframe
    axes = series.get_axes(squeeze=False)
    if _is_array_stored_as_colour(series):
        axes = axes.replace("S", "Q")
    else:
        _check_grey(page, path)
    if page.dtype is None or page.dtype.kind not in "iuf":
        raise StackError(f"{path}: pixels are {page.dtype}, a stack holds integers or floats")
    shape = tuple(series.get_shape(squeeze=False))
    if 0 in shape:
        raise StackError(f"{path}: is empty, {shape_text(shape)} along {axes}; a stack has at least one pixel")
    check_pixels(tif, series, path)
    data = series.asarray(squeeze=False)
    if data.shape != shape:
        raise StackError(
            f"{path}: holds {shape_text(data.shape)} pixels, its header says {shape_text(shape)} along {axes}"
        )
    return _arrange(data, axes, path)


def _check_grey(page: tifffile.TiffPage, path: Path) -> None:
    if page.samplesperpixel > 1:
        raise StackError(
            f"{path}: is a colour image, {page.samplesperpixel} samples per pixel; a stack is grey "
            "(tifffile writes one with photometric='minisblack')"
        )
    if "PhotometricInterpretation" in page.tags and page.photometric != _GREY:
        kind = _PHOTOMETRIC.get(int(page.photometric), f"photometric interpretation {int(page.photometric)}")
        raise StackError(f"{path}: is not greyscale ({kind}); a stack's values grow with the light")


def _is_array_stored_as_colour(series: tifffile.TiffPageSeries) -> bool:
    """Whether the file is an array of floats (..., 3 or 4, y, x), which tifffile stores as RGB planes by default."""
    page = series.keyframe
    planar = page.planarconfig == tifffile.PLANARCONFIG.SEPARATE
    return series.kind == "shaped" and planar and page.dtype is not None and page.dtype.kind == "f"


def _arrange(data: np.ndarray, axes: str, path: Path) -> Shaped[np.ndarray, "prism focus y x"]:
    """The array as (prism, focus, y, x). axes: tifffile's letter of each axis; Q and I are axes without a name."""
    _check_axes(data.shape, axes, path)
    source = _places_of_axes(data.shape, axes, path)
    order = [source[axis] for axis in "CZYX" if axis in source]
    rest = [i for i in range(data.ndim) if i not in order]
    data = data.transpose(*rest, *order)
    shape = dict(zip([axis for axis in "CZYX" if axis in source], data.shape[len(rest) :], strict=True))
    return data.reshape([shape.get(axis, 1) for axis in "CZYX"])


def _check_axes(shape: tuple[int, ...], axes: str, path: Path) -> None:
    """Raise StackError for an array without y and x, for colours and for time."""
    if axes.count("Y") != 1 or axes.count("X") != 1:
        raise StackError(f"{path}: is no image ({axes}: {shape_text(shape)}); a stack has y and x")
    for axis, length in zip(axes, shape, strict=True):
        if axis == "S" and length > 1:
            raise StackError(f"{path}: is a colour image, {length} samples per pixel; a stack is grey")
        if axis == "T" and length > 1:
            raise StackError(f"{path}: has {length} time points; a stack's axes are (prism, focus, y, x)")


def _places_of_axes(shape: tuple[int, ...], axes: str, path: Path) -> dict[str, int]:
    """Which axis of the array is C, Z, Y and X. Axes without a name become C and Z where these are free."""
    nameless = [i for i, axis in enumerate(axes) if axis in "QI"]
    free = [axis for axis in "CZ" if axis not in axes or shape[axes.index(axis)] == 1]
    while len(nameless) > len(free) and shape[nameless[0]] == 1:
        nameless.pop(0)
    others = [axis for axis, n in zip(axes, shape, strict=True) if axis not in "CZYXSTQI" and n > 1]
    if others or len(nameless) > len(free):
        raise StackError(
            f"{path}: has more dimensions ({axes}: {shape_text(shape)}) than a stack's (prism, focus, y, x)"
        )
    places = {axis: axes.index(axis) for axis in "CZYX" if axis in axes}
    return places | dict(zip(free[len(free) - len(nameless) :], nameless, strict=True))


def _write(path: Path, stack: Stack, compression: str | None) -> None:
    """Write an OME-TIFF whose C axis is the prism and whose Z axis is the focus."""
    dy, dx = stack.pixel_size or (None, None)
    metadata: dict[str, object] = {"axes": "CZYX"}
    for axis, length in zip("ZYX", (stack.focus_step, dy, dx), strict=True):
        if length is not None:
            metadata |= {f"PhysicalSize{axis}": float(length), f"PhysicalSize{axis}Unit": "µm"}
    if stack.names:
        metadata["Channel"] = {"Name": list(stack.names)}
    resolution = {}
    if dy is not None and dx is not None:  # for readers without OME, plain ImageJ among them
        resolution = {"resolution": (1e4 / dx, 1e4 / dy), "resolutionunit": "CENTIMETER"}
    with _tifffile_logs_as_debug():
        tifffile.imwrite(
            path,
            stack.data,
            ome=True,
            photometric="minisblack",
            metadata=metadata,
            compression=compression,
            **resolution,
        )


@contextmanager
def _tifffile_logs_as_debug() -> Iterator[None]:
    """Pass tifffile's log lines on at level DEBUG: what matters in them is raised here as an error."""
    theirs, ours = logging.getLogger("tifffile"), logging.getLogger(__name__)

    def divert(record: logging.LogRecord) -> bool:
        ours.debug("tifffile: %s", record.getMessage())
        return False

    theirs.addFilter(divert)
    try:
        yield
    finally:
        theirs.removeFilter(divert)


TIFF = Format("TIFF", (".tif", ".tiff", ".tf2", ".tf8", ".btf"), _read, _write, _OME_DTYPES)
