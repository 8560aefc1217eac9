"""What a descent has to do: the images to explain, what is known, what is sought, and how carefully to compute."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from recon.fit.bounds import Bounds
from recon.fit.planned import GivenFidelity, PlannedFidelity
from recon.fit.prior import Magnitude, Prior, TotalVariation
from recon.fit.setup import Setup
from recon.fit.unknowns import IndexDifference, Unknown
from recon.misfit.base import Misfit
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Fidelity


@dataclass(frozen=True)
class Recipe:
    """How to descend. The defaults suit specimens with edges: beads and cells.

    steps: of Adam. learning_rate: its first one, in Δn; it falls to 0 along half a cosine. tv: first and last weight of
    the total variation. l1: weight of the mean |Δn|. bounds: of Δn. start: "linear" or "zero". draft_sources: condenser
    directions for the first 60 % of the steps, where the fidelity asks for more; None is all of them at once.
    Raises ValueError where a value breaks its law.
    """

    steps: int = 150
    learning_rate: float = 5e-3
    tv: tuple[float, float] = (60.0, 5.0)
    l1: float = 0.5
    bounds: Bounds = field(default_factory=Bounds)
    start: Literal["linear", "zero"] = "linear"
    draft_sources: int | None = 24

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps {self.steps} must be at least 1")
        if not (0 < self.learning_rate < math.inf):
            raise ValueError(f"learning_rate {self.learning_rate} must be above 0")
        for name, value in (("tv", self.tv[0]), ("tv", self.tv[1]), ("l1", self.l1)):
            if not (0 <= value < math.inf):
                raise ValueError(f"{name} {value} must be at least 0")
        if self.start not in ("linear", "zero"):
            raise ValueError(f"start {self.start!r} must be 'linear' or 'zero'")
        if self.draft_sources is not None and self.draft_sources < 1:
            raise ValueError(f"draft_sources {self.draft_sources} must be at least 1")


@dataclass(frozen=True, eq=False)
class Problem:
    """All that a descent needs to know. Nothing in it changes, so that it can be solved again.

    setup: the volume, microscope and acquisition as far as they are known; the unknowns replace parts of it.
    misfit: holds the measured images. unknowns: what is sought. priors: what is added to the misfit, in this order.
    fidelity: of the images at each step. steps: how many there are.
    Raises ValueError where the data's shape is not that of the setup's images, or two unknowns share a name.
    """

    setup: Setup
    misfit: Misfit
    unknowns: Sequence[Unknown]
    priors: Sequence[Prior]
    fidelity: GivenFidelity | PlannedFidelity
    steps: int

    def __post_init__(self) -> None:
        expected, found = self.setup.shape, tuple(self.misfit.data.shape)
        if found != expected:
            raise ValueError(f"the data have shape {found}, the acquisition and grid ask for {expected}")
        names = [unknown.name for unknown in self.unknowns]
        if len(set(names)) < len(names):
            raise ValueError(f"two unknowns share a name: {', '.join(names)}")

    @classmethod
    def from_recipe(
        cls,
        data: Tensor,
        setup: Setup,
        fidelity: Fidelity | float,
        recipe: Recipe,
        misfit: Callable[[Tensor], Misfit] = GaussianMisfit,
    ) -> "Problem":
        """The problem of finding Δn as a recipe says.

        data: (prism, focus, y, x), relative to the empty bright field. fidelity: of the modelled images, or a tolerance
        for which one is planned; the recipe's draft_sources is then not used. misfit: makes one from the data.
        """
        unknowns = [IndexDifference(recipe.learning_rate, recipe.bounds, recipe.start)]
        priors = [TotalVariation(*recipe.tv), Magnitude(recipe.l1)]
        if isinstance(fidelity, Fidelity):
            careful = GivenFidelity(fidelity, recipe.draft_sources)
        else:
            careful = PlannedFidelity(fidelity)
        return cls(setup, misfit(data), unknowns, priors, careful, recipe.steps)
