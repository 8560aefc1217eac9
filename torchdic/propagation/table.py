"""The propagations that torchdic has."""

from torchdic.propagation.base import register
from torchdic.propagation.bent_rays import BentRays
from torchdic.propagation.projection import Projection
from torchdic.propagation.wave import Wave

for propagation in (Projection(), BentRays(), Wave()):
    register(propagation)
