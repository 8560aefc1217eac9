"""Leica's LIF, read by the package liffile."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchdic.errors import StackError
from torchdic.files.arrangement.axes import arrange
from torchdic.files.described.setup import IMMERSIONS, StatedSetup
from torchdic.files.described.units import micrometres
from torchdic.files.extras.package import chosen, package
from torchdic.files.format import Format, Stack

_DESCRIPTION = "./Data/Image/ImageDescription"

# Leica's numbers of the axes that have a size in µm.
_AXES = {"1": "X", "2": "Y", "3": "Z"}

_KNOWN = "TZCYXS"


def _read(path: Path) -> Stack:
    return _read_series(path)


def _read_series(path: Path, number: int | None = None) -> Stack:
    """One image of a file; number: which, counted from 0, None for the only one."""
    with package("liffile", path).LifFile(path) as file:
        image = chosen(_images(file, path), number, path, "images")
        others = [f"{axis} ({count})" for axis, count in image.sizes.items() if axis not in _KNOWN and count > 1]
        if others or image.is_flim:
            kind = "lifetimes" if image.is_flim else f"axes of {', '.join(others)} beside T, Z, C, Y and X"
            raise StackError(f"{path}: {image.path} has {kind}; a stack's axes are (prism, focus, y, x)")
        data, axes, root = np.asarray(image.asarray()), "".join(image.dims), image.xml_element
    sizes = _sizes(root, path)
    data = np.ascontiguousarray(arrange(data, axes, path))
    pixel = (sizes.get("Y"), sizes.get("X"))
    return Stack(
        data,
        pixel_size=None if pixel[0] is None or pixel[1] is None else (pixel[0], pixel[1]),
        focus_step=sizes.get("Z"),
        bits=_setup(root).bits,
        source=str(path),
    )


def setup_in_lif(path: Path) -> StatedSetup:
    """What a LIF file says of the microscope of its first image."""
    with package("liffile", path).LifFile(path) as file:
        return _setup(_images(file, path)[0].xml_element)


def _images(file: Any, path: Path) -> list[Any]:
    images = list(file.images)
    if not images:
        raise StackError(f"{path}: holds no images")
    return images


def _sizes(root: ElementTree.Element, path: Path) -> dict[str, float | None]:
    """The size of a pixel in µm along Z, Y and X, where the file says it.

    Length is from the centre of the first pixel to that of the last, below 0 where the stage or the beam ran backwards.
    """
    sizes: dict[str, float | None] = {}
    for axis in root.findall(f"{_DESCRIPTION}/Dimensions/DimensionDescription"):
        name, count = _AXES.get(axis.get("DimID", "")), int(axis.get("NumberOfElements", "1"))
        if name is not None and count > 1:
            length = abs(float(axis.get("Length", "nan"))) / (count - 1)
            sizes[name] = micrometres(length, axis.get("Unit", ""), f"Length along {name}", path)
    return sizes


def _setup(root: ElementTree.Element) -> StatedSetup:
    """What an image's element says: of its first channel, and of the objective in the first settings that name one."""
    channel = root.find(f"{_DESCRIPTION}/Channels/ChannelDescription")
    bits = None if channel is None else _number(channel.get("Resolution"))
    lens = next((part.attrib for part in root.iter() if _number(part.get("NumericalAperture")) is not None), {})
    return StatedSetup(
        na=_number(lens.get("NumericalAperture")),
        immersion=_number(lens.get("RefractionIndex")) or IMMERSIONS.get(lens.get("Immersion", "").lower()),
        objective=lens.get("ObjectiveName"),
        bits=None if bits is None else int(bits),
    )


def _number(text: str | None) -> float | None:
    try:
        number = float(text or "")
    except ValueError:
        return None
    return number if number > 0 else None


LIF = Format("LIF", (".lif",), _read, read_series=_read_series, setup=setup_in_lif)
