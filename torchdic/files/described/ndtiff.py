"""NDTiff.index, in which Micro-Manager 2 names the axes of the planes beside it."""

from pathlib import Path

import tifffile

INDEX = "NDTiff.index"


def ndtiff_channels(path: Path) -> tuple[str, ...]:
    """The names of the channels of an NDTiff, in the order in which they were recorded; () where they have none."""
    found = (axes.get("channel") for axes, *_ in tifffile.read_ndtiff_index(path.parent / INDEX))
    return tuple(dict.fromkeys(name for name in found if isinstance(name, str)))
