"""The biases behind the levels of the empty background: with one lamp and exposure they are A·(sin²(bias/2) + leak).

The settings are those of one compensator, whose scale and zero may be off: bias = factor·declared + zero. Which of
lamp, zero, factor and leak the levels tell depends on the settings: ±b tells the zero, a bright field the factor, and
settings of several |b| both. What they don't tell keeps the width that it has beforehand.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

# Standard deviations beforehand: of the compensator's zero in rad and of the logarithm of its factor, as a user knows
# them, and of the light that leaks through crossed polarisers, relative to the bright field.
ZERO, FACTOR, LEAK = math.radians(15), 0.15, 3e-3

# A bias that is as uncertain as this, in rad, isn't told.
UNSURE = math.radians(4)


@dataclass(frozen=True)
class BiasesFound:
    """What the levels tell.

    biases, deviations: of each prism in rad, None for bright field. told: which of them are known. zero,
    zero_deviation: of the compensator, rad. excess: see `biases_of_levels`.
    """

    biases: tuple[float | None, ...]
    deviations: tuple[float | None, ...]
    told: tuple[bool, ...]
    zero: float
    zero_deviation: float
    excess: float


def biases_of_levels(
    declared: Sequence[float | None], levels: Sequence[float], relative: Sequence[float]
) -> BiasesFound:
    """The biases with which the levels of an empty field agree.

    declared: bias of each prism in rad; None is bright field. levels: above 0, in any one unit, the dark counts
    removed. relative: standard deviation of each level over itself.
    `excess` is the root mean square of the levels' deviations from the law over their own, where there are more levels
    than unknowns; the deviations are inflated by it where it is above 1.
    Raises ValueError where the numbers of the three differ, or a level isn't above 0.
    """
    if not len(declared) == len(levels) == len(relative):
        raise ValueError(f"{len(declared)} biases, {len(levels)} levels and {len(relative)} deviations must be as many")
    if min(levels) <= 0:
        raise ValueError(f"level {min(levels):g} must be above 0")
    told = np.array([math.nan if bias is None else bias for bias in declared])
    bright, seen = np.isnan(told), np.log(np.array(levels, dtype=float))
    widths = np.array([math.inf, ZERO, FACTOR, LEAK])

    def model(unknown: np.ndarray) -> np.ndarray:
        lamp, zero, factor, leak = unknown
        part = np.where(bright, 1.0, np.sin((told * math.exp(factor) + zero) / 2) ** 2)
        return lamp + np.log(part + abs(leak) + 1e-12)

    def residuals(unknown: np.ndarray) -> np.ndarray:
        return np.concatenate(((model(unknown) - seen) / np.array(relative), (unknown / widths)[1:]))

    first = np.array([float(seen.mean() - model(np.zeros(4)).mean()), 0.0, 0.0, LEAK / 10])
    found = least_squares(residuals, first, x_scale=[1.0, ZERO, FACTOR, LEAK])
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    freedom = len(levels) - 1  # the others are held by what is known beforehand
    excess = math.sqrt(2 * float(found.cost) / freedom) if freedom else 0.0
    slopes = np.stack([np.zeros_like(told), np.ones_like(told), told * math.exp(found.x[2]), np.zeros_like(told)], 1)
    wide = np.sqrt(np.einsum("pi,ij,pj->p", np.nan_to_num(slopes), covariance, np.nan_to_num(slopes)))
    wide = wide * max(1.0, excess)
    biases = told * math.exp(found.x[2]) + found.x[1]
    return BiasesFound(
        tuple(None if b else float(v) for v, b in zip(biases, bright, strict=True)),
        tuple(None if b else float(v) for v, b in zip(wide, bright, strict=True)),
        tuple(bool(not b and w < UNSURE) for w, b in zip(wide, bright, strict=True)),
        float(found.x[1]),
        math.sqrt(float(covariance[1, 1])) * max(1.0, excess),
        excess,
    )
