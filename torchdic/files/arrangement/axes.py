"""An array with named and nameless axes becomes (prism, focus, y, x)."""

import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from torchdic.errors import StackError, StackWarning
from torchdic.files.arrangement.grey import coloured
from torchdic.files.format import offer_of_series, shape_text

# tifffile's letters: Q and I are axes without a name; P, R and M are places of the stage, or tiles
_NAMELESS, _PLACES = "QI", "PRM"


def place_axis(shape: tuple[int, ...], axes: str) -> int | None:
    """The one axis of places, along which more than one stack lies; None where there is none."""
    found = [i for i, axis in enumerate(axes) if axis in _PLACES and shape[i] > 1]
    return found[0] if len(found) == 1 else None


def arrange(data: np.ndarray, axes: str, path: Path) -> Shaped[np.ndarray, "prism focus y x"]:
    """The array as (prism, focus, y, x).

    axes: tifffile's letter of each axis. Axes without a name become C and Z where these are free, and so does time
    become Z, of which StackWarning warns.
    Raises StackError for an array without y and x, for colours, and for more dimensions than a stack has.
    """
    _check_axes(data.shape, axes, path)
    axes = _time_as_focus(data.shape, axes, path)
    source = _places_of_axes(data.shape, axes, path)
    order = [source[axis] for axis in "CZYX" if axis in source]
    rest = [i for i in range(data.ndim) if i not in order]
    data = data.transpose(*rest, *order)
    shape = dict(zip([axis for axis in "CZYX" if axis in source], data.shape[len(rest) :], strict=True))
    return data.reshape([shape.get(axis, 1) for axis in "CZYX"])


def _check_axes(shape: tuple[int, ...], axes: str, path: Path) -> None:
    """Raise StackError for an array without y and x, and for colours."""
    if axes.count("Y") != 1 or axes.count("X") != 1:
        raise StackError(f"{path}: is no image ({axes}: {shape_text(shape)}); a stack has y and x")
    for axis, length in zip(axes, shape, strict=True):
        if axis == "S" and length > 1:
            raise coloured(path, length)


def _time_as_focus(shape: tuple[int, ...], axes: str, path: Path) -> str:
    """The axes, where time stands for the focus if that has one plane at most. Raises StackError for both."""
    time = next((i for i, axis in enumerate(axes) if axis == "T" and shape[i] > 1), None)
    if time is None:
        return axes
    planes = max((n for axis, n in zip(axes, shape, strict=True) if axis == "Z"), default=1)
    if planes > 1:
        raise StackError(
            f"{path}: has {shape[time]} time points and {planes} focus planes (T and Z); a stack's axes are (prism, "
            "focus, y, x): save one time point"
        )
    others = [f"{axis} ({n}) as the prism" for axis, n in zip(axes, shape, strict=True) if axis == "C" and n > 1]
    also = "".join(f", and {other}" for other in others)
    warnings.warn(
        f"{path}: its axis of time, T ({shape[time]}), is taken as the focus, because it has none{also}",
        StackWarning,
        stacklevel=6,
    )
    renamed = axes.replace("Z", "U")
    return renamed[:time] + "Z" + renamed[time + 1 :]


def _places_of_axes(shape: tuple[int, ...], axes: str, path: Path) -> dict[str, int]:
    """Which axis of the array is C, Z, Y and X. Axes without a name become C and Z where these are free."""
    nameless = [i for i, axis in enumerate(axes) if axis in _NAMELESS]
    free = [axis for axis in "CZ" if axis not in axes or shape[axes.index(axis)] == 1]
    while len(nameless) > len(free) and shape[nameless[0]] == 1:
        nameless.pop(0)
    others = [axis for axis, n in zip(axes, shape, strict=True) if axis not in "CZYXSTQI" and n > 1]
    if others or len(nameless) > len(free):
        place = place_axis(shape, axes)
        offer = "" if place is None else f"; {offer_of_series(shape[place])}"
        raise StackError(
            f"{path}: has more dimensions ({axes}: {shape_text(shape)}) than a stack's (prism, focus, y, x){offer}"
        )
    places = {axis: axes.index(axis) for axis in "CZYX" if axis in axes}
    return places | dict(zip(free[len(free) - len(nameless) :], nameless, strict=True))
