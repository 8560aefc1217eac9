"""Which propagations the planner compares, and what they raise where light can't cross a specimen."""

from torchdic.errors import SidewaysError, TurnedRaysError, UnstableError

TRUTH = "wave"
"""What the others are judged by: it contains bending, amplitude and diffraction."""
STRAIGHT = "projection"
"""Rays that neither bend nor carry an amplitude."""
BENT = "rays"
"""Rays that bend, with their amplitude or without."""

CANNOT_CROSS = (SidewaysError, TurnedRaysError, UnstableError)
"""What `image` raises where a propagation can't bring the light through a specimen."""
