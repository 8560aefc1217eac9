"""Fidelities to start with: a draft, the default, and the reference for both."""

from torchdic.fidelity import Fidelity
from torchdic.propagation import table  # noqa: F401  (it registers the propagations)

# Errors are those of images (torchdic.planning.image_error) on the scenes of `python benchmarks/accuracy.py`: a thin
# weak bead, a cell, a thick graded ball and a sharp strong bead. tests/test_precision.py asserts them.
DRAFT = Fidelity("wave", sources=12, order=1)
"""A quick look in up to twice the time of a projection. Its errors are 0.037, 0.20, 0.039 and 0.31."""
STANDARD = Fidelity("wave")
"""The default. Its errors are 0.019, 0.084, 0.036 and 0.071. 8 voxels of padding reduce the cell's to 0.036 and the
ball's to 0.0038."""
REFERENCE = Fidelity("wave", sources=128, interpolation="cubic", padding=16)
"""The reference for the others. Its errors are 0.017, 0.012, 0.0035 and 0.040; those of the beads come from their
voxels."""
