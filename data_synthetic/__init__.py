"""Specimens with a known answer, to test and to demonstrate the microscope and the reconstruction.

Every specimen is a frozen dataclass in µm with its background index; `delta(grid)` gives Δn and
`index(grid)` gives n = background + Δn on a grid, (z, y, x). Where an exact answer exists the specimen
knows it: rays through a layered medium and a graded-index rod, the straight-ray OPD of a Gaussian ball,
the OPD step of glass etched in a step or a grating, and the exact wave fields of a bead and of a ball of any
smooth radial index, so that data for a reconstruction need not come from the model that inverts it.
"""

from data_synthetic.ball import GaussianBall
from data_synthetic.bead import Bead
from data_synthetic.cell import CellPhantom, Organelle
from data_synthetic.ellipsoid import Ellipsoid
from data_synthetic.exact import (
    radial_amplitude,
    radial_coefficients,
    radial_field,
    scattering_amplitude,
    sphere_field,
    sphere_near_field,
)
from data_synthetic.grating import EtchedGlassGrating
from data_synthetic.layered import LayeredMedium
from data_synthetic.rod import GradedIndexRod
from data_synthetic.specimen import ExactRays, Specimen
from data_synthetic.step import EtchedGlassStep

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
