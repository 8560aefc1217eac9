"""Surfaces of equal Δn through a volume, for a view that can be turned."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16, UInt32
from skimage.measure import marching_cubes

from recon.report.html.packed import Thinning, packed, reach
from torchdic import Grid

# The surfaces' levels, as parts of the largest |Δn|; the one that is shown at first.
LEVELS, FIRST = (0.15, 0.25, 0.35, 0.5, 0.65, 0.8), 0.5

# Voxels through which surfaces are laid, and triangles of all of them together, at most.
MOST_VOXELS, MOST_TRIANGLES = 400_000, 250_000

# Steps along an axis in which vertices are kept.
STEPS = 65_535


@dataclass(frozen=True)
class Surfaces:
    """Surfaces through a volume.

    levels: each as the page's script takes it: its |Δn|, its meshes, and the volume in µm³ that they enclose, counted
    in voxels. size: of the volume's box (x, y, z) in µm. first: the index of the level that is shown at first. blocks:
    how the volume was thinned before, in words; empty for not at all.
    """

    levels: tuple[dict[str, Any], ...]
    size: tuple[float, float, float]
    first: int
    blocks: str

    def as_json(self) -> dict[str, Any]:
        """As the page's script takes it."""
        return {"levels": self.levels, "size": self.size}


def surfaces(delta: Float[np.ndarray, "z y x"], grid: Grid) -> Surfaces | None:
    """Surfaces of a volume, of Δn above and below 0 where both are strong enough; None where Δn is 0 everywhere."""
    low, high = reach(delta)
    largest = max(high, -low)
    if largest == 0:
        return None
    thinning = Thinning.within(MOST_VOXELS, grid.shape, grid.spacing)
    while (found := _levels(thin := thinning.of(delta), largest)) is None:
        thinning = Thinning.within(thin.size // 2, grid.shape, grid.spacing)
    for level in found:
        level["meshes"] = [_as_json(*mesh) for mesh in level["meshes"]]
        inside = np.count_nonzero(delta > level["level"]) + np.count_nonzero(delta < -level["level"])
        level["inside"] = inside * float(np.prod(grid.spacing))
    z, y, x = grid.extent
    size = float(x), float(y), float(z)
    return Surfaces(tuple(found), size, LEVELS.index(FIRST), thinning.words if thinning.is_any else "")


def _levels(thin: np.ndarray, largest: float) -> list[dict[str, Any]] | None:
    """The surfaces of each level, those with the most triangles first; None where they are too many in all."""
    found: list[dict[str, Any]] = []
    triangles = 0
    for level in (part * largest for part in LEVELS):
        meshes = [(sign, *_mesh(sign * thin, level)) for sign in (1, -1) if float((sign * thin).max()) > level]
        triangles += sum(len(faces) for _, _, faces in meshes)
        if triangles > MOST_TRIANGLES:
            return None
        found.append({"level": level, "meshes": meshes})
    return found


def _mesh(
    values: Float[np.ndarray, "z y x"], level: float
) -> tuple[UInt16[np.ndarray, "vertex 3"], UInt32[np.ndarray, "triangle 3"]]:
    """The surface on which values are at a level that they exceed somewhere, closed at the box's faces.

    Returns its vertices (x, y, z), in STEPS along the box, and the three of each triangle.
    """
    vertices, faces, *_ = marching_cubes(np.pad(values, 1), level)
    places = np.clip((vertices - 0.5) / np.array(values.shape), 0, 1)  # the padding is beyond the box
    steps = (places[:, ::-1] * STEPS).round().astype("<u2")  # (x, y, z)
    return steps, faces.astype("<u4")


def _as_json(sign: int, vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    """A mesh as the page's script takes it: each number less the one before, which packs to half the size."""
    before = np.zeros((1, 3), vertices.dtype)
    steps = np.diff(vertices, axis=0, prepend=before), np.diff(faces.ravel(), prepend=faces.dtype.type(0))
    return {"sign": sign, "vertices": packed(steps[0]), "faces": packed(steps[1])}
