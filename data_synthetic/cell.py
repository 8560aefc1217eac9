"""A cell with organelles. It is asymmetric along every axis, so that a swapped axis or sign shows in its image."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from data_synthetic.ellipsoid import Ellipsoid
from data_synthetic.fill import require_subpixels
from data_synthetic.specimen import Specimen, require_contrast
from torchdic.grid import Grid


@dataclass(frozen=True)
class Organelle:
    """A homogeneous part of a cell.

    shape: where it is.
    contrast: its index minus that of the medium around the cell.
    """

    shape: Ellipsoid
    contrast: float


@dataclass(frozen=True)
class CellPhantom(Specimen):
    """Cytoplasm with a nucleus, nucleoli in the nucleus, a vacuole and a lipid droplet.

    The default cell is 5.2 × 6.4 × 8.4 µm (z, y, x) in a medium of 1.335.

    background: index of the medium.
    cytoplasm: the whole cell.
    nucleus, vacuole, lipid: parts in the cytoplasm; None leaves one out.
    nucleoli: parts in the nucleus; () leaves them out.
    subpixels: columns per voxel along y and along x, by which each voxel's covered volume is found.
    Raises ValueError for an index below 1, a part that sticks out of the one it lies in, and parts that overlap.
    """

    background: float = 1.335
    cytoplasm: Organelle = Organelle(Ellipsoid((2.6, 3.2, 4.2)), 0.022)
    nucleus: Organelle | None = Organelle(Ellipsoid((1.3, 1.5, 1.8), (-0.4, 0.5, -0.9)), 0.0354)
    nucleoli: tuple[Organelle, ...] = (
        Organelle(Ellipsoid((0.45, 0.5, 0.6), (-0.2, 0.9, -1.4)), 0.045),
        Organelle(Ellipsoid((0.35, 0.35, 0.35), (-0.8, -0.1, -0.3)), 0.045),
    )
    vacuole: Organelle | None = Organelle(Ellipsoid((0.9, 0.9, 1.0), (0.5, -1.0, 2.0)), 0.005)
    lipid: Organelle | None = Organelle(Ellipsoid((0.5, 0.5, 0.5), (0.9, 1.3, 1.7)), 0.05)
    subpixels: int = 4

    def __post_init__(self) -> None:
        require_subpixels(self.subpixels)
        require_contrast("cytoplasm", self.background, self.cytoplasm.contrast)
        parts = self._parts()
        for name, part, host in parts:
            require_contrast(name, self.background, part.contrast)
            if not bool(host.shape.contains(part.shape.surface()).all()):
                raise ValueError(f"{name} at {part.shape.centre} µm sticks out of the part of the cell that it lies in")
        for i, (name, part, host) in enumerate(parts):
            for other_name, other, other_host in parts[:i]:
                apart = not (
                    bool(part.shape.contains(other.shape.surface()).any())
                    or bool(other.shape.contains(part.shape.surface()).any())
                )
                if host is other_host and not apart:
                    raise ValueError(f"{name} and {other_name} overlap, but a voxel has one index")

    def _parts(self) -> list[tuple[str, Organelle, Organelle]]:
        """Each part inside the cytoplasm as (name, part, the part that it lies in)."""
        inside = [("nucleus", self.nucleus), ("vacuole", self.vacuole), ("lipid", self.lipid)]
        parts = [(name, part, self.cytoplasm) for name, part in inside if part is not None]
        if self.nucleoli and self.nucleus is None:
            raise ValueError(f"{len(self.nucleoli)} nucleoli lie in a nucleus, but the nucleus is None")
        if self.nucleus is not None:
            parts += [(f"nucleolus {i}", part, self.nucleus) for i, part in enumerate(self.nucleoli, 1)]
        return parts

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        # A part replaces the index of its host. Parts lie wholly inside their hosts, so the sum is exact.
        delta = self.cytoplasm.contrast * self.cytoplasm.shape.fill(grid, self.subpixels)
        for _, part, host in self._parts():
            delta += (part.contrast - host.contrast) * part.shape.fill(grid, self.subpixels)
        return delta
