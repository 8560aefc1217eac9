"""The volumes of a folder as the page shows them in sections: Δn, its error bars, and those of several methods."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from recon.report.figures import centre
from recon.report.html.folder import Folder
from recon.report.html.packed import LEVELS, Thinning, in_levels, packed, reach
from recon.report.html.surface import Surfaces, surfaces
from torchdic import Grid

# Voxels of all volumes on a page together, at most.
MOST_VOXELS = 2_500_000


@dataclass(frozen=True)
class Kind:
    """A file that holds a volume.

    file: its name. title, unit: of what it holds. colours: the map's name. about: the file of the volume whose errors
    it holds; empty where it holds none.
    """

    file: str
    title: str
    unit: str = ""
    colours: str = "viridis"
    about: str = ""


# A finished volume comes before one of a later run that was interrupted.
KINDS = (
    Kind("volume.ome.tif", "Δn"),
    Kind("sd.ome.tif", "± by noise", colours="magma", about="volume.ome.tif"),
    Kind("error.ome.tif", "± in all", colours="magma", about="volume.ome.tif"),
    Kind("opl.ome.tif", "Optical path", "µm"),
    Kind("wave.ome.tif", "Δn by the wave"),
    Kind("rays.ome.tif", "Δn by bent rays"),
    Kind("projection.ome.tif", "Δn by straight rays"),
    Kind("truth.ome.tif", "Δn as it is"),
    Kind("volume.interrupted.ome.tif", "Δn of a later, interrupted run"),
)


@dataclass(frozen=True)
class Volumes:
    """The volumes of a folder.

    shown: each as the page's script takes it. surfaces: of the first, None where it isn't of Δn, or has none. grid: of
    the first. low, high: the least and the greatest value in it. thinned: what is left out for viewing, in words; empty
    for nothing.
    """

    shown: tuple[dict[str, Any], ...]
    surfaces: Surfaces | None
    grid: Grid
    low: float
    high: float
    thinned: str


def volumes_of(folder: Folder) -> Volumes | None:
    """The volumes that a folder holds, read one after the other; None where there is none."""
    kinds = [kind for kind in KINDS if folder.has(kind.file)]
    shown: list[dict[str, Any]] = []
    first: tuple[Grid, float, float, Surfaces | None, Thinning] | None = None
    for kind in kinds:
        found = folder.volume(kind.file)
        if found is None:
            continue
        delta, grid = found
        values = delta.numpy()
        thinning = Thinning.within(MOST_VOXELS // len(kinds), grid.shape, grid.spacing)
        shown.append(_shown(kind, values, grid, thinning, folder))
        if first is None:
            surface = surfaces(values, grid) if kind.title.startswith("Δn") else None
            first = grid, float(values.min()), float(values.max()), surface, thinning
    if first is None:
        return None
    grid, low, high, surface, thinning = first
    words = (
        f"For viewing, the sections are thinned to means of {thinning.words} voxels (z, y, x); the file has them all."
        if thinning.is_any
        else ""
    )
    return Volumes(tuple(shown), surface, grid, low, high, words)


def _shown(kind: Kind, values: np.ndarray, grid: Grid, thinning: Thinning, folder: Folder) -> dict[str, Any]:
    """A volume as the page's script takes it."""
    thin = thinning.of(values)
    low, high = min(0.0, float(thin.min())), max(0.0, float(thin.max()))
    scale = in_levels(np.array(reach(thin)), low, high).tolist() if high > low else [0, LEVELS]
    old = bool(kind.about) and folder.is_older(kind.file, kind.about)
    return {
        "title": f"{kind.title} (of an earlier volume)" if old else kind.title,
        "unit": kind.unit,
        "colours": kind.colours,
        "shape": list(thin.shape),
        "places": [thinning.places(axis, grid.shape[axis], grid.spacing[axis]) for axis in range(3)],
        "extent": list(grid.extent),
        "begin": [int(place) for place in centre(torch.from_numpy(thin))],
        "low": low,
        "high": high,
        "scale": scale,
        "values": packed(in_levels(thin, low, high)),
    }
