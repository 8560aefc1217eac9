"""How a learning rate and the weight of a prior change over the steps of a descent."""

import math


def cosine(step: int, steps: int, peak: float) -> float:
    """From `peak` at step 0 down to 0 after the last step, along half a cosine."""
    return peak * 0.5 * (1 + math.cos(math.pi * step / steps))


def held_then_annealed(step: int, steps: int, first: float, last: float) -> float:
    """Held at `first` for 40 % of the steps, moved to `last` over the next 40 %, and held there.

    It moves geometrically, or linearly where one of the two weights is 0.
    """
    progress = min(max((step / steps - 0.4) / 0.4, 0.0), 1.0)
    if first > 0 and last > 0:
        return first * (last / first) ** progress
    return first + (last - first) * progress
