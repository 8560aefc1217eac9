"""Köhler illumination: the condenser's aperture as weighted plane waves, and the light's wavelengths."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

# Where a pupil divides the aperture, at least this share of the directions passes it: most of the image is theirs.
WITHIN = 0.75


@dataclass(frozen=True)
class Spectrum:
    """Light of several wavelengths, whose images add up.

    wavelengths: in vacuum, µm.
    weights: each wavelength's share of the light that the camera records in the empty bright field (the lamp's power
    times filters times quantum efficiency), normalised to sum to 1; None means equal shares.

    The directions n·sinθ of the sources are the same for each wavelength. Phases in rad (a prism's bias, Zernike
    aberrations) hold at each wavelength, as with an achromatic compensator, so that an empty field stays sin²(bias/2).
    The phase of a length in µm, such as a layer's thickness, changes with the wavelength.
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
        """The weights, normalised to sum to 1."""
        weights = (1.0,) * len(self.wavelengths) if self.weights is None else self.weights
        return tuple(weight / sum(weights) for weight in weights)


@dataclass(frozen=True, eq=False)
class Condenser:
    """A condenser's aperture, filled evenly with mutually incoherent plane waves.

    na: numerical aperture; 0 is one axial plane wave.
    points: directions (source, 2), each n·(sinθ_y, sinθ_x), that replace the disc of `na`; None takes the disc.
    weights: the points' shares (source,) of the light, normalised to sum to 1; None means equal shares.
    inner_na: aperture below which a stop blocks the light; None is a full disc, and `na` itself is a thin ring.

    Where `na` exceeds the medium's index, only the aperture below the index lights the specimen, see `limited`.
    Raises ValueError for a negative aperture or weight, weights without points, unequal numbers of the two, and an
    inner aperture that is above `na` or comes with points.
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

    def limited(self, most: float) -> "Condenser":
        """The condenser whose aperture ends at `most`, from which all the light then comes; points stay as they are."""
        return self if self.na <= most else replace(self, na=most)

    def sources(
        self,
        count: int,
        *,
        pupil: float | None = None,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> tuple[Float[Tensor, "source 2"], Float[Tensor, " source"]]:
        """Directions n·sinθ (source, 2) and weights (source,) that sum to 1.

        count: the most directions; given points are used all, whatever the count.
        pupil: NA of the objective. Where it divides the aperture, the light within it and the light beyond it get
        directions of their own, see `aperture_quadrature`.
        dtype, device: of the result.
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
    """Points (m, 2) of a ring or disc and weights (m,) that sum to 1, m ≤ count, for the mean over it.

    count: the most points.
    na, inner_na: its outer and inner radius.
    pupil: a radius at which the integrand jumps: inside the objective's pupil the direct light passes, outside it
    doesn't. Each side then has a rule of its own, with weights that sum to the share of its area. So the right part of
    the direct light passes; a single rule would be wrong by the weight of whole rings.

    Each rule is a `disc_quadrature`, `even` where there are two. Where there are too few points for two rules, there is
    one. Raises ValueError as `disc_quadrature` does.
    """
    least = 1 if inner_na == 0 else 2  # the fewest directions within the pupil
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

    count: the most points.
    hole: radius from 0 to 1 within which there is no light.
    even: whether each ring has an even number of points, so that light comes from opposite sides alike; it takes four
    points or more.

    The points lie on K rings at the Gauss nodes of r², each with M equally spaced azimuths: exact for polynomials of
    degree below min(4K, M). Neighbouring rings are turned against each other by half a step. So their errors beyond
    that degree nearly cancel, up to about degree 2M. K and M are chosen for the highest degree, with more rings where
    two choices tie. Around a hole the nodes lie between hole² and 1; the narrower that interval, the fewer rings.
    Raises ValueError for no sources, or a single source around a hole, whose light would come from one side.
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
