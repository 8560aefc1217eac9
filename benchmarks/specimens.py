"""Specimens that scenes need: those of `data_synthetic.scenes`, and a cell made stronger."""

from dataclasses import replace

from data_synthetic import CellPhantom, Organelle
from data_synthetic.scenes.any_specimen import any_specimen, solid
from data_synthetic.scenes.fibre import Fibre
from data_synthetic.scenes.graded import GradedEllipsoid
from data_synthetic.scenes.together import Together

__all__ = ["Fibre", "GradedEllipsoid", "Together", "any_specimen", "solid", "stronger"]


def stronger(cell: CellPhantom, factor: float) -> CellPhantom:
    """The same cell with all its Δn times a factor."""

    def scaled(part: Organelle) -> Organelle:
        return replace(part, contrast=factor * part.contrast)

    nucleus, vacuole, lipid = (
        None if part is None else scaled(part) for part in (cell.nucleus, cell.vacuole, cell.lipid)
    )
    nucleoli = tuple(scaled(part) for part in cell.nucleoli)
    return CellPhantom(cell.background, scaled(cell.cytoplasm), nucleus, nucleoli, vacuole, lipid, cell.subpixels)
