"""A specimen of any kind, size and strength, drawn at random."""

import math

import numpy as np

from data_synthetic.ball import GaussianBall
from data_synthetic.bead import Bead
from data_synthetic.cell import CellPhantom, Organelle
from data_synthetic.ellipsoid import Ellipsoid
from data_synthetic.scenes.fibre import Fibre
from data_synthetic.scenes.graded import GradedEllipsoid
from data_synthetic.scenes.together import Together
from data_synthetic.specimen import Specimen

# How often a part is drawn again before a specimen without room for it is given up.
TRIES = 200


def solid(shape: Ellipsoid, contrast: float, background: float) -> CellPhantom:
    """A homogeneous ellipsoid."""
    return CellPhantom(background, Organelle(shape, contrast), None, (), None, None)


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
