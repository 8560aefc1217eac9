"""Stacks and volumes as TIFF: read with their axes and sizes, written as OME-TIFF, whole or not at all."""

import logging
import math
import os
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NoReturn
from xml.etree import ElementTree

import numpy as np
import tifffile
from jaxtyping import Shaped

from torchdic.errors import StackError, StackWarning
from torchdic.files.stack import Stack
from torchdic.files.whole import written_whole

# OME's units (schema 2016-06) and the spellings of ImageJ and its plugins; µ has two code points
_MICROMETRES = {
    "pm": 1e-6,
    "Å": 1e-4,
    "nm": 1e-3,
    "nanometer": 1e-3,
    "µm": 1.0,
    "μm": 1.0,
    "um": 1.0,
    "micron": 1.0,
    "microns": 1.0,
    "micrometer": 1.0,
    "mm": 1e3,
    "millimeter": 1e3,
    "cm": 1e4,
    "in": 2.54e4,
    "inch": 2.54e4,
    "m": 1e6,
}

_UNCALIBRATED = ("", "pixel", "pixels", "reference frame")  # a size in these says nothing about length

_RESOLUTION_UNITS = {2: "inch", 3: "cm"}  # TIFF 6.0, tag 296

# TIFF 6.0, BigTIFF: bytes that a value of each type takes
_TYPE_BYTES = {16: 8, 17: 8, 18: 8, **dict(enumerate((1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4), start=1))}

_MAGIC = {b"II*\0": ("<", False), b"MM\0*": (">", False), b"II+\0": ("<", True), b"MM\0+": (">", True)}

_GREY = 1  # PhotometricInterpretation MINISBLACK: the value grows with the light

_PHOTOMETRIC = {0: "0 is white", 2: "RGB", 3: "a colour palette", 5: "CMYK", 6: "YCbCr", 8: "CIELab"}

_OME_DTYPES = ("int8", "int16", "int32", "uint8", "uint16", "uint32", "float32", "float64")


def _read(path: Path) -> Stack:
    """The stack in a TIFF of sound structure."""
    with tifffile.TiffFile(path) as tif:
        sizes, names = (None, None, None), ()
        if tif.is_ome:
            sizes, names = _ome_metadata(tif, path)
        elif tif.is_imagej:
            sizes = _imagej_sizes(tif, path)
        series = _only_series(tif, path)
        page = series.keyframe
        if not _is_array_stored_as_colour(series):
            _check_grey(page, path)
        if page.dtype is None or page.dtype.kind not in "iuf":
            raise StackError(f"{path}: pixels are {page.dtype}, a stack holds integers or floats")
        shape = tuple(series.get_shape(squeeze=False))
        axes = series.get_axes(squeeze=False)
        if _is_array_stored_as_colour(series):
            axes = axes.replace("S", "Q")
        if 0 in shape:
            raise StackError(f"{path}: is empty, {_by(shape)} along {axes}; a stack has at least one pixel")
        _check_pixels_present(tif, series, path)
        data = series.asarray(squeeze=False)
        if data.shape != shape:
            raise StackError(f"{path}: holds {_by(data.shape)} pixels, its header says {_by(shape)} along {axes}")
        data = _arrange(data, axes, path)
        bits = page.bitspersample if isinstance(page.bitspersample, int) else None
    data = np.ascontiguousarray(data, dtype=data.dtype.newbyteorder("="))
    focus_step, dy, dx = sizes
    pixel_size = None if dy is None or dx is None else (dy, dx)
    return Stack(data, pixel_size, focus_step, bits, names if len(names) == len(data) else (), str(path))


def _only_series(tif: tifffile.TiffFile, path: Path) -> tifffile.TiffPageSeries:
    """The one series of images in the file, arranged as its header says."""
    if not tif.series:
        raise StackError(f"{path}: holds no images")
    if len(tif.series) > 1:
        shapes = ", ".join(_by(series.shape) for series in tif.series)
        raise StackError(f"{path}: holds {len(tif.series)} unequal images ({shapes}); a stack is one")
    series = tif.series[0]
    # tifffile falls back to a plain row of pages where the header is broken or promises more than is there
    if tif.is_ome and series.kind not in ("ome", "mmstack"):
        raise StackError(f"{path}: its OME-XML does not describe its pages")
    if tif.is_imagej and not tif.is_ome and series.kind not in ("imagej", "mmstack"):
        raise StackError(f"{path}: truncated: its ImageJ header promises more planes than the file holds")
    return series


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
    """Whether tifffile stored floats (..., 3 or 4, y, x) as RGB planes, as it does if not told otherwise."""
    page = series.keyframe
    planar = page.planarconfig == tifffile.PLANARCONFIG.SEPARATE
    return series.kind == "shaped" and planar and page.dtype is not None and page.dtype.kind == "f"


def _arrange(data: np.ndarray, axes: str, path: Path) -> Shaped[np.ndarray, "prism focus y x"]:
    """The array as (prism, focus, y, x), from tifffile's letters: Q and I are axes without a name."""
    described = f"{axes}: {_by(data.shape)}"
    if axes.count("Y") != 1 or axes.count("X") != 1:
        raise StackError(f"{path}: is no image ({described}); a stack has y and x")
    for axis, length in zip(axes, data.shape, strict=True):
        if axis == "S" and length > 1:
            raise StackError(f"{path}: is a colour image, {length} samples per pixel; a stack is grey")
        if axis == "T" and length > 1:
            raise StackError(f"{path}: has {length} time points; a stack's axes are (prism, focus, y, x)")
    nameless = [i for i, axis in enumerate(axes) if axis in "QI"]
    free = [axis for axis in "CZ" if axis not in axes or data.shape[axes.index(axis)] == 1]
    while len(nameless) > len(free) and data.shape[nameless[0]] == 1:
        nameless.pop(0)
    others = [axis for axis, n in zip(axes, data.shape, strict=True) if axis not in "CZYXSTQI" and n > 1]
    if others or len(nameless) > len(free):
        raise StackError(f"{path}: has more dimensions ({described}) than a stack's (prism, focus, y, x)")
    source = {axis: axes.index(axis) for axis in "CZYX" if axis in axes}
    source |= dict(zip(free[len(free) - len(nameless) :], nameless, strict=True))
    order = [source[axis] for axis in "CZYX" if axis in source]
    rest = [i for i in range(data.ndim) if i not in order]
    data = data.transpose(*rest, *order)
    shape = dict(zip([axis for axis in "CZYX" if axis in source], data.shape[len(rest) :], strict=True))
    return data.reshape([shape.get(axis, 1) for axis in "CZYX"])


def _ome_metadata(
    tif: tifffile.TiffFile, path: Path
) -> tuple[tuple[float | None, float | None, float | None], tuple[str, ...]]:
    """Focus step and pixel size (z, y, x) in µm, and the channels' names, from the OME-XML."""
    try:
        root = ElementTree.fromstring(tif.ome_metadata or "")
    except ElementTree.ParseError as error:
        raise StackError(f"{path}: its OME-XML cannot be parsed: {error}") from error
    if root.find("{*}BinaryOnly") is not None:
        raise StackError(f"{path}: is one part of a multi-file OME-TIFF; a stack is one file")
    own = root.get("UUID")
    parts = root.findall(".//{*}TiffData/{*}UUID")
    foreign = {
        uuid.get("FileName", "?")
        for uuid in parts
        if (uuid.text != own if own else uuid.get("FileName", path.name) != path.name)
    }
    if foreign:
        shown = ", ".join(sorted(foreign)[:3])
        raise StackError(f"{path}: its planes lie in {len(foreign)} other files ({shown}); a stack is one file")
    pixels = root.find(".//{*}Image/{*}Pixels")
    if pixels is None:
        raise StackError(f"{path}: its OME-XML describes no image")
    sizes = [
        _micrometres(float(pixels.get(f"PhysicalSize{axis}", "nan")), pixels.get(f"PhysicalSize{axis}Unit", "µm"), path)
        for axis in "ZYX"
    ]
    names = tuple(channel.get("Name", "") for channel in pixels.findall("{*}Channel"))
    return (sizes[0], sizes[1], sizes[2]), names if any(names) else ()


def _imagej_sizes(tif: tifffile.TiffFile, path: Path) -> tuple[float | None, float | None, float | None]:
    """Focus step and pixel size (z, y, x) in µm, from ImageJ's description and the page's resolution."""
    meta = tif.imagej_metadata or {}
    tags = tif.pages.first.tags
    unit = meta.get("unit")
    if unit is None:
        unit = _RESOLUTION_UNITS.get(int(tags.valueof("ResolutionUnit", default=1)), "")
    unit = str(unit).replace("\\u00B5", "µ").replace("\\u00b5", "µ")  # ImageJ escapes what is not ASCII

    def pixel(tag: str) -> float:
        numerator, denominator = tags.valueof(tag, default=(0, 0))  # pixels per unit, as a fraction
        return denominator / numerator if numerator else math.nan

    lengths = (abs(float(meta.get("spacing", "nan"))), pixel("YResolution"), pixel("XResolution"))
    dz, dy, dx = (_micrometres(length, unit, path) for length in lengths)
    return dz, dy, dx


def _micrometres(length: float, unit: str, path: Path) -> float | None:
    """A length in µm; None where it is absent (NaN), no length or without a unit of length."""
    if math.isnan(length) or unit.strip().lower() in _UNCALIBRATED:
        return None
    factor = _MICROMETRES.get(unit.strip(), _MICROMETRES.get(unit.strip().lower()))
    if factor is None:
        warnings.warn(f"{path}: a size of {length:g} {unit!r} is in no known length; left aside", StackWarning, 2)
        return None
    if not (math.isfinite(length) and length > 0):
        warnings.warn(f"{path}: a size of {length:g} {unit} is not above 0; ignored", StackWarning, 2)
        return None
    return length * factor


def _check_structure(path: Path) -> None:
    """Follow the chain of pages through the file: where it breaks off, tifffile stops silently."""
    try:
        with path.open("rb") as file:
            _check_chain(file, path)
    except FileNotFoundError as error:
        raise StackError(f"{path}: no such file") from error
    except IsADirectoryError as error:
        raise StackError(f"{path}: is a folder, not a TIFF") from error
    except OSError as error:
        raise StackError(f"{path}: cannot be opened: {error.strerror or error}") from error


def _check_chain(file: BinaryIO, path: Path) -> None:
    size = os.fstat(file.fileno()).st_size
    if size == 0:
        raise StackError(f"{path}: is empty, 0 bytes")
    head = file.read(4)
    if head not in _MAGIC:
        raise StackError(f"{path}: is no TIFF: it starts with {head!r}, a TIFF with II or MM and 42 or 43")
    order, big = _MAGIC[head]
    pointer, number, entry, inline = ("Q", "Q", "HHQ8s", 8) if big else ("I", "H", "HHI4s", 4)

    def read(offset: int, form: str, times: int = 1) -> bytes:
        length = struct.calcsize(order + form) * times
        if offset + length > size:
            _truncated(path, offset + length, size)
        file.seek(offset)
        return file.read(length)

    def whole(offset: int, form: str) -> int:
        return struct.unpack(order + form, read(offset, form))[0]

    page = whole(8 if big else 4, pointer)
    if page == 0:
        raise StackError(f"{path}: holds no pages; a stack has at least one")
    seen: set[int] = set()
    while page:
        if page in seen:
            raise StackError(f"{path}: its chain of pages runs in a circle after {len(seen)}")
        seen.add(page)
        tags = whole(page, number)
        first = page + struct.calcsize(order + number)
        for _, kind, count, value in struct.iter_unpack(order + entry, read(first, entry, tags)):
            length = _TYPE_BYTES.get(kind, 0) * count
            if length > inline:
                end = struct.unpack(order + pointer, value)[0] + length
                if end > size:
                    _truncated(path, end, size)
        page = whole(first + tags * struct.calcsize(order + entry), pointer)


def _check_pixels_present(tif: tifffile.TiffFile, series: tifffile.TiffPageSeries, path: Path) -> None:
    """Every strip and tile lies inside the file: tifffile fills missing ones with zeros."""
    size = tif.filehandle.size
    if series.dataoffset is not None:
        end = series.dataoffset + math.prod(series.get_shape(squeeze=False)) * series.dtype.itemsize
        if end > size:
            _truncated(path, end, size)
    for page in tif.pages:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            if offset == 0 or count == 0:
                raise StackError(f"{path}: page {page.index} misses a part of its pixels")
            if offset + count > size:
                _truncated(path, offset + count, size)
    if series.dataoffset is None and any(page is None for page in series):
        missing = sum(page is None for page in series)
        raise StackError(f"{path}: {missing} of {len(series)} planes that its OME-XML lists are missing")


def _truncated(path: Path, end: int, size: int) -> NoReturn:
    raise StackError(f"{path}: truncated: its contents reach to byte {end}, the file ends at byte {size}")


def _check_finite(data: np.ndarray, path: Path) -> None:
    if data.dtype.kind != "f":
        return
    bad = data.size - int(np.isfinite(data).sum())
    if bad:
        nan = int(np.isnan(data).sum())
        raise StackError(f"{path}: {bad} of {data.size} pixels are not finite ({nan} NaN, {bad - nan} infinite)")


def _write_ome(
    path: Path,
    array: Shaped[np.ndarray, "c z y x"],
    sizes: tuple[float | None, float | None, float | None],
    names: tuple[str, ...],
    compression: str | None,
) -> None:
    """Write (c, z, y, x), sizes (z, y, x) in µm, beside its final place; then move it there in one step."""
    if array.dtype.name not in _OME_DTYPES:
        raise StackError(f"{path}: pixels are {array.dtype}, OME-TIFF holds {', '.join(_OME_DTYPES)}")
    if array.size == 0:
        raise StackError(f"{path}: would be empty, {_by(array.shape)}; a stack has at least one pixel")
    _check_finite(array, path)
    metadata: dict[str, object] = {"axes": "CZYX"}
    for axis, length in zip("ZYX", sizes, strict=True):
        if length is not None:
            if not (math.isfinite(length) and length > 0):
                raise StackError(f"{path}: a size of {length} µm along {axis.lower()} must be above 0")
            metadata |= {f"PhysicalSize{axis}": float(length), f"PhysicalSize{axis}Unit": "µm"}
    if names:
        metadata["Channel"] = {"Name": list(names)}
    resolution = {}
    if sizes[1] is not None and sizes[2] is not None:  # for readers without OME, plain ImageJ among them
        resolution = {"resolution": (1e4 / sizes[2], 1e4 / sizes[1]), "resolutionunit": "CENTIMETER"}
    try:
        with written_whole(path) as partial, _tifffile_logs_as_debug():
            tifffile.imwrite(
                partial,
                array,
                ome=True,
                photometric="minisblack",
                metadata=metadata,
                compression=compression,
                **resolution,
            )
    except OSError as error:
        raise StackError(f"{path}: cannot be written: {error.strerror or error}") from error


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


def _by(shape: Sequence[int]) -> str:
    return " × ".join(str(n) for n in shape)
