"""What images can't say, in one line."""

import math

from recon.coverage.resolution import finest_along_z
from recon.coverage.seen import Coverage

# A recording after which Δn is uncertain by more than this part of what it was before tells next to nothing.
HARDLY = 0.9

# A share of the frequencies below which most of a volume is guessed.
LITTLE = 0.1

# Periods across z, in µm, of which at least one is seen to change along z within the volume where depth is told.
TELLING = (2.0, 4.0)


def shortcoming(found: Coverage) -> str | None:
    """What the images can't say of a specimen, in one line; None where they say much of it."""
    if found.deviation > HARDLY * found.known_before:
        return "these images tell next to nothing of such a specimen: what is found of it is a guess of the priors'"
    if found.share < LITTLE:
        told = f"{found.share:.0%} of the frequencies that the apertures let through"
        return f"these images see {told}: most of what a volume shows is a guess of the priors'"
    if all(_flat(found, period) for period in TELLING):
        return "these images hardly tell depth: of structures of 2 µm and more they see no change along z"
    return None


def _flat(found: Coverage, period: float) -> bool:
    """Whether gratings of a period across z are seen where they change by half a wave within the volume at most."""
    along = finest_along_z(found, period)
    return along is None or math.isinf(along) or along >= 2 * found.grid.extent[0]
