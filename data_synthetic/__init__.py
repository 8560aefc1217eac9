"""Specimens with a known answer, to test and to demonstrate the microscope and the reconstruction.

Every specimen is a frozen dataclass. Its lengths are in µm, and it knows the index of the medium around it.
`delta(grid)` gives Δn and `index(grid)` gives n = background + Δn on a grid, shape (z, y, x).

Where an exact answer exists, the specimen knows it: the rays through a layered medium and a graded-index rod, the OPD
of straight rays through a Gaussian ball, the OPD step of etched glass, and the wave field behind a bead or a ball of
any smooth radial index. A reconstruction can therefore be tested on images that its own model has not made.

`data_synthetic.recorder` records a specimen as a camera stores it, with the faults of real stacks and files.
"""

from data_synthetic.ball import GaussianBall
from data_synthetic.bead import Bead
from data_synthetic.cell import CellPhantom, Organelle
from data_synthetic.ellipsoid import Ellipsoid
from data_synthetic.etched import EtchedGlassGrating, EtchedGlassStep
from data_synthetic.exact.fields import (
    radial_amplitude,
    radial_coefficients,
    radial_field,
    scattering_amplitude,
    sphere_field,
    sphere_near_field,
)
from data_synthetic.layered import LayeredMedium
from data_synthetic.rod import GradedIndexRod
from data_synthetic.specimen import ExactRays, Specimen

__all__ = [
    "Bead",
    "CellPhantom",
    "Ellipsoid",
    "EtchedGlassGrating",
    "EtchedGlassStep",
    "ExactRays",
    "GaussianBall",
    "GradedIndexRod",
    "LayeredMedium",
    "Organelle",
    "Specimen",
    "radial_amplitude",
    "radial_coefficients",
    "radial_field",
    "scattering_amplitude",
    "sphere_field",
    "sphere_near_field",
]
