"""OME-Zarr: a folder of chunks, in version 0.4 (Zarr 2) or 0.5 (Zarr 3), by the package zarr.

https://ngff.openmicroscopy.org. An image is a group whose attributes tell the axes and the scale of an array for each
resolution; the first is the finest. bioformats2raw puts several images, numbered from 0, into one group.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from torchdic.errors import StackError
from torchdic.files.arrangement.axes import arrange
from torchdic.files.described.units import micrometres
from torchdic.files.extras.package import chosen, package
from torchdic.files.format import Format, Stack

Version = Literal["0.4", "0.5"]

# Files of which what Zarr has written has one.
_MARKS = ("zarr.json", ".zgroup", ".zattrs", ".zarray")

# The axes of images before version 0.3, which don't name them.
_USUAL = "TCZYX"


def is_zarr(path: Path) -> bool:
    """Whether a path is a folder that Zarr has written, whatever its name."""
    return path.is_dir() and any((path / mark).is_file() for mark in _MARKS)


def _read(path: Path) -> Stack:
    return _read_series(path)


def _read_series(path: Path, number: int | None = None) -> Stack:
    """One image of a group; number: which, counted from 0, None for the only one."""
    group = _image(path, number)
    said = _said(group)
    image = said["multiscales"][0]
    finest = image["datasets"][0]
    stored = group[finest["path"]]
    named = image.get("axes") or [{"name": name} for name in _USUAL[-stored.ndim :]]
    axes = [axis if isinstance(axis, Mapping) else {"name": axis} for axis in named]
    letters = "".join(_letter(axis) for axis in axes)
    sizes = _sizes(axes, [image, finest], path)
    data = arrange(np.asarray(stored[...]), letters, path)
    data = np.ascontiguousarray(data, dtype=data.dtype.newbyteorder("="))
    y, x, z = (sizes.get(axis) for axis in "YXZ")
    names = tuple(str(channel.get("label", "")) for channel in said.get("omero", {}).get("channels", ()))
    return Stack(
        data,
        pixel_size=None if y is None or x is None else (y, x),
        focus_step=z,
        names=names if len(names) == len(data) and all(names) else (),
        source=str(path),
    )


def _image(path: Path, number: int | None) -> Any:
    """The group of an image. Raises StackError where a folder holds several and none is chosen, or none."""
    zarr = package("zarr", path, "zarr")
    if not is_zarr(path):
        raise StackError(f"{path}: holds nothing of Zarr's: none of {', '.join(_MARKS)}")
    group = zarr.open(str(path), mode="r")
    if isinstance(group, zarr.Array):
        raise StackError(f"{path}: is an array alone; name the OME-Zarr that holds it, whose attributes say its axes")
    said = _said(group)
    if "multiscales" in said:
        images = [group]
    elif "plate" in said or "well" in said:
        kind = "plate" if "plate" in said else "well"
        raise StackError(f"{path}: is a {kind}; a stack is one image: name one of its folders, such as {path}/A/1/0")
    else:
        numbers = sorted(int(name) for name, _ in group.groups() if name.isdecimal())
        images = [group[str(n)] for n in numbers if "multiscales" in _said(group[str(n)])]
    if not images:
        raise StackError(f"{path}: holds no image of OME-Zarr (its attributes name no multiscales)")
    return chosen(images, number, path, "images")


def _said(group: Any) -> Mapping[str, Any]:
    """What a group's attributes say: from version 0.5 on below `ome`."""
    attributes = group.attrs.asdict()
    return attributes.get("ome", attributes)


def _letter(axis: Mapping[str, Any]) -> str:
    """An axis as tifffile's letter; Q has no name that is known."""
    name = str(axis.get("name", "")).upper()
    return name if name in tuple(_USUAL) else "Q"


def _sizes(
    axes: Sequence[Mapping[str, Any]], levels: Sequence[Mapping[str, Any]], path: Path
) -> dict[str, float | None]:
    """The size of a pixel along each axis in µm, by its letter; None where the file doesn't say.

    levels: parts of the image's attributes whose scales multiply.
    """
    scale = np.ones(len(axes))
    for level in levels:
        for transform in level.get("coordinateTransformations", ()):
            if transform.get("type") == "scale":
                scale = scale * np.asarray(transform["scale"], dtype=float)
    return {
        _letter(axis): micrometres(float(size), str(axis.get("unit") or ""), f"scale along {axis['name']}", path)
        for axis, size in zip(axes, scale, strict=True)
    }


def _writer(version: Version) -> Callable[[Path, Stack, str | None], None]:
    """How a stack is written in a version, plane by plane."""

    def write(path: Path, stack: Stack, compression: str | None) -> None:
        zarr = package("zarr", path, "zarr")
        group = zarr.open_group(str(path), mode="w", zarr_format=2 if version == "0.4" else 3)
        array = group.create_array(
            "0",
            shape=stack.data.shape,
            dtype=stack.data.dtype,
            chunks=(1, 1, *stack.data.shape[2:]),
            compressors=_compressors(zarr, version, compression, path),
            chunk_key_encoding={"name": "v2" if version == "0.4" else "default", "separator": "/"},
            dimension_names=None if version == "0.4" else ["c", "z", "y", "x"],
        )
        for prism, planes in enumerate(stack.data):
            for place, plane in enumerate(planes):
                array[prism, place] = plane
        said = _describe(stack)
        group.attrs.update(_of_version(said, version))

    return write


def _describe(stack: Stack) -> dict[str, Any]:
    """A stack's attributes."""
    lengths = (stack.focus_step, *(stack.pixel_size or (None, None)))
    space = [
        {"name": name, "type": "space"} | ({} if length is None else {"unit": "micrometer"})
        for name, length in zip("zyx", lengths, strict=True)
    ]
    scale = [1.0, *(1.0 if length is None else float(length) for length in lengths)]
    image = {
        "name": stack.names[0] if len(stack.names) == 1 else "stack",
        "axes": [{"name": "c", "type": "channel"}, *space],
        "datasets": [{"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}],
    }
    if not stack.names:
        return {"multiscales": [image]}
    low, high = float(stack.data.min()), float(stack.data.max())
    window = {"min": low, "max": high, "start": low, "end": high}
    channels = [{"label": name, "color": "FFFFFF", "window": window, "active": True} for name in stack.names]
    return {"multiscales": [image], "omero": {"channels": channels}}


def _of_version(said: dict[str, Any], version: Version) -> dict[str, Any]:
    if version == "0.5":
        return {"ome": {"version": version, **said}}
    (image,) = said["multiscales"]
    return {**said, "multiscales": [{"version": version, **image}]}


def _compressors(zarr: ModuleType, version: Version, compression: str | None, path: Path) -> Any:
    if compression is None:
        return None
    if compression != "zlib":
        raise StackError(f"{path}: compression {compression!r}: OME-Zarr is written with 'zlib', or as it is")
    if version == "0.4":
        return package("numcodecs", path, "zarr").Zlib()
    return zarr.codecs.GzipCodec()


_INTEGERS = tuple(f"{kind}{bits}" for kind in ("uint", "int") for bits in (8, 16, 32, 64))


def _format(suffix: str, version: Version) -> Format:
    dtypes = (*_INTEGERS, "float32", "float64")
    return Format("OME-Zarr", (suffix,), _read, _writer(version), dtypes, _read_series, folder=True)


# The suffix tells the version that is written; both are read by either.
OME_ZARR_4, OME_ZARR_5 = _format(".zarr", "0.4"), _format(".ome.zarr", "0.5")
