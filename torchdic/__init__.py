"""torchdic simulates Nomarski DIC images of transparent 3-D specimens. Every image can be differentiated.

Conventions
-----------
Lengths are in µm, angles in rad, the vacuum wavelength in µm. The index has no unit. The optical path difference (OPD)
is in µm.
Volumes have the axes (z, y, x), images (y, x), transverse vectors (y, x). The origin is the centre of the volume: voxel
i has its centre at (i − (N−1)/2)·spacing. y grows with the row index, downward on a screen. Light travels toward +z,
and fields vary as exp(+ikz). Focus z_f means that the plane z = z_f is sharp. Shear is the full displacement between
the two beams. Intensity is relative to the empty bright field, so an empty DIC image equals sin²(bias/2).
"""

from torchdic.errors import (
    ApertureWarning,
    LostRankError,
    SamplingWarning,
    ShortageWarning,
    ShortOfMemoryError,
    SidewaysError,
    SlabWarning,
    StackError,
    StackWarning,
    ToleranceWarning,
    TurnedRaysError,
    UnstableError,
    WrapAroundWarning,
)
from torchdic.fidelity import Fidelity
from torchdic.forward.foresee import foreseen
from torchdic.forward.images import image, image_field
from torchdic.grid import Grid
from torchdic.instrument.camera import Camera
from torchdic.instrument.condenser import Condenser, Spectrum
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.instrument.objective import Layer, Objective
from torchdic.instrument.polarisation import Polarisation
from torchdic.instrument.polarised_lenses import JonesPupil
from torchdic.instrument.prism import Prism
from torchdic.instrument.thin_lens import ThinLens, thin_lens
from torchdic.memory.budget import Foreseen
from torchdic.planning.effects import Effect
from torchdic.planning.plan import Plan, plan
from torchdic.planning.work_precision import Candidate, Trial, work_precision
from torchdic.propagation.presets import DRAFT, REFERENCE, STANDARD
from torchdic.rays.trace import Rays, launch, trace
from torchdic.specimen.volume import Volume

__version__ = "0.1.0"

__all__ = [
    "DRAFT",
    "REFERENCE",
    "STANDARD",
    "Acquisition",
    "ApertureWarning",
    "Camera",
    "Candidate",
    "Condenser",
    "Effect",
    "Fidelity",
    "Foreseen",
    "Grid",
    "JonesPupil",
    "Layer",
    "LostRankError",
    "Microscope",
    "Objective",
    "Plan",
    "Polarisation",
    "Prism",
    "Rays",
    "SamplingWarning",
    "ShortOfMemoryError",
    "ShortageWarning",
    "SidewaysError",
    "SlabWarning",
    "Spectrum",
    "StackError",
    "StackWarning",
    "ThinLens",
    "ToleranceWarning",
    "Trial",
    "TurnedRaysError",
    "UnstableError",
    "Volume",
    "WrapAroundWarning",
    "foreseen",
    "image",
    "image_field",
    "launch",
    "plan",
    "thin_lens",
    "trace",
    "work_precision",
]
