"""Specimens that scenes need beside those of `data_synthetic`: several at once, fibres, a graded ellipsoid; and any."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from data_synthetic import Bead, CellPhantom, Ellipsoid, GaussianBall, Organelle, Specimen
from data_synthetic.fill import covered_fraction, require_subpixels
from data_synthetic.specimen import centres, require_above_zero, require_contrast, require_vector
from torchdic import Grid

# How often a part is drawn again before a specimen without room for it is given up.
TRIES = 200


@dataclass(frozen=True)
class Together(Specimen):
    """Several specimens in one medium; where they overlap, their Δn add up.

    parts: at least one. Raises ValueError where their media differ.
    """

    parts: tuple[Specimen, ...]

    def __post_init__(self) -> None:
        media = sorted({part.background for part in self.parts})
        if len(media) != 1:
            raise ValueError(f"specimens lie in media of index {media}: there must be one medium")
        object.__setattr__(self, "background", media[0])

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        return torch.stack([part.delta(grid) for part in self.parts]).sum(0)


@dataclass(frozen=True)
class Fibre(Specimen):
    """A round fibre across the optical axis, with hemispheres at its ends.

    radius: in µm.
    length: in µm between the centres of its ends.
    contrast: Δn inside.
    background: index of the medium.
    angle: in rad from +x towards +y.
    centre: (z, y, x) in µm.
    subpixels: columns per voxel along y and along x, by which each voxel's covered volume is found.
    Raises ValueError for a radius or length not above 0 and for an index below 1.
    """

    radius: float
    length: float
    contrast: float
    background: float
    angle: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    subpixels: int = 4

    def __post_init__(self) -> None:
        require_above_zero("radius", self.radius, "µm")
        require_above_zero("length", self.length, "µm")
        require_contrast("fibre", self.background, self.contrast)
        require_vector("centre", self.centre, "z, y, x")
        require_subpixels(self.subpixels)

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        (cz, cy, cx), sine, cosine = self.centre, math.sin(self.angle), math.cos(self.angle)

        def surfaces(y: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
            along = cosine * (x - cx) + sine * (y - cy)
            beyond = (along.abs() - self.length / 2).clamp_min(0)
            across = cosine * (y - cy) - sine * (x - cx)
            half = (self.radius**2 - across**2 - beyond**2).clamp_min(0).sqrt()
            return cz - half, cz + half

        return self.contrast * covered_fraction(grid, surfaces, self.subpixels)


@dataclass(frozen=True)
class GradedEllipsoid(Specimen):
    """Δn = contrast·(1 − ρ²) within an ellipsoid, a parabola: ρ is 0 at its centre and 1 on its surface.

    A voxel holds the Δn of its centre. Raises ValueError for an index below 1.
    """

    shape: Ellipsoid
    contrast: float
    background: float

    def __post_init__(self) -> None:
        require_contrast("ellipsoid", self.background, self.contrast)

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        terms = [
            ((x - c) / a) ** 2 for x, c, a in zip(centres(grid), self.shape.centre, self.shape.semi_axes, strict=True)
        ]
        return self.contrast * (1 - (terms[0] + terms[1] + terms[2])).clamp_min(0)


def solid(shape: Ellipsoid, contrast: float, background: float) -> CellPhantom:
    """A homogeneous ellipsoid."""
    return CellPhantom(background, Organelle(shape, contrast), None, (), None, None)


def stronger(cell: CellPhantom, factor: float) -> CellPhantom:
    """The same cell with all its Δn times a factor."""

    def scaled(part: Organelle) -> Organelle:
        return replace(part, contrast=factor * part.contrast)

    nucleus, vacuole, lipid = (
        None if part is None else scaled(part) for part in (cell.nucleus, cell.vacuole, cell.lipid)
    )
    nucleoli = tuple(scaled(part) for part in cell.nucleoli)
    return CellPhantom(cell.background, scaled(cell.cytoplasm), nucleus, nucleoli, vacuole, lipid, cell.subpixels)


def any_specimen(
    random: np.random.Generator, extent: tuple[float, float, float], background: float
) -> tuple[str, Specimen]:
    """Draw a kind of specimen and one of that kind, of any size and strength, which leaves a margin to the sides.

    extent: (z, y, x) in µm of the box that it lies in.
    """
    kinds = {"beads": _beads, "cell": _cell, "fibres": _fibres, "graded": _graded, "lower": _lower}
    kind = str(random.choice(list(kinds)))
    return kind, kinds[kind](random, extent, background)


def _strength(random: np.random.Generator) -> float:
    """Δn from 0.008 to 0.05, each factor as likely."""
    return float(math.exp(random.uniform(math.log(0.008), math.log(0.05))))


def _place(random: np.random.Generator, extent: tuple[float, ...], size: float) -> tuple[float, float, float]:
    """A centre (z, y, x) at which a ball of radius `size` leaves a margin: a seventh of the box, a tenth along z."""
    room = [max(e * share - size, 0.0) for e, share in zip(extent, (0.4, 0.357, 0.357), strict=True)]
    z, y, x = (float(random.uniform(-r, r)) for r in room)
    return z, y, x


def _apart(random: np.random.Generator, extent: tuple[float, ...], radii: list[float]) -> list[Ellipsoid]:
    """Balls that don't overlap. Raises ValueError where the box has no room for them."""
    balls: list[Ellipsoid] = []
    for radius in radii:
        for _ in range(TRIES):
            centre = _place(random, extent, radius)
            if all(math.dist(centre, ball.centre) > radius + ball.semi_axes[0] + 0.2 for ball in balls):
                balls.append(Ellipsoid((radius, radius, radius), centre))
                break
        else:
            raise ValueError(f"a ball of radius {radius:.3g} µm found no room in a box of {extent} µm")
    return balls


def _beads(random: np.random.Generator, extent: tuple[float, float, float], background: float) -> Specimen:
    largest = 0.17 * min(extent)
    radii = [float(r) for r in random.uniform(0.4, largest, int(random.integers(1, 5)))]
    balls = _apart(random, extent, sorted(radii, reverse=True))
    contrast = _strength(random)
    shares = random.uniform(0.5, 1.0, len(balls))
    return Together(
        tuple(
            Bead(ball.semi_axes[0], float(contrast * share), background, ball.centre)
            for ball, share in zip(balls, shares, strict=True)
        )
    )


def _cell(random: np.random.Generator, extent: tuple[float, float, float], background: float) -> Specimen:
    """A cell whose organelles are drawn until they lie within it and apart from each other."""
    z, y, x = (float(e * random.uniform(0.24, 0.35)) for e in extent)
    z = min(z, 1.2 * min(y, x))
    contrast = 0.7 * _strength(random)
    body = Organelle(Ellipsoid((z, y, x)), contrast)
    for _ in range(TRIES):
        drawn = {
            "nucleus": (random.uniform(0.3, 0.55), random.uniform(1.2, 1.8)),
            "vacuole": (random.uniform(0.15, 0.35), random.uniform(0.1, 0.6)),
            "lipid": (random.uniform(0.1, 0.2), random.uniform(1.8, 2.5)),
        }
        parts = {}
        for name, (size, strength) in drawn.items():
            axes = tuple(float(a * size * random.uniform(0.85, 1.15)) for a in (z, y, x))
            centre = tuple(float(a * random.uniform(-0.6, 0.6)) for a in (z, y, x))
            shape = Ellipsoid((axes[0], axes[1], axes[2]), (centre[0], centre[1], centre[2]))
            parts[name] = Organelle(shape, float(contrast * strength))
        try:
            return CellPhantom(background, body, parts["nucleus"], (), parts["vacuole"], parts["lipid"])
        except ValueError:  # the parts overlap or stick out
            continue
    raise ValueError(f"no room was found for the organelles of a cell of semi-axes {z:.3g}, {y:.3g}, {x:.3g} µm")


def _fibres(random: np.random.Generator, extent: tuple[float, float, float], background: float) -> Specimen:
    count, contrast, width = int(random.integers(2, 5)), _strength(random), min(extent[1:])
    depths = (np.arange(count) - (count - 1) / 2) * extent[0] * 0.6 / count
    fibres = []
    for depth in depths:
        radius = float(random.uniform(0.25, min(0.7, 0.25 * extent[0] / count)))
        _, y, x = _place(random, extent, 0.3 * width)
        length = float(random.uniform(0.35, 0.6) * width)
        fibres.append(
            Fibre(radius, length, contrast, background, float(random.uniform(0, math.pi)), (float(depth), y, x))
        )
    return Together(tuple(fibres))


def _graded(random: np.random.Generator, extent: tuple[float, float, float], background: float) -> Specimen:
    contrast = _strength(random)
    first, second = _apart(random, extent, [0.2 * min(extent), 0.14 * min(extent)])
    sizes = random.uniform(0.8, 1.2, 3) * first.semi_axes[0] * 1.2
    parabola = Ellipsoid((float(sizes[0]), float(sizes[1]), float(sizes[2])), first.centre)
    sigma = float(0.5 * second.semi_axes[0])
    return Together(
        (
            GradedEllipsoid(parabola, contrast, background),
            GaussianBall(sigma, float(contrast * random.uniform(0.5, 1.2)), background, second.centre),
        )
    )


def _lower(random: np.random.Generator, extent: tuple[float, float, float], background: float) -> Specimen:
    """Holes in the medium: balls and flattened ones of lower index."""
    radii = [float(r) for r in random.uniform(0.5, 0.18 * min(extent), int(random.integers(1, 4)))]
    contrast = -_strength(random)
    holes = []
    for ball in _apart(random, extent, sorted(radii, reverse=True)):
        z, y, x = (float(ball.semi_axes[0] * s) for s in random.uniform(0.7, 1.0, 3))
        holes.append(solid(Ellipsoid((z, y, x), ball.centre), contrast, background))
    return Together(tuple(holes))
