"""Zeiss's CZI, read by the package czifile."""

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchdic.errors import StackError
from torchdic.files.arrangement.axes import arrange
from torchdic.files.described.setup import IMMERSIONS, StatedSetup
from torchdic.files.extras.package import package
from torchdic.files.format import Format, Stack

_METRE = 1e6  # CZI's scalings are in metres


def _read(path: Path) -> Stack:
    return _read_series(path)


def _read_series(path: Path, number: int | None = None) -> Stack:
    """One scene of a file; number: which, counted from 0, None for the only one."""
    with package("czifile", path).CziFile(path) as file:
        held = len(file.scenes)
        if number is None and held > 1:
            raise StackError(
                f"{path}: holds {held} scenes; a stack is one: series = 0 … {held - 1} in [data] takes one"
            )
        if not 0 <= (number or 0) < held:
            raise StackError(f"{path}: series {number} must be from 0 to {held - 1}: the file holds {held}")
        scene = list(file.scenes.values())[number or 0]
        data, axes = np.asarray(scene.asarray()), "".join(scene.dims)
        root = ElementTree.fromstring(file.metadata())
    data = np.ascontiguousarray(arrange(data, axes, path))
    z, y, x = (_scaling(root, axis) for axis in "ZYX")
    return Stack(
        data,
        pixel_size=(y, x) if y and x else None,
        focus_step=z if data.shape[1] > 1 else None,
        bits=_setup(root).bits,
        source=str(path),
    )


def setup_in_czi(path: Path) -> StatedSetup:
    """What a CZI file says of its microscope."""
    with package("czifile", path).CziFile(path) as file:
        return _setup(ElementTree.fromstring(file.metadata()))


def _scaling(root: ElementTree.Element, axis: str) -> float | None:
    length = _number(root, f".//Scaling/Items/Distance[@Id='{axis}']/Value")
    return None if length is None else length * _METRE


def _setup(root: ElementTree.Element) -> StatedSetup:
    lens = ".//Information/Instrument/Objectives/Objective"
    channel = ".//Information/Image/Dimensions/Channels/Channel"
    wave, bits = _number(root, f"{channel}/EmissionWavelength"), _number(root, ".//Information/Image/ComponentBitCount")
    settings = _number(root, ".//Information/Image/ObjectiveSettings/RefractiveIndex")
    found: Any = root.find(lens)
    return StatedSetup(
        wavelength=None if wave is None else wave / 1000,
        na=_number(root, f"{lens}/LensNA"),
        immersion=settings or IMMERSIONS.get((root.findtext(f"{lens}/Immersion") or "").lower()),
        objective=None if found is None else found.get("Name"),
        bits=None if bits is None else int(bits),
    )


def _number(root: ElementTree.Element, place: str) -> float | None:
    try:
        number = float(root.findtext(place) or "")
    except ValueError:
        return None
    return number if number > 0 else None


CZI = Format("CZI", (".czi",), _read, read_series=_read_series, setup=setup_in_czi)
