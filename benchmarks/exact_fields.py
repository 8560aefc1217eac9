"""Every propagation against exact fields, at each focus plane and for narrow and wide condensers.

    python benchmarks/exact_fields.py

The fields are sums of partial waves (data_synthetic), so none of our propagations takes part in the answer. The exact
images and the model's have the same 13 condenser directions and the same periodic array, twice as wide as the part that
is compared. So neither the choice of directions nor the light that wraps around adds to the error. The error is the rms
difference over the exact image's standard deviation, or nan if rays turn back. Objective NA 0.9, 546 nm, shear 0.2 µm
along x, bias π/2, float32.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from comparison import header, row, trial
from data_synthetic import Bead, GaussianBall
from recon.run.exact_images import WIDENING, exact_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume
from torchdic.errors import TurnedRaysError

WAVELENGTH = 0.546
NA = 0.9
PRISM = Prism((0.0, 0.2), 1.5708)
CONDENSERS = (0.2, 0.5, 0.8)


@dataclass(frozen=True)
class Case:
    """A specimen, the voxels on which it is compared, focus planes in µm, and (propagation, steps) to try."""

    name: str
    specimen: Bead | GaussianBall
    grid: Grid
    focus: tuple[float, ...]
    trials: tuple[tuple[str, int], ...]

    def volume(self) -> Volume:
        """The specimen on its voxels, float32."""
        return Volume(self.grid, self.specimen.delta(self.grid, dtype=torch.float32), self.specimen.background)

    @property
    def acquisition(self) -> Acquisition:
        """The one prism, at each focus plane."""
        return Acquisition([PRISM], self.focus)

    @property
    def padding(self) -> int:
        """Voxels on each side that make the model's array as wide as the exact one."""
        return round(WIDENING * self.grid.shape[1])


CASES = {
    "smooth ball": Case(
        "smooth ball, σ 2 µm, Δn 0.03 in 1.36",
        GaussianBall(2.0, 0.03, 1.36),
        Grid((72, 128, 128), (0.25, 0.15, 0.15)),
        (-2.0, 0.0, 2.0, 4.0),
        (("projection", 72), ("rays", 36), ("wave", 18), ("wave", 36)),
    ),
    "strong smooth ball": Case(
        "strong smooth ball, σ 1 µm, Δn 0.1 in 1.36",
        GaussianBall(1.0, 0.1, 1.36),
        Grid((72, 112, 112), (0.125, 0.12, 0.12)),
        (-1.0, 0.0, 1.0, 2.0),
        (("projection", 72), ("rays", 72), ("wave", 18), ("wave", 72)),
    ),
    "sharp bead": Case(
        "sharp bead, 10 µm, Δn 0.03 in 1.56",
        Bead(5.0, 0.03, 1.56),
        Grid((80, 128, 128), (0.125, 0.15, 0.15)),
        (-3.0, 0.0, 3.0, 6.0),
        (("projection", 80), ("rays", 40), ("wave", 40), ("wave", 160)),
    ),
    "strong bead": Case(
        "strong bead, 4 µm, Δn 0.1 in 1.36",
        Bead(2.0, 0.1, 1.36),
        Grid((80, 96, 96), (0.05, 0.15, 0.15)),
        (-2.0, 0.0, 2.0, 4.0),
        (("projection", 80), ("rays", 40), ("wave", 80), ("wave", 160), ("wave", 640)),
    ),
}


def microscope(na: float) -> Microscope:
    """A condenser of 13 directions: along the axis, 4 at half its aperture and 8 at its edge."""
    rings = ((0.0, 1), (na / 2, 4), (na, 8))
    angles = [(r, 2 * math.pi * (k + 0.5) / count) for r, count in rings for k in range(count)]
    points = torch.tensor([[r * math.sin(a), r * math.cos(a)] for r, a in angles], dtype=torch.float64)
    return Microscope(WAVELENGTH, Objective(NA), Condenser(na, points))


def exact(case: Case, na: float) -> Float[Tensor, "prism focus y x"]:
    """The case's images from its exact field."""
    return exact_images(case.specimen, case.grid, microscope(na), case.acquisition, Fidelity())


def errors(case: Case, na: float, propagation: str, steps: int, expected: Tensor) -> tuple[list[float], float]:
    """Errors of a propagation in that many equal steps through the whole depth, and its seconds."""
    fidelity = Fidelity(propagation, steps=steps, padding=case.padding)
    return trial(case.volume(), microscope(na), case.acquisition, fidelity, expected)


def main() -> None:
    """Print a table for each specimen."""
    for case in CASES.values():
        dz, _, dx = case.grid.spacing
        print(f"\n{case.name}; voxels of {dx:g} µm, {dz:g} µm along z\n")
        print(header(("propagation", "step", "NA_c"), case.focus))
        for na in CONDENSERS:
            expected = exact(case, na)
            for propagation, steps in case.trials:
                cells = (propagation, f"{case.grid.extent[0] / steps:.4g} µm", f"{na:g}")
                try:
                    found, seconds = errors(case, na, propagation, steps, expected)
                except TurnedRaysError:
                    found, seconds = [math.nan] * len(case.focus), math.nan
                print(row(cells, found, seconds), flush=True)


if __name__ == "__main__":
    main()
