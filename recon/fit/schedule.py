"""How the learning rate and the weight of total variation change over the steps."""

import math


def cosine(step: int, steps: int, peak: float) -> float:
    """From `peak` at step 0 down to 0 after the last step, along half a cosine."""
    return peak * 0.5 * (1 + math.cos(math.pi * step / steps))


def held_then_annealed(step: int, steps: int, first: float, last: float) -> float:
    """`first` for 40 % of the steps, then geometrically (linearly from or to 0) to `last` over the next 40 %."""
    progress = min(max((step / steps - 0.4) / 0.4, 0.0), 1.0)
    if first > 0 and last > 0:
        return first * (last / first) ** progress
    return first + (last - first) * progress
