"""ImageJ's description: sizes with a unit for each axis, and the calibration of the pixels' values."""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from torchdic.errors import StackWarning
from torchdic.files.described.ome import Sizes
from torchdic.files.described.units import micrometres

_RESOLUTION_UNITS = {2: "inch", 3: "cm"}  # TIFF 6.0, tag 296

_STRAIGHT_LINE = 0  # ImageJ's Calibration.STRAIGHT_LINE


def imagej_sizes(tif: tifffile.TiffFile, path: Path) -> Sizes:
    """Focus step and pixel size (z, y, x) in µm, from the description and the page's resolution."""
    meta = tif.imagej_metadata or {}
    tags = tif.pages.first.tags
    unit = meta.get("unit")
    if unit is None:
        unit = _RESOLUTION_UNITS.get(int(tags.valueof("ResolutionUnit", default=1)), "")
    units = (meta.get("zunit", unit), meta.get("yunit", unit), unit)

    def pixel(tag: str) -> float:
        numerator, denominator = tags.valueof(tag, default=(0, 0))  # pixels per unit, as a fraction
        return denominator / numerator if numerator else math.nan

    spacing = meta.get("spacing")
    if isinstance(spacing, int | float):
        spacing = abs(float(spacing))
    lengths = {"spacing": spacing, "pixel height": pixel("YResolution"), "pixel width": pixel("XResolution")}
    z, y, x = (micrometres(lengths[name], str(unit), name, path) for name, unit in zip(lengths, units, strict=True))
    return z, y, x


@dataclass(frozen=True)
class StraightLine:
    """A calibration of pixel values: value = start + slope·number, of the unsigned number that ImageJ stores."""

    start: float
    slope: float

    def of(self, data: np.ndarray) -> np.ndarray:
        """Calibrated values: whole numbers where the line keeps them whole, else float64."""
        start = self.start
        if data.dtype.kind == "i":  # ImageJ reads signed numbers as unsigned ones, shifted by half their range
            start -= self.slope * float(np.iinfo(data.dtype).min)
        if data.dtype.kind == "f" or self.slope != 1 or not start.is_integer():
            return start + self.slope * data.astype(np.float64)
        return data if start == 0 else _narrow(data.astype(np.int64) + int(start))


def calibration(tif: tifffile.TiffFile, path: Path) -> StraightLine | None:
    """The calibration that ImageJ's description gives the pixels' values; None for none.

    Warns StackWarning of one that is applied, and of one that is no straight line, which is not.
    """
    meta = tif.imagej_metadata or {}
    start, slope, *higher = (_number(meta.get(f"c{i}")) for i in range(6))
    if start is None or slope is None:
        return None
    curved = any(higher)
    if int(meta.get("cf", _STRAIGHT_LINE)) != _STRAIGHT_LINE or curved or slope == 0:
        warnings.warn(
            f"{path}: ImageJ's calibration of its values is no straight line; its pixels are taken as stored",
            StackWarning,
            stacklevel=4,
        )
        return None
    line = StraightLine(start, slope)
    if (line.start, line.slope) == (0.0, 1.0):
        return None
    warnings.warn(
        f"{path}: ImageJ's calibration of its values is applied: c0 = {line.start:g}, c1 = {line.slope:g}",
        StackWarning,
        stacklevel=4,
    )
    return line


def _number(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def _narrow(data: np.ndarray) -> np.ndarray:
    """Whole numbers in the smallest of the usual dtypes that holds them all."""
    low, high = int(data.min()), int(data.max())
    kinds = (np.uint8, np.uint16, np.int16, np.int32)
    return data.astype(next((k for k in kinds if np.iinfo(k).min <= low and high <= np.iinfo(k).max), np.int64))
