"""The partial waves that a homogeneous sphere scatters: scalar Helmholtz equation.

With ψ and ∂ψ/∂r continuous at the surface r = a, and with k = 2πn/λ outside and k1 inside,
    outside  ψ = Σ (2l+1) i^l [j_l(kr) + a_l h_l(kr)] P_l(cosγ),
    inside   ψ = Σ (2l+1) i^l b_l j_l(k1 r) P_l(cosγ),
    a_l = [k1 j_l'(k1 a) j_l(ka) − k j_l'(ka) j_l(k1 a)]/d_l,    b_l = i/(k a² d_l),
    d_l = k h_l'(ka) j_l(k1 a) − k1 j_l'(k1 a) h_l(ka),
where h_l is the outgoing Hankel function h_l⁽¹⁾ and γ the angle from the source's direction. Far away the
scattered wave is f(cosγ)·e^{ikr}/r with f = (1/ik) Σ (2l+1) a_l P_l(cosγ).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legval
from scipy.special import spherical_jn, spherical_yn

from data_synthetic.specimen import require_above_zero, require_index


@dataclass(frozen=True)
class ScatteredWaves:
    """The partial waves that a ball scatters.

    k: wavenumber outside the ball in rad/µm.
    a: coefficients a_l, complex, shape (l,).
    """

    k: float
    a: np.ndarray

    def amplitude(self, cosine: np.ndarray) -> np.ndarray:
        """f(cosγ) in µm, by Clenshaw's recurrence."""
        orders = np.arange(len(self.a))
        return legval(cosine, (2 * orders + 1) * self.a / (1j * self.k))

    def scattered(self, r: np.ndarray) -> np.ndarray:
        """a_l·h_l(kr), shape (l, place)."""
        orders = np.arange(len(self.a))[:, None]
        return self.a[:, None] * (spherical_jn(orders, self.k * r) + 1j * spherical_yn(orders, self.k * r))


@dataclass(frozen=True)
class PartialWaves(ScatteredWaves):
    """The partial waves of a homogeneous sphere, inside it too.

    k1: wavenumber inside in rad/µm.
    b: coefficients b_l, complex, shape (l,).
    """

    k1: float
    b: np.ndarray

    def inside(self, r: np.ndarray) -> np.ndarray:
        """b_l·j_l(k1 r), shape (l, place)."""
        return self.b[:, None] * spherical_jn(np.arange(len(self.b))[:, None], self.k1 * r)


def partial_waves(wavelength: float, radius: float, n_sphere: float, n_medium: float) -> PartialWaves:
    """Solve the matching conditions at the sphere's surface; the module's docstring has the equations."""
    require_above_zero("wavelength", wavelength, "µm")
    require_above_zero("radius", radius, "µm")
    require_index("sphere", n_sphere)
    require_index("medium", n_medium)
    k, k1 = 2 * math.pi * n_medium / wavelength, 2 * math.pi * n_sphere / wavelength
    orders = np.arange(number_of_orders(max(k, k1) * radius))
    j, dj = spherical_jn(orders, k * radius), spherical_jn(orders, k * radius, derivative=True)
    y, dy = spherical_yn(orders, k * radius), spherical_yn(orders, k * radius, derivative=True)
    j1, dj1 = spherical_jn(orders, k1 * radius), spherical_jn(orders, k1 * radius, derivative=True)
    d = k * (dj + 1j * dy) * j1 - k1 * dj1 * (j + 1j * y)
    return PartialWaves(k, (k1 * dj1 * j - k * dj * j1) / d, k1, 1j / (k * radius**2 * d))


def number_of_orders(size: float) -> int:
    """How many partial waves a ball of size parameter k·radius needs in double precision."""
    # Wiscombe's (1980) number of terms reaches 1e-8; ten more reach double precision.
    return math.ceil(size + 4.05 * size ** (1 / 3) + 12)
