"""The partial waves that a ball of varying radial index scatters.

For an index n(r) that varies, the radial functions R_l are written in those of the medium,
    R_l = A j_l(kr) + B y_l(kr),    A' j_l + B' y_l = 0,    B = 0 at r = 0,
which turns R'' + 2R'/r + (k0² n² − l(l+1)/r²)R = 0 into
    d/dr (A, B) = w·(y_l, −j_l)·(A j_l + B y_l),    w = k r² k0² (n² − n_medium²):
only the difference from the medium is integrated (Calogero, Variable Phase Approach, 1967), so that a faint sphere
keeps its relative accuracy. Each step multiplies by the exponential of Magnus's fourth-order series, whose determinant
is 1, as the exact solution's is. Where n = n_medium again, a_l = B/(iA − B).
"""

import math
from collections.abc import Callable

import numpy as np

from data_synthetic.exact.sphere import ScatteredWaves, number_of_orders
from data_synthetic.specimen import require_above_zero, require_index

# The index n at distances r in µm from a ball's centre.
RadialIndex = Callable[[np.ndarray], np.ndarray]

# Radial steps whose Bessel functions are held at once.
STEPS_AT_ONCE = 256


def radial_waves(
    wavelength: float, index: RadialIndex, radius: float, n_medium: float, step: float | None
) -> ScatteredWaves:
    """Integrate the radial equations; the module's docstring has them."""
    require_above_zero("wavelength", wavelength, "µm")
    require_above_zero("radius", radius, "µm")
    require_index("medium", n_medium)
    k0 = 2 * math.pi / wavelength
    k = k0 * n_medium
    # The largest index, looked up on a fine mesh, decides the number of orders and the default step.
    largest = float(_index_at(index, radius * (np.arange(2048) + 0.5) / 2048).max())
    longest = wavelength / (100 * max(largest, n_medium)) if step is None else step
    require_above_zero("step", longest, "µm")
    steps = math.ceil(radius / longest)
    h = radius / steps
    orders = number_of_orders(k0 * max(largest, n_medium) * radius)

    in_phase, quadrature = np.ones(orders), np.zeros(orders)  # A and B
    nodes = 0.5 + np.array([-1, 1]) / math.sqrt(12)  # Gauss's two points of a step
    for first in range(0, steps, STEPS_AT_ONCE):
        r = h * (np.arange(first, min(first + STEPS_AT_ONCE, steps))[:, None] + nodes)
        n = _index_at(index, r)
        w = k * r**2 * k0**2 * (n - n_medium) * (n + n_medium)
        for block in _magnus_steps(orders, k * r, w[..., None], h):
            in_phase, quadrature = (
                block[0] * in_phase + block[1] * quadrature,
                block[2] * in_phase + block[3] * quadrature,
            )
    return ScatteredWaves(k, quadrature / (1j * in_phase - quadrature))


def _magnus_steps(orders: int, x: np.ndarray, w: np.ndarray, h: float) -> np.ndarray:
    """exp(Ω) of each step, shape (step, 4, order): the entries AA, AB, BA, BB of the 2×2 matrices.

    x (step, 2) = kr and w (step, 2, 1) at each step's Gauss points. With M = w·(y, −j)ᵀ(j, y),
    Ω = (h/2)(M1 + M2) − (√3/12)h²[M1, M2], without trace: exp Ω = coshδ + (sinhδ/δ)Ω, δ² = −det Ω.
    Nothing is integrated where r < lh/10. There j_l ~ rˡ changes too fast for a step, but it adds less than (kh/10)²ˡ⁺³
    to B; what it does to A is a factor that a_l doesn't depend on.
    """
    j, y = _spherical_bessel(orders, x)
    k = (x[0, 1] - x[0, 0]) * math.sqrt(3) / h
    skipped = (x.min(1, keepdims=True) < k * h / 10 * np.arange(orders)) | (y == 0).any(1)
    j, y = (np.where(skipped[:, None], 0, f) for f in (j, y))
    jy, jj, yy = w * j * y, w * j * j, w * y * y
    cross = w[:, 0] * w[:, 1] * (j[:, 0] * y[:, 1] - y[:, 0] * j[:, 1])
    scale = -math.sqrt(3) / 12 * h**2
    diagonal = h / 2 * jy.sum(1) + scale * cross * (y[:, 0] * j[:, 1] + j[:, 0] * y[:, 1])
    upper = h / 2 * yy.sum(1) + 2 * scale * cross * y[:, 0] * y[:, 1]
    lower = -h / 2 * jj.sum(1) - 2 * scale * cross * j[:, 0] * j[:, 1]
    squared = diagonal**2 + upper * lower
    delta = np.sqrt(np.abs(squared))
    cosh = np.where(squared > 0, np.cosh(delta), np.cos(delta))
    sinh = np.where(squared > 0, np.sinh(delta), np.sin(delta))
    sinhc = np.where(delta < 1e-8, 1, sinh / np.maximum(delta, 1e-8))
    return np.stack((cosh + sinhc * diagonal, sinhc * upper, sinhc * lower, cosh - sinhc * diagonal), 1)


def _spherical_bessel(orders: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """j_l(x) and y_l(x), shape (*x, l); both are 0 where |y_l| exceeds 1e140, far inside the turning point.

    y comes from its upward recurrence, and j from the downward recurrence of ρ_l = j_l/j_{l−1} and the Wronskian
    j_l(ρ_{l+1} y_l − y_{l+1}) = 1/x². This is a hundred times as fast as one call per order. To leave out the region
    where j_l < 1e-140 is exact to rounding, because the regular solution there is j_l times a constant.
    """
    y = np.empty((orders + 1, *x.shape))
    ratio = np.zeros_like(x)
    ratios = np.empty((orders, *x.shape))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        y[0], y[1] = -np.cos(x) / x, -np.cos(x) / x**2 - np.sin(x) / x
        for order in range(1, orders):
            y[order + 1] = (2 * order + 1) / x * y[order] - y[order - 1]
        # The recurrence starts from a wrong value, 0, but so far above order and argument that the error dies out.
        for order in range(max(orders, math.ceil(x.max())) + 80, 0, -1):
            ratio = 1 / ((2 * order + 1) / x - ratio)
            if order <= orders:
                ratios[order - 1] = ratio
        j = 1 / (x**2 * (ratios * y[:-1] - y[1:]))
        valid = np.abs(y[1:]) < 1e140
    j, y = np.where(valid, j, 0), np.where(valid, y[:-1], 0)
    return np.moveaxis(j, 0, -1), np.moveaxis(y, 0, -1)


def _index_at(index: RadialIndex, r: np.ndarray) -> np.ndarray:
    """The radial index at r. Raises ValueError where it is no refractive index."""
    n = np.broadcast_to(np.asarray(index(r), dtype=np.float64), r.shape)
    for value in (n.min(), n.max()):
        require_index("ball", float(value))
    return n
