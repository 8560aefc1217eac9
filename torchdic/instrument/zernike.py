"""Zernike polynomials over the pupil, numbered by Noll's index."""

import math

import torch
from torch import Tensor


def zernike(noll: int, rho: Tensor, theta: Tensor) -> Tensor:
    """The Zernike polynomial of a Noll index, of unit rms over the disc ρ ≤ 1.

    noll: index from 1. rho: distance from the axis, in units of the radius. theta: rad from +x towards +y.

    R. J. Noll, J. Opt. Soc. Am. 66, 207 (1976).
    """
    n = (math.isqrt(8 * noll - 7) - 1) // 2
    place = noll - n * (n + 1) // 2
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    radial = torch.zeros_like(rho)
    for k in range((n - m) // 2 + 1):
        factor = math.comb(n - k, k) * math.comb(n - 2 * k, (n - m) // 2 - k)
        radial = radial + (-1) ** k * factor * rho ** (n - 2 * k)
    if m == 0:
        return math.sqrt(n + 1) * radial
    azimuthal = torch.cos(m * theta) if noll % 2 == 0 else torch.sin(m * theta)
    return math.sqrt(2 * (n + 1)) * radial * azimuthal
