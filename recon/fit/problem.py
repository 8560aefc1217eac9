"""What a descent has to do: the images to explain, what is known, what is sought, and how carefully to compute."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

from recon.fit.bounds import Bounds, SupportedBounds
from recon.fit.nuisances.light import Brightness, RelativeBrightness
from recon.fit.nuisances.named import NUISANCES
from recon.fit.planned import GivenFidelity, PlannedFidelity
from recon.fit.setup import Setup
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference, Unknown
from recon.misfit.base import Misfit
from recon.misfit.gaussian import GaussianMisfit
from recon.prior.base import Prior
from recon.prior.edges import Edges, LogTotalVariation, Smoothness, TotalVariation
from recon.prior.magnitude import Magnitude
from recon.prior.weight import FollowsNoise
from recon.recording.background import known_levels, noise_level
from torchdic import Fidelity

# Steps at most, and condenser directions of draft images, of each descent.
STEPS = {"newton": 20, "adam": 150}
DRAFT_SOURCES = {"newton": 32, "adam": 24}

# The methods without a descent, see `recon.earlier`.
DIRECT = ("linear", "opl")

# The priors of edges by their names.
PRIORS: dict[str, type[Edges]] = {"log-tv": LogTotalVariation, "tv": TotalVariation, "smooth": Smoothness}

# Weight of the mean |Δn|: relative to that of the edges, where it follows the noise, and by itself.
SPARSE, ALONE = 0.25, 0.5


@dataclass(frozen=True)
class Recipe:
    """How to descend. The defaults suit specimens with edges: beads and cells.

    method: "newton", the proximal Newton descent; "adam"; or, without a descent, "linear" and "opl" (`recon.earlier`).
    steps: at most; None is 20 of Newton's, which end by themselves, and 150 of Adam's.
    learning_rate: Adam's first one, in Δn; it falls to 0 along half a cosine.
    tv: weight of the prior of edges: "auto" follows the noise; or the first and the last.
    l1: weight of the mean |Δn|; None is a quarter of tv where that follows the noise, and 0.5 where it is given.
    prior: of edges: "log-tv" (few, however high), "tv" (few), "smooth" (none).
    misfit: "gaussian", "poisson" or "robust".
    learn: what is fitted beside Δn: "bias", "drift", "focus", "shear"; "brightness" of each image always is.
    bounds: of Δn. start: of Adam, "linear" or "zero"; Newton's is empty.
    draft_sources: condenser directions of Adam's first 60 % of the steps, and of all of Newton's, where the fidelity
    asks for more; "auto" is 24 and 32, None is all of them at once.
    Raises ValueError where a value breaks its law.
    """

    method: Literal["newton", "adam", "linear", "opl"] = "newton"
    steps: int | None = None
    learning_rate: float = 5e-3
    tv: Literal["auto"] | tuple[float, float] = "auto"
    l1: float | None = None
    prior: Literal["log-tv", "tv", "smooth"] = "log-tv"
    misfit: Literal["gaussian", "poisson", "robust"] = "gaussian"
    learn: tuple[str, ...] = ()
    bounds: Bounds = field(default_factory=Bounds)
    start: Literal["linear", "zero"] = "linear"
    draft_sources: int | Literal["auto"] | None = "auto"

    def __post_init__(self) -> None:
        if self.method not in (*STEPS, *DIRECT):
            raise ValueError(f"method {self.method!r} must be 'newton', 'adam', 'linear' or 'opl'")
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps {self.steps} must be at least 1")
        if not (0 < self.learning_rate < math.inf):
            raise ValueError(f"learning_rate {self.learning_rate} must be above 0")
        weights = () if self.tv == "auto" else (("tv", self.tv[0]), ("tv", self.tv[1]))
        for name, value in (*weights, ("l1", self.l1)):
            if value is not None and not (0 <= value < math.inf):
                raise ValueError(f"{name} {value} must be at least 0")
        if self.start not in ("linear", "zero"):
            raise ValueError(f"start {self.start!r} must be 'linear' or 'zero'")
        if isinstance(self.draft_sources, int) and self.draft_sources < 1:
            raise ValueError(f"draft_sources {self.draft_sources} must be at least 1")
        for name in self.learn:
            if name not in NUISANCES:
                raise ValueError(f"learn {name!r} must be one of {', '.join(map(repr, NUISANCES))}")
        if len(set(self.learn)) < len(self.learn):
            raise ValueError(f"learn {list(self.learn)} names one twice")

    @property
    def descent(self) -> str:
        """The descent whose constants count: the method, or Newton's where there is no descent."""
        return self.method if self.method in STEPS else "newton"

    @property
    def most_steps(self) -> int:
        """The number of steps at most."""
        return self.steps or STEPS[self.descent]

    @property
    def drafts(self) -> int | None:
        """Condenser directions of draft images; None is all."""
        return DRAFT_SOURCES[self.descent] if self.draft_sources == "auto" else self.draft_sources

    @property
    def sparse(self) -> float:
        """Weight of the mean |Δn|, relative to that of the edges where it follows the noise."""
        return self.l1 if self.l1 is not None else SPARSE if self.tv == "auto" else ALONE

    def held(self, weight: float) -> "Recipe":
        """The recipe whose priors keep a weight that followed the noise."""
        return replace(self, tv=(weight, weight), l1=self.sparse * weight)

    def priors(self) -> list[Prior]:
        """The priors, with weights relative to the common one where that follows the noise."""
        first, last = (1.0, 1.0) if self.tv == "auto" else self.tv
        return [PRIORS[self.prior](first, last), Magnitude(self.sparse)]

    def unknowns(self) -> list[Unknown]:
        """Δn, and what is learned beside it. Brightness comes first, as it is always learned."""
        others = [NUISANCES[name]() for name in self.learn if name != "brightness"]
        brightness = RelativeBrightness() if "bias" in self.learn else Brightness()
        index = IndexDifference(self.learning_rate, self.bounds, self.start)
        return [index, brightness, *others]


@dataclass(frozen=True, eq=False)
class Problem:
    """All that a descent needs to know. Nothing in it changes, so that it can be solved again.

    setup: the volume, microscope and acquisition as far as they are known; the unknowns replace parts of it.
    misfit: holds the measured images. unknowns: what is sought. priors: what is added to the misfit, in this order.
    fidelity: of the images at each step. steps: how many there are at most. method: of the descent, "newton" or "adam".
    weight: a common factor of the priors that follows the noise; None is 1. contrast: the specimen's typical Δn, which
    the priors go by where it is known from elsewhere; None is that of the volume as it is found.
    Raises ValueError where the data's shape is not that of the setup's images, or two unknowns share a name.
    """

    setup: Setup
    misfit: Misfit
    unknowns: Sequence[Unknown]
    priors: Sequence[Prior]
    fidelity: GivenFidelity | PlannedFidelity
    steps: int
    method: str = "adam"
    weight: FollowsNoise | None = None
    contrast: float | None = None

    def __post_init__(self) -> None:
        expected, found = self.setup.shape, tuple(self.misfit.data.shape)
        if found != expected:
            raise ValueError(f"the data have shape {found}, the acquisition and grid ask for {expected}")
        names = [unknown.name for unknown in self.unknowns]
        if len(set(names)) < len(names):
            raise ValueError(f"two unknowns share a name: {', '.join(names)}")

    @property
    def support(self) -> Bool[Tensor, "z y x"] | None:
        """The voxels in which Δn is sought; None is all."""
        for unknown in self.unknowns:
            if isinstance(unknown, IndexDifference) and isinstance(unknown.bounds, SupportedBounds):
                return unknown.bounds.support
        return None

    def again(self, misfit: Misfit, last: Step, given: Tensor | None = None) -> "Problem":
        """The problem of other images, to be solved as this one was in the end: with its last weight and fidelity.

        misfit: holds the other images. last: step of this problem's descent. given: Δn (z, y, x) to start from, with
        the priors' last weights; None starts anew.
        Raises ValueError where the images' shape is another one.
        """
        unknowns = [replace(u, given=given) if isinstance(u, IndexDifference) else u for u in self.unknowns]
        priors, weight = self.priors, self.weight
        if given is not None:
            priors = [replace(p, first=p.last) if isinstance(p, Edges) else p for p in priors]
        if weight is not None:
            # of a descent too short for any, the first one, by the contrast
            weight = replace(weight, first=last.weights[-1]["tv"] if last.weights else weight.first, held=True)
        careful = self.fidelity
        fidelity = GivenFidelity(careful.last(last.plans), careful.draft_sources, careful.matrices)
        return replace(self, misfit=misfit, unknowns=unknowns, priors=priors, fidelity=fidelity, weight=weight)

    @classmethod
    def from_recipe(
        cls,
        data: Tensor,
        setup: Setup,
        fidelity: Fidelity | float,
        recipe: Recipe,
        misfit: Callable[[Tensor], Misfit] = GaussianMisfit,
        noise: Sequence[float] | None = None,
        support: Bool[Tensor, "z y x"] | None = None,
    ) -> "Problem":
        """The problem of finding Δn as a recipe says.

        data: (prism, focus, y, x), relative to the empty bright field. fidelity: of the modelled images, or a tolerance
        for which one is planned. misfit: makes one from the data. noise: standard deviation of the noise in each
        prism's images, in the unit of the data; None is measured in them. support: the voxels of the field in which Δn
        is sought (True), beyond which it is 0; None is all. In a margin it goes on as at the field's edge.
        Raises ValueError where the support isn't of the field's shape or holds no voxel, and as the class does.
        """
        made = misfit(data)
        if isinstance(fidelity, Fidelity):
            careful = GivenFidelity(fidelity, recipe.drafts)
        else:
            careful = PlannedFidelity(fidelity, recipe.drafts)
        weight = None
        if recipe.tv == "auto":
            levels = measured_noise(data, made.mask) if noise is None else list(noise)
            known = made.of_noise(levels) if made.knows_all else None
            weight = FollowsNoise(known, int(made.pixels.sum()))
        if support is not None:
            recipe = replace(recipe, bounds=_supported(recipe.bounds, support.to(data.device), setup))
        unknowns, priors = recipe.unknowns(), recipe.priors()
        return cls(setup, made, unknowns, priors, careful, recipe.most_steps, recipe.descent, weight)


def _supported(bounds: Bounds, support: Bool[Tensor, "z y x"], setup: Setup) -> SupportedBounds:
    """Bounds within a support of the field, which goes on in the margin."""
    if tuple(support.shape) != setup.field.shape:
        raise ValueError(f"the support has shape {tuple(support.shape)}, the field {setup.field.shape} (z, y, x)")
    if setup.margin > 0:
        support = F.pad(support[None].float(), (setup.margin,) * 4, mode="replicate")[0] > 0
    return SupportedBounds(bounds.lower, bounds.upper, support)


def measured_noise(data: Tensor, mask: Tensor | None = None) -> list[float] | None:
    """Standard deviation of the noise in each prism's images; None where they are too small to tell.

    mask: the pixels that count (True); None is all.
    """
    known = data.detach() if mask is None else data.detach().masked_fill(~mask, math.nan)
    return known_levels(noise_level(images) for images in known.cpu().numpy())
