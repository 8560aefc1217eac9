"""Which of a file's images are the stack: its one series, the one that was asked for, or pages written one by one."""

import math
from pathlib import Path

import tifffile

from torchdic.errors import StackError
from torchdic.files.arrangement.axes import place_axis
from torchdic.files.arrangement.grey import check_grey
from torchdic.files.format import offer_of_series, shape_text

Page = tifffile.TiffPage | tifffile.TiffFrame

# Kinds of tifffile's series that are no more than pages alike, which differ in compression where there are several.
_MERE_PAGES = ("generic", "uniform")


def chosen_series(
    tif: tifffile.TiffFile, path: Path, number: int | None = None
) -> tuple[tifffile.TiffPageSeries, int | None]:
    """The series that was asked for, and the index along its axis of places, None where it has none or none is chosen.

    number: of the series, counted from 0; None where the file has only one.
    Raises StackError where there are more than one and none is chosen, where there is none of that number, and for
    several colour images.
    """
    series = tif.series
    if not series:
        raise StackError(f"{path}: holds no images")
    if number is None:
        if len(series) > 1:
            if all(s.keyframe.samplesperpixel > 1 for s in series):
                check_grey(series[0].keyframe, path)
            raise StackError(f"{path}: {_described(series)}; a stack is one series: {offer_of_series(len(series))}")
        return series[0], None
    place = place_axis(tuple(series[0].get_shape(squeeze=False)), series[0].get_axes(squeeze=False))
    places = series[0].get_shape(squeeze=False)[place] if len(series) == 1 and place is not None else 0
    held = places or len(series)
    if not 0 <= number < held:
        raise StackError(f"{path}: series {number} must be from 0 to {held - 1}: the file holds {held}")
    return (series[0], number) if places else (series[number], None)


def pages_one_by_one(tif: tifffile.TiffFile) -> list[Page] | None:
    """All pages, in their order, of a file that was written a plane at a time; None for any other file.

    Such a file holds several series, each of one plane, or of planes that differ in nothing but how they are stored.
    """
    series = tif.series
    if len(series) < 2 or len({(s.keyframe.shape, s.keyframe.axes, s.keyframe.dtype) for s in series}) > 1:
        return None
    mere = all(s.kind in _MERE_PAGES for s in series)
    planes = all(math.prod(s.shape) == math.prod(s.keyframe.shape) for s in series)
    if series[0].keyframe.axes != "YX" or not (mere or planes):
        return None
    pages = [page for s in series for page in s if page is not None]
    return sorted(pages, key=lambda page: page.index) if mere else pages


def _described(series: list[tifffile.TiffPageSeries]) -> str:
    shapes = [shape_text(s.shape) for s in series]
    if len(set(shapes)) == 1 and len({s.dtype for s in series}) == 1:
        return f"holds {len(series)} equal series ({shapes[0]} each)"
    if len(set(shapes)) == 1:
        shapes = [f"{shape} {s.dtype}" for shape, s in zip(shapes, series, strict=True)]
    distinct = list(dict.fromkeys(shapes))
    shown = ", ".join(distinct[:6]) + (", …" if len(distinct) > 6 else "")
    return f"holds {len(series)} unequal images ({shown})"
