"""The format TIFF: read with its axes and sizes (OME, ImageJ or plain), and written as OME-TIFF."""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from torchdic.errors import StackError
from torchdic.files.arrangement.axes import arrange, place_axis
from torchdic.files.arrangement.grey import check_grey, greys_of_palette, has_palette
from torchdic.files.arrangement.series import chosen_series, pages_one_by_one
from torchdic.files.described import ome
from torchdic.files.described.bits import stated_bits
from torchdic.files.described.imagej import StraightLine, calibration, imagej_sizes
from torchdic.files.described.ndtiff import ndtiff_channels
from torchdic.files.described.setup import setup_in_tiff
from torchdic.files.format import Format, Stack, shape_text
from torchdic.files.full_scale import full_scale
from torchdic.files.tiff_structure import check_pages, check_pixels

_OME_DTYPES = ("int8", "int16", "int32", "uint8", "uint16", "uint32", "float32", "float64")

# Control characters, and what stands for bytes of a name that isn't UTF-8.
_NOT_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")

_MOST_PER_CENTIMETRE = 2**32 - 1  # a resolution is a fraction of two 32-bit integers


@dataclass(frozen=True)
class _Planes:
    """Pixels as the file holds them, tifffile's letter of each of their axes, and the page that describes them."""

    data: np.ndarray
    axes: str
    page: tifffile.TiffPage


def _read(path: Path) -> Stack:
    """The stack in a TIFF."""
    return _read_series(path)


def _read_series(path: Path, number: int | None = None) -> Stack:
    """One stack of a TIFF that may hold several; number: which, counted from 0, None for the only one."""
    check_pages(path)
    with _tifffile_logs_as_debug(), tifffile.TiffFile(path) as tif:
        sizes, names, places = _described(tif, path, number or 0)
        planes = _planes(tif, path, number, places=places)
        line = calibration(tif, path)
        depths = stated_bits(tif, planes.page)
        data = arrange(planes.data, planes.axes, path)
    data = np.ascontiguousarray(data, dtype=data.dtype.newbyteorder("="))
    (focus_step, dy, dx), counts = sizes, data.dtype.kind in "iu"
    top = int(data.max()) if counts else 0
    bits = next((bits for bits in depths if top < 2**bits), None)
    calibrated = data if line is None else line.of(data)
    return Stack(
        calibrated,
        pixel_size=None if dy is None or dx is None else (dy, dx),
        focus_step=focus_step,
        bits=bits,
        names=names if len(names) == len(data) else (),
        source=str(path),
        full_scale=None if line is None or not counts else _calibrated_scale(data, calibrated, bits, line),
    )


def _described(tif: tifffile.TiffFile, path: Path, number: int) -> tuple[ome.Sizes, tuple[str, ...], bool]:
    """Sizes in µm and the prisms' names of an image, and whether the images lie at more than one place.

    A size is None and the names are () where the file does not say. Raises StackError for OME-XML that cannot be
    parsed or that spreads the stack over files that are missing.
    """
    if tif.is_ome:
        root = ome.parsed(tif, path)
        ome.find_planes(tif, root, path)
        ome.warn_of_guessed_axes(root, path)
        return *ome.sizes_and_names(root, path, number), ome.has_places(root)
    if tif.is_ndtiff:
        return (None, None, None), ndtiff_channels(path), False
    return imagej_sizes(tif, path) if tif.is_imagej else (None, None, None), (), False


def _planes(tif: tifffile.TiffFile, path: Path, number: int | None, *, places: bool) -> _Planes:
    """The pixels of a series, or of pages that were written one by one. places: whether images are places instead."""
    pages = pages_one_by_one(tif) if number is None and not places else None
    if pages is not None:
        for series in tif.series:
            _check_series(tif, series, path)
        page = tif.series[0].keyframe
        data, axes = np.stack([page.asarray() for page in pages]), "IYX"
    else:
        series, place = chosen_series(tif, path, number)
        _check_kind(tif, series, path)
        page = series.keyframe
        axes = _check_series(tif, series, path)
        data = series.asarray(squeeze=False)
        if data.shape != series.get_shape(squeeze=False):
            shape = shape_text(series.get_shape(squeeze=False))
            raise StackError(f"{path}: holds {shape_text(data.shape)} pixels, its header says {shape} along {axes}")
        along = place_axis(data.shape, axes)
        if place is not None and along is not None:
            data, axes = data.take(place, along), axes[:along] + axes[along + 1 :]
    if has_palette(page):
        data = greys_of_palette(data, [p for p in tif.pages if isinstance(p, tifffile.TiffPage)], path)
    return _Planes(data, axes, page)


def _check_kind(tif: tifffile.TiffFile, series: tifffile.TiffPageSeries, path: Path) -> None:
    """Raise StackError where tifffile fell back to a plain row of pages: the header is broken or promises too much."""
    if tif.is_ome and series.kind not in ("ome", "mmstack"):
        raise StackError(f"{path}: its OME-XML does not describe its pages")
    if tif.is_imagej and not tif.is_ome and series.kind not in ("imagej", "mmstack"):
        raise StackError(f"{path}: truncated: its ImageJ header promises more planes than the file holds")


def _check_series(tif: tifffile.TiffFile, series: tifffile.TiffPageSeries, path: Path) -> str:
    """The letters of a series' axes. Raises StackError where its pixels are no greyscale stack, or are missing."""
    page, axes = series.keyframe, series.get_axes(squeeze=False)
    if _is_array_stored_as_colour(series):
        axes = axes.replace("S", "Q")
    else:
        check_grey(page, path)
    if page.dtype is None or page.dtype.kind not in "iuf":
        raise StackError(f"{path}: pixels are {page.dtype}, a stack holds integers or floats")
    shape = tuple(series.get_shape(squeeze=False))
    if 0 in shape:
        raise StackError(f"{path}: is empty, {shape_text(shape)} along {axes}; a stack has at least one pixel")
    check_pixels(tif, series, path)
    return axes


def _is_array_stored_as_colour(series: tifffile.TiffPageSeries) -> bool:
    """Whether the file is an array of floats (..., 3 or 4, y, x), which tifffile stores as RGB planes by default."""
    page = series.keyframe
    planar = page.planarconfig == tifffile.PLANARCONFIG.SEPARATE
    return series.kind == "shaped" and planar and page.dtype is not None and page.dtype.kind == "f"


def _calibrated_scale(data: np.ndarray, calibrated: np.ndarray, bits: int | None, line: StraightLine) -> float:
    """The calibrated value at which the camera is saturated, see `full_scale`."""
    ends = line.of(np.array([0, full_scale(data, bits)], data.dtype))
    known = float(ends.max())
    return min(known, full_scale(calibrated)) if calibrated.dtype.kind in "iu" else known


def _write(path: Path, stack: Stack, compression: str | None) -> None:
    """Write an OME-TIFF whose C axis is the prism and whose Z axis is the focus."""
    dy, dx = stack.pixel_size or (None, None)
    # Fiji's Bio-Formats shows the image's name above each plane, and no channel's
    named = stack.names[0] if len(stack.names) == 1 else Path(stack.source).name.partition(".")[0]
    metadata: dict[str, object] = {"axes": "CZYX", "Name": _as_xml(named)}
    for axis, length in zip("ZYX", (stack.focus_step, dy, dx), strict=True):
        if length is not None:
            metadata |= {f"PhysicalSize{axis}": float(length), f"PhysicalSize{axis}Unit": "µm"}
    if stack.bits is not None:
        metadata["SignificantBits"] = stack.bits
    if stack.names:
        metadata["Channel"] = {"Name": [_as_xml(name) for name in stack.names]}
    resolution = {}
    if dy is not None and dx is not None and 1e4 / min(dy, dx) <= _MOST_PER_CENTIMETRE:
        # for readers without OME, plain ImageJ among them
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


def _as_xml(name: str) -> str:
    """A name, such as a file's, with a question mark for each sign that no XML can hold."""
    return _NOT_XML.sub("?", name)


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


TIFF = Format(
    "TIFF", (".tif", ".tiff", ".tf2", ".tf8", ".btf"), _read, _write, _OME_DTYPES, _read_series, setup_in_tiff
)
