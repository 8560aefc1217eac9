"""Which propagations the planner compares: the truth, and the rungs that lead to it from straight rays."""

TRUTH = "wave"
"""What the others are judged by: it contains bending, amplitude and diffraction."""
STRAIGHT = "projection"
"""Rays that neither bend nor carry an amplitude."""
BENT = "rays"
"""Rays that bend, with their amplitude or without."""
