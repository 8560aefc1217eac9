"""Specimens that scenes need: those of `data_synthetic.scenes`, and a cell made stronger, or moved."""

from collections.abc import Callable
from dataclasses import replace

from data_synthetic import CellPhantom, Ellipsoid, Organelle
from data_synthetic.scenes.any_specimen import any_specimen, solid
from data_synthetic.scenes.fibre import Fibre
from data_synthetic.scenes.graded import GradedEllipsoid
from data_synthetic.scenes.together import Together

__all__ = ["Fibre", "GradedEllipsoid", "Together", "any_specimen", "moved", "solid", "stronger"]


def stronger(cell: CellPhantom, factor: float) -> CellPhantom:
    """The same cell with all its Δn times a factor."""
    return _changed(cell, lambda part: replace(part, contrast=factor * part.contrast))


def moved(cell: CellPhantom, by: tuple[float, float, float]) -> CellPhantom:
    """The same cell elsewhere. by: (z, y, x), in µm."""

    def there(shape: Ellipsoid) -> Ellipsoid:
        z, y, x = (centre + step for centre, step in zip(shape.centre, by, strict=True))
        return replace(shape, centre=(z, y, x))

    return _changed(cell, lambda part: replace(part, shape=there(part.shape)))


def _changed(cell: CellPhantom, change: Callable[[Organelle], Organelle]) -> CellPhantom:
    """A cell all of whose parts are changed."""
    nucleus, vacuole, lipid = (
        None if part is None else change(part) for part in (cell.nucleus, cell.vacuole, cell.lipid)
    )
    nucleoli = tuple(change(part) for part in cell.nucleoli)
    return CellPhantom(cell.background, change(cell.cytoplasm), nucleus, nucleoli, vacuole, lipid, cell.subpixels)
