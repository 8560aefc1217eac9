"""A value by trials: a volume is fitted with each, and a parabola through the misfits has its least there."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# How often the search is moved to where the parabola has its least, and the step of the last one over the first's.
MOVES, NARROWED = 6, 0.5

# A least that lies further than this many steps from the trials' middle isn't believed, and the search moves there.
WITHIN = 0.6

# A volume that leaves less than the noise has absorbed the rest of it, more with some values than with others: that
# alone may change the misfit by this share of what was absorbed.
FREEDOM = 0.1

# The misfit of each image, relative to its prism's spatial variance, of volumes that were fitted with values.
MisfitsAt = Callable[[Sequence[float]], Iterable[Float[np.ndarray, " image"]]]


@dataclass(frozen=True)
class Least:
    """Where the misfit is least.

    value: there. deviation: one standard deviation; infinite where the misfit has no least. tried: the values of the
    trials and their mean misfits. absorbed: the share of the noise that the best volume has absorbed. unexplained: one
    standard deviation more, where what no volume explains may hang on the value as what a volume absorbs does.
    """

    value: float
    deviation: float
    tried: tuple[tuple[float, float], ...]
    absorbed: float = 0.0
    unexplained: float = 0.0

    @property
    def told(self) -> float:
        """The misfit of the trial nearest to 0, which is as told."""
        return min(self.tried, key=lambda trial: abs(trial[0]))[1]


def least_misfit(
    misfits_at: MisfitsAt, first: float, step: float, noise: float, pixels: int, limits: tuple[float, float]
) -> Least:
    """Find the value with the least misfit: three trials, moved until it lies among them, then three closer ones.

    first, step: the middle of the first trials, and their distance. noise: what noise leaves of the mean misfit.
    pixels: of all images. limits: the least and the greatest value.

    The deviation is the larger of what the noise says, by the curvature of the misfit, inflated by the misfit over the
    noise's, or by what the volume has absorbed of the noise, and of how much the images disagree, each of which is left
    out in turn (a jackknife).
    """
    known: dict[float, np.ndarray] = {}

    def at(values: Sequence[float]) -> Float[np.ndarray, "trial image"]:
        new = [value for value in values if value not in known]
        known.update(zip(new, misfits_at(new), strict=True))
        return np.stack([known[value] for value in values])

    middle, least = first, first
    for narrow in (False, True):
        wide = step * (NARROWED if narrow else 1.0)
        for _ in range(MOVES):
            values = [min(max(middle + sign * wide, limits[0]), limits[1]) for sign in (-1, 0, 1)]
            if len(set(values)) < 3:
                return Least(first, math.inf, _table(known))
            misfits = at(values)
            curvature, least = _parabola(values, misfits.mean(1))
            if curvature <= 0 or abs(least - middle) > WITHIN * wide:
                best = values[int(misfits.mean(1).argmin())]
                moved = best if curvature <= 0 or abs(least - middle) > 1.5 * wide else least
                moved = min(max(moved, limits[0]), limits[1])
                if moved == middle:
                    return Least(first, math.inf, _table(known))
                middle = moved
                continue
            break
        else:
            return Least(first, math.inf, _table(known))
        middle = least
    lowest, (curvature, _) = min(mean for _, mean in _table(known)), _parabola(values, misfits.mean(1))
    absorbed = max(0.0, 1 - lowest / noise) if noise > 0 else 0.0
    unexplained = math.sqrt(FREEDOM * max(0.0, lowest - noise) / curvature)
    return Least(least, _deviation(values, misfits, noise, pixels), _table(known), absorbed, unexplained)


def _deviation(values: Sequence[float], misfits: Float[np.ndarray, "trial image"], noise: float, pixels: int) -> float:
    curvature, _ = _parabola(values, misfits.mean(1))
    lowest = float(misfits.mean(1).min())
    by_noise = math.sqrt((max(noise, lowest) / pixels + FREEDOM * max(0.0, noise - lowest)) / curvature)
    images = misfits.shape[1]
    if images < 2:
        return by_noise
    without = (misfits.sum(1, keepdims=True) - misfits) / (images - 1)
    leasts = np.array([_parabola(values, without[:, i])[1] for i in range(images)])
    spread = math.sqrt((images - 1) / images * float(((leasts - leasts.mean()) ** 2).sum()))
    return max(by_noise, spread)


def _parabola(values: Sequence[float], misfits: np.ndarray) -> tuple[float, float]:
    """Half the curvature of the parabola through three trials, and where it has its least."""
    middle = values[1]
    a, b, _ = np.polyfit(np.array(values) - middle, misfits, 2)
    return float(a), middle - float(b / (2 * a)) if a != 0 else middle


def _table(known: dict[float, np.ndarray]) -> tuple[tuple[float, float], ...]:
    return tuple((value, float(known[value].mean())) for value in sorted(known))
