"""Fidelities to begin with: a draft, the default, and what the others are compared with."""

from torchdic.fidelity import Fidelity
from torchdic.propagation import table  # noqa: F401  (a fidelity names what the table holds)

# Errors of images (torchdic.planning.image_error) on the scenes of `python benchmarks/accuracy.py`: a thin weak bead, a
# cell, a thick graded ball and a sharp strong bead, as tests/test_precision.py holds them.
DRAFT = Fidelity("wave", sources=12, order=1)
"""A quick look, at up to twice the price of a projection: 0.037, 0.20, 0.039 and 0.31 off."""
STANDARD = Fidelity("wave")
"""The default: 0.019, 0.084, 0.036 and 0.071 off; 8 voxels of padding bring the cell to 0.036, the ball to 0.0038."""
REFERENCE = Fidelity("wave", sources=128, interpolation="cubic", padding=16)
"""What the others are compared with: 0.017, 0.012, 0.0035 and 0.040 off; the beads' is their voxels' own error."""
