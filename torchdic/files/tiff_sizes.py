"""Pixel size, focus step and prism names of a TIFF, from its OME-XML or its ImageJ description."""

import math
import warnings
from pathlib import Path
from xml.etree import ElementTree

import tifffile

from torchdic.errors import StackError, StackWarning

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

_UNCALIBRATED = ("", "pixel", "pixels", "reference frame")  # a size in one of these is no length

_RESOLUTION_UNITS = {2: "inch", 3: "cm"}  # TIFF 6.0, tag 296

Sizes = tuple[float | None, float | None, float | None]  # focus step and pixel size (z, y, x) in µm


def sizes_and_names(tif: tifffile.TiffFile, path: Path) -> tuple[Sizes, tuple[str, ...]]:
    """Focus step and pixel size (z, y, x) in µm, and the prisms' names.

    A size is None and the names are () where the file does not say. Raises StackError for OME-XML that cannot be
    parsed or that spreads the stack over several files.
    """
    if tif.is_ome:
        return _of_ome(tif, path)
    if tif.is_imagej:
        return _of_imagej(tif, path), ()
    return (None, None, None), ()


def _of_ome(tif: tifffile.TiffFile, path: Path) -> tuple[Sizes, tuple[str, ...]]:
    try:
        root = ElementTree.fromstring(tif.ome_metadata or "")
    except ElementTree.ParseError as error:
        raise StackError(f"{path}: its OME-XML cannot be parsed: {error}") from error
    _check_one_file(root, path)
    pixels = root.find(".//{*}Image/{*}Pixels")
    if pixels is None:
        raise StackError(f"{path}: its OME-XML describes no image")
    sizes = [
        _micrometres(float(pixels.get(f"PhysicalSize{axis}", "nan")), pixels.get(f"PhysicalSize{axis}Unit", "µm"), path)
        for axis in "ZYX"
    ]
    names = tuple(channel.get("Name", "") for channel in pixels.findall("{*}Channel"))
    return (sizes[0], sizes[1], sizes[2]), names if any(names) else ()


def _check_one_file(root: ElementTree.Element, path: Path) -> None:
    """Raise StackError where the OME-XML says that planes lie in other files."""
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


def _of_imagej(tif: tifffile.TiffFile, path: Path) -> Sizes:
    """From ImageJ's description and the page's resolution."""
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
    """A length in µm; None where it is absent (NaN), has no unit of length or is not above 0."""
    if math.isnan(length) or unit.strip().lower() in _UNCALIBRATED:
        return None
    factor = _MICROMETRES.get(unit.strip(), _MICROMETRES.get(unit.strip().lower()))
    if factor is None:
        warnings.warn(f"{path}: a size of {length:g} {unit!r} is in no known unit of length; ignored", StackWarning, 2)
        return None
    if not (math.isfinite(length) and length > 0):
        warnings.warn(f"{path}: a size of {length:g} {unit} is not above 0; ignored", StackWarning, 2)
        return None
    return length * factor
