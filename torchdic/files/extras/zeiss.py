"""Zeiss's CZI, read by Zeiss's own package pylibCZIrw."""

from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import numpy as np

from torchdic.errors import StackError
from torchdic.files.arrangement.axes import arrange
from torchdic.files.described.setup import IMMERSIONS, StatedSetup
from torchdic.files.extras.package import chosen, package
from torchdic.files.format import Format, Stack

_METRE = 1e6  # CZI's scalings are in metres

# CZI's other axes are phases, views and the like, which no letter of tifffile's stands for.
_NO_LETTER = "U"


def _read(path: Path) -> Stack:
    return _read_series(path)


def _read_series(path: Path, number: int | None = None) -> Stack:
    """One scene of a file; number: which, counted from 0, None for the only one."""
    with _czi(path).open_czi(str(path)) as file:
        scenes = file.scenes_bounding_rectangle_no_pyramid
        which = chosen(sorted(scenes) or [None], number, path, "scenes")
        root = ElementTree.fromstring(file.raw_metadata)
        data, axes = _planes(file, which, path)
    data = np.ascontiguousarray(arrange(data, axes, path))
    z, y, x = (_scaling(root, axis) for axis in "ZYX")
    channels = root.findall(".//Information/Image/Dimensions/Channels/Channel")
    names = tuple(channel.get("Name", "") for channel in channels)
    return Stack(
        data,
        pixel_size=(y, x) if y and x else None,
        focus_step=z if data.shape[1] > 1 else None,
        bits=_setup(root).bits,
        names=names if len(names) == len(data) and all(names) else (),
        source=str(path),
    )


def _planes(file: Any, scene: int | None, path: Path) -> tuple[np.ndarray, str]:
    """All planes of a scene, each stitched from its tiles, and the letters of their axes.

    Raises StackError where channels differ in their pixels, and where a plane was never written.
    """
    counts = {axis: end for axis, (_, end) in file.total_bounding_box_no_pyramid.items() if axis not in "XY"}
    kinds = sorted(set(file.pixel_types.values()))
    if len(kinds) > 1:
        raise StackError(f"{path}: its channels have pixels of several kinds ({', '.join(kinds)}); a stack has one")
    everywhere, scenes = file.total_bounding_rectangle_no_pyramid, file.scenes_bounding_rectangle_no_pyramid
    rectangle = everywhere if scene is None else scenes[scene]
    planes = []
    for place in product(*map(range, counts.values())):
        plane = {axis: index for axis, index in zip(counts, place, strict=True) if counts[axis] > 1}
        if not _is_there(file, plane, rectangle):
            where = ", ".join(f"{axis} {index}" for axis, index in plane.items())
            raise StackError(f"{path}: its plane {where}, counted from 0, is missing")
        planes.append(file.read(rectangle, plane, scene))
    data = np.stack(planes).reshape(*counts.values(), *planes[0].shape)
    return data, "".join(axis if axis in "TZC" else _NO_LETTER for axis in counts) + "YXS"


def _is_there(file: Any, plane: dict[str, int], rectangle: Any) -> bool:
    """Whether any pixel of a plane was written: what wasn't is read as 0."""
    found: list[int] = []

    def note(index: int, _: object) -> bool:
        found.append(index)
        return False  # one is enough

    file.enumerate_subblocks_subset(note, plane, rectangle, True)
    return bool(found)


def setup_in_czi(path: Path) -> StatedSetup:
    """What a CZI file says of its microscope."""
    with _czi(path).open_czi(str(path)) as file:
        return _setup(ElementTree.fromstring(file.raw_metadata))


def _czi(path: Path) -> ModuleType:
    return package("pylibCZIrw.czi", path)


def _scaling(root: ElementTree.Element, axis: str) -> float | None:
    length = _number(root, f".//Scaling/Items/Distance[@Id='{axis}']/Value")
    return None if length is None else float(f"{length * _METRE:.12g}")  # 1e-7 m are 0.1 µm, not 0.0999…


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
