"""A test of a few seconds of what an installation computes: images against stored ones, a gradient, and a fit."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from data_synthetic import Bead
from recon.fit.bounds import Bounds
from recon.fit.descent import descend
from recon.fit.problem import Recipe
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

# The images of the bead in float64, as they were when the laws of the tests were met.
STORED = Path(__file__).with_name("selftest.npy")

GRID, BACKGROUND = Grid((8, 28, 28), (0.4, 0.2, 0.2)), 1.36
BEAD = Bead(1.2, 0.03, BACKGROUND, (0.1, 0.2, -0.3))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
SHAPE = (2, 3, 28, 28)
ACQUISITION = Acquisition([Prism((0.0, 0.24), bias) for bias in (1.4, -1.4)], (-1.0, 0.0, 1.0))
FIDELITY = Fidelity("wave", sources=16)

# How far images may be off the stored ones, by rounding; a gradient off finite differences, relative to them; and how
# far above the noiseless misfit 0 a fit may end, where 1 is an empty volume.
IMAGES, GRADIENT, FIT = 2e-5, 1e-3, 0.05
# A step of the finite difference, in units of Δn.
STEP = 1e-5
STEPS = 8


class SelfTestError(RuntimeError):
    """The self-test failed: this installation computes something else than it should, or is damaged."""


@dataclass(frozen=True)
class Outcome:
    """Of one part of the test. what: was tried. error, limit: how far it is off, and may be."""

    what: str
    error: float
    limit: float

    @property
    def passed(self) -> bool:
        """Whether the error is within its limit."""
        return self.error <= self.limit


def outcomes(device: torch.device) -> Iterator[Outcome]:
    """Each part of the test, as it is done."""
    stored = torch.from_numpy(_stored()).to(device)
    found = images(BEAD.delta(GRID, dtype=torch.float32).to(device))
    yield Outcome("images against stored ones", float((found - stored).abs().max()), IMAGES)
    yield Outcome("gradient against finite differences", _gradient_error(), GRADIENT)
    recipe = Recipe(bounds=Bounds(0.0, None), steps=STEPS, tv=(0.1, 0.1))
    *_, last = descend(stored, GRID, BACKGROUND, MICROSCOPE, ACQUISITION, FIDELITY, recipe)
    yield Outcome("misfit of a volume fitted to them", last.misfit, FIT)


def _stored() -> NDArray[np.float32]:
    """The stored images. Raises SelfTestError where they are damaged."""
    try:
        stored = np.load(STORED)
    except (OSError, ValueError, EOFError) as error:
        raise SelfTestError(f"{STORED}: can't be read ({error}): install torchdic again") from error
    if stored.shape != SHAPE or not np.isfinite(stored).all():
        raise SelfTestError(f"{STORED}: isn't what was installed: install torchdic again")
    return stored


def images(delta: Tensor) -> Tensor:
    """The images of a Δn (z, y, x) by the test's microscope: (prism, focus, y, x)."""
    return image(Volume(GRID, delta, BACKGROUND), MICROSCOPE, ACQUISITION, FIDELITY)


def _gradient_error() -> float:
    """Relative to the finite difference along a direction; in float64, on the processor."""
    random = torch.Generator().manual_seed(0)
    delta = BEAD.delta(GRID, dtype=torch.float64)
    along, weights = (torch.randn(shape, generator=random, dtype=torch.float64) for shape in (GRID.shape, SHAPE))

    def value(at: Tensor) -> Tensor:
        return (weights * images(at)).sum()

    leaf = delta.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    told = float((gradient * along).sum())
    with torch.no_grad():
        difference = float(value(delta + STEP * along) - value(delta - STEP * along)) / (2 * STEP)
    return abs(told - difference) / max(abs(difference), math.ulp(1.0))
