"""Nikon's ND2, read by the package nd2."""

from pathlib import Path
from typing import Any

import numpy as np

from torchdic.files.arrangement.axes import arrange, place_axis
from torchdic.files.described.setup import StatedSetup
from torchdic.files.extras.package import chosen, package
from torchdic.files.format import Format, Stack


def _read(path: Path) -> Stack:
    return _read_series(path)


def _read_series(path: Path, number: int | None = None) -> Stack:
    """One position of a file; number: which, counted from 0, None for the only one."""
    with package("nd2", path).ND2File(path) as file:
        data, axes = np.asarray(file.asarray()), "".join(file.sizes)
        along = place_axis(data.shape, axes)
        if number is not None:
            place = chosen(range(1 if along is None else data.shape[along]), number, path, "positions")
            if along is not None:
                data, axes = data.take(place, along), axes[:along] + axes[along + 1 :]
        setup, sizes = _setup(file), _sizes(file)
        names = tuple(str(channel.channel.name) for channel in _channels(file))
    data = np.ascontiguousarray(arrange(data, axes, path))
    (x, y, z), planes = sizes, data.shape[1]
    return Stack(
        data,
        pixel_size=None if x is None or y is None else (y, x),
        focus_step=z if planes > 1 else None,
        bits=setup.bits,
        names=names if len(names) == len(data) else (),
        source=str(path),
    )


def setup_in_nd2(path: Path) -> StatedSetup:
    """What an ND2 file says of its microscope."""
    with package("nd2", path).ND2File(path) as file:
        return _setup(file)


def _sizes(file: Any) -> list[float | None]:
    """The size of a voxel along x, y and z in µm, where the file was calibrated: it says 1 where it wasn't."""
    channels = _channels(file)
    if not channels:
        return [None, None, None]
    volume = channels[0].volume
    pairs = zip(volume.axesCalibration, volume.axesCalibrated, strict=True)
    return [float(size) if calibrated and size > 0 else None for size, calibrated in pairs]


def _channels(file: Any) -> list[Any]:
    return list(getattr(file.metadata, "channels", None) or ())


def _setup(file: Any) -> StatedSetup:
    channels = _channels(file)
    lens = channels[0].microscope if channels else None
    wave = channels[0].channel.emissionLambdaNm if channels else None
    bits = getattr(file.attributes, "bitsPerComponentSignificant", None)
    return StatedSetup(
        wavelength=float(wave) / 1000 if wave else None,
        na=_positive(getattr(lens, "objectiveNumericalAperture", None)),
        immersion=_positive(getattr(lens, "immersionRefractiveIndex", None)),
        objective=getattr(lens, "objectiveName", None) or None,
        bits=int(bits) if bits else None,
    )


def _positive(value: Any) -> float | None:
    return float(value) if value and value > 0 else None


ND2 = Format("ND2", (".nd2",), _read, read_series=_read_series, setup=setup_in_nd2)
