"""Köhler illumination: the condenser's aperture as weighted plane waves, and the light's wavelengths."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

# Share of the directions at least that passes a pupil which divides the aperture: the image is theirs in the main.
WITHIN = 0.75


@dataclass(frozen=True)
class Spectrum:
    """Light of several wavelengths, whose images add up.

    wavelengths: in vacuum, µm. weights: their shares of what the camera records of the empty bright field (the lamp's
    power times filters times quantum efficiency), made to sum to 1; None means equal ones. The directions n·sinθ of the
    sources are the same for each. Phases given in rad, a prism's bias and Zernike aberrations, hold at each wavelength
    (an achromatic compensator, so that an empty field stays sin²(bias/2)); lengths, a layer's thickness, scale with it.
    Raises ValueError for no wavelengths, one that isn't positive, a negative weight or unequal numbers of the two.
    """

    wavelengths: Sequence[float]
    weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if len(self.wavelengths) == 0:
            raise ValueError("a spectrum needs at least one wavelength")
        for wavelength in self.wavelengths:
            if not (0 < wavelength < math.inf):
                raise ValueError(f"wavelength {wavelength} µm of the spectrum must be above 0")
        object.__setattr__(self, "wavelengths", tuple(self.wavelengths))
        if self.weights is not None:
            if len(self.weights) != len(self.wavelengths):
                raise ValueError(f"spectrum has {len(self.wavelengths)} wavelengths and {len(self.weights)} weights")
            if not (all(weight >= 0 for weight in self.weights) and 0 < sum(self.weights) < math.inf):
                raise ValueError("spectrum weights must be at least 0, with a positive finite sum")
            object.__setattr__(self, "weights", tuple(self.weights))

    @property
    def shares(self) -> tuple[float, ...]:
        """The weights, made to sum to 1."""
        weights = (1.0,) * len(self.wavelengths) if self.weights is None else self.weights
        return tuple(weight / sum(weights) for weight in weights)


@dataclass(frozen=True, eq=False)
class Condenser:
    """A condenser's aperture, filled evenly with mutually incoherent plane waves.

    na: its numerical aperture; 0 is one axial plane wave. points: directions (source, 2), each n·(sinθ_y, sinθ_x) as
    given, in place of the disc of `na`. weights: their shares (source,), made to sum to 1; None means equal ones.
    inner_na: the aperture below which a ring stop blocks the light; None is a disc, `na` itself a ring.
    Raises ValueError for a negative aperture or weight, weights without points, unequal numbers of the two, and an
    inner aperture above `na` or beside points.
    """

    na: float
    points: Float[Tensor, "source 2"] | None = None
    weights: Float[Tensor, " source"] | None = None
    inner_na: float | None = None

    def __post_init__(self) -> None:
        if not (0 <= self.na < float("inf")):
            raise ValueError(f"condenser NA {self.na} must be at least 0")
        if self.inner_na is not None:
            if not (0 <= self.inner_na <= self.na):
                raise ValueError(f"condenser inner NA {self.inner_na} must be from 0 to its NA {self.na}")
            if self.points is not None:
                raise ValueError(
                    f"condenser inner NA {self.inner_na} would stop given points: leave out those it stops"
                )
        if self.points is None:
            if self.weights is not None:
                raise ValueError("condenser weights need the points that they belong to")
            return
        points = torch.as_tensor(self.points, dtype=None if isinstance(self.points, Tensor) else torch.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) == 0:
            raise ValueError(f"condenser points have shape {tuple(points.shape)}, not (source, 2)")
        if not bool(torch.isfinite(points).all()):
            raise ValueError("condenser points must be finite")
        object.__setattr__(self, "points", points)
        if self.weights is not None:
            weights = torch.as_tensor(self.weights)
            if tuple(weights.shape) != (len(points),):
                raise ValueError(f"condenser has {len(points)} points and weights of shape {tuple(weights.shape)}")
            if not (bool((weights >= 0).all()) and 0 < float(weights.sum()) < float("inf")):
                raise ValueError("condenser weights must be at least 0, with a positive finite sum")
            object.__setattr__(self, "weights", weights)

    def sources(
        self,
        count: int,
        *,
        pupil: float | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> tuple[Float[Tensor, "source 2"], Float[Tensor, " source"]]:
        """Directions n·sinθ (source, 2) and weights (source,) of sum 1; at most `count` unless points are given.

        pupil: an objective's NA. Where it divides the aperture, the light within and the light beyond have directions
        of their own (see `aperture_quadrature`).
        """
        if self.points is not None:
            points = self.points
            weights = torch.ones(len(points)) if self.weights is None else self.weights
        elif self.na == 0:
            points, weights = torch.zeros(1, 2), torch.ones(1)
        else:
            rule = aperture_quadrature(count, self.na, self.inner_na or 0.0, pupil)
            points, weights = (torch.from_numpy(a) for a in rule)
        points = points.to(device, dtype or torch.get_default_dtype())
        weights = weights.to(device, torch.float64)
        return points, (weights / weights.sum()).to(points.dtype)


def aperture_quadrature(
    count: int, na: float, inner_na: float = 0.0, pupil: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 2) between two radii and weights (m,) that sum to 1, m ≤ count: `disc_quadrature`, or two of them.

    pupil: a radius at which the integrand jumps, as it does at the edge of the objective's pupil, where direct light
    passes or not. Each side then has a rule of its own, with its area's share of the weight, so that as much direct
    light passes as should; otherwise the empty field would be wrong by the weight of whole rings. Both are `even`. With
    too few points for two rules there is one. Raises ValueError as `disc_quadrature` does.
    """
    least = 1 if inner_na == 0 else 2  # directions within the pupil
    if pupil is None or not inner_na < pupil < na or count < least + 2:
        points, weights = disc_quadrature(count, inner_na / na)
        return na * points, weights
    share = (pupil**2 - inner_na**2) / (na**2 - inner_na**2)
    passing = min(max(round(count * max(share, WITHIN)), least), count - 2)
    within, its = disc_quadrature(passing, inner_na / pupil, even=True)
    beyond, others = disc_quadrature(count - len(its), pupil / na, even=True)
    return np.concatenate((pupil * within, na * beyond)), np.concatenate((share * its, (1 - share) * others))


def disc_quadrature(count: int, hole: float = 0.0, *, even: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Points (m, 2) in the unit disc and weights (m,) that sum to 1, m ≤ count, for the mean over the disc.

    K rings at the Gauss nodes of r², each with M equally spaced azimuths: exact for polynomials of degree below
    min(4K, M). The rings are turned by half a step against each other, so that what their azimuths miss beyond that, up
    to about 2M, nearly cancels: K and M are chosen for it, and where they tie more rings are.
    hole: radius from 0 to 1 within which there is no light; the nodes then lie between hole² and 1, and the narrower
    that interval, the fewer rings it takes. even: whether M must be, where there are four points or more.
    Raises ValueError for no sources, or a single one where there is a hole, which would light from one side.
    """
    if count < 1:
        raise ValueError(f"a condenser needs at least 1 source, not {count}")
    if count == 1:
        if hole > 0:
            raise ValueError("an annular condenser needs at least 2 sources, not 1: a single one lights from one side")
        return np.zeros((1, 2)), np.ones(1)
    width = 1 - hole**2
    step, least = (2, 4) if even and count >= 4 else (1, 1 if hole == 0 else 2)
    fitting = range(1, count // least + 1) if width > 0 else (1,)
    rings, azimuths = max(
        ((k, count // k // step * step) for k in fitting),
        key=lambda rule: (min(2 * rule[0] / width, rule[1]) if width > 0 else 0, rule[0]),
    )
    nodes, node_weights = np.polynomial.legendre.leggauss(rings)
    radius = np.sqrt(hole**2 + width * ((1 + nodes) / 2))
    angle = 2 * np.pi * (np.arange(azimuths)[None, :] + 0.5 * (np.arange(rings)[:, None] % 2)) / azimuths
    points = np.stack((radius[:, None] * np.sin(angle), radius[:, None] * np.cos(angle)), -1).reshape(-1, 2)
    return points, np.repeat(node_weights / 2 / azimuths, azimuths)
