"""Adam's descent from a start to the volume that explains the data, as a generator of steps."""

import copy
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.bounds import Bounds
from recon.fit.misfit import gaussian, spatial_variance
from recon.fit.planned import PlanRecord, current, follow
from recon.fit.prior import magnitude, total_variation
from recon.fit.schedule import cosine, held_then_annealed
from recon.fit.start import linear_start
from torchdic import Acquisition, Fidelity, Grid, Microscope, Volume, image
from torchdic.errors import UnstableError

# Distance in Δn from its bounds that every voxel starts with.
MARGIN = 1e-3


@dataclass(frozen=True)
class Recipe:
    """How to descend; the defaults suit specimens with edges, beads and cells.

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
class Step:
    """One step of a descent, and all that is needed to go on from it: nothing in it changes any more.

    number: steps taken so far. misfit, loss: of the volume before this step. delta: Δn (z, y, x) after it.
    seconds: that the descent has taken, its start included. parameter, optimiser: the learned tensor, Adam's state.
    plans: all made for a tolerance so far, the last being that of the current fidelity.
    """

    number: int
    misfit: float
    loss: float
    delta: Float[Tensor, "z y x"]
    seconds: float
    parameter: Tensor
    optimiser: dict[str, Any]
    plans: tuple[PlanRecord, ...] = ()


def descend(
    data: Float[Tensor, "prism focus y x"],
    grid: Grid,
    background: float,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity | float,
    recipe: Recipe,
    resume: Step | None = None,
) -> Iterator[Step]:
    """Fit a volume to images relative to the empty bright field; yields every step.

    data sets dtype and device. fidelity: or a tolerance of the images, for which one is planned, and again each time
    the volume has doubled; draft_sources then has no say. resume: the step to go on from; the rest is as if there had
    been no interruption.
    Raises ValueError where the data's shape is not the acquisition's, or FloatingPointError where the fit diverges.
    """
    expected = (len(acquisition.prisms), len(acquisition.focus), *grid.shape[1:])
    if tuple(data.shape) != expected:
        raise ValueError(f"the data have shape {tuple(data.shape)}, the acquisition and grid ask for {expected}")
    started = time.perf_counter()
    variance = spatial_variance(data)
    if resume is None:
        first, seconds = 0, 0.0
        parameter = _start(data, grid, background, microscope, acquisition, recipe)
    else:
        first, seconds = resume.number, resume.seconds
        parameter = resume.parameter.to(data).clone()
    plans = () if resume is None else resume.plans
    parameter.requires_grad_(True)
    adam = torch.optim.Adam([parameter], lr=recipe.learning_rate)
    if resume is not None:
        adam.load_state_dict(copy.deepcopy(resume.optimiser))  # Adam works in place

    for number in range(first, recipe.steps):
        adam.param_groups[0]["lr"] = cosine(number, recipe.steps, recipe.learning_rate)
        delta = recipe.bounds.delta(parameter)
        if isinstance(fidelity, Fidelity):
            careful = _draft(fidelity, recipe, number)
        else:
            plans = follow(plans, number, delta, grid, background, microscope, acquisition, fidelity)
            careful = current(plans)
        try:
            images = image(Volume(grid, delta, background), microscope, acquisition, careful)
        except UnstableError as error:
            raise FloatingPointError(f"the descent diverged at step {number + 1}: {error}") from error
        misfit = gaussian(images, data, variance)
        loss = misfit
        tv = held_then_annealed(number, recipe.steps, *recipe.tv)
        if tv > 0:
            loss = loss + tv * total_variation(delta, grid.spacing)
        if recipe.l1 > 0:
            loss = loss + recipe.l1 * magnitude(delta)
        adam.zero_grad()
        loss.backward()
        adam.step()
        misfit, loss = float(misfit.detach()), float(loss.detach())
        delta = recipe.bounds.delta(parameter.detach().clone())
        if not math.isfinite(loss) or not bool(torch.isfinite(delta).all()):
            raise FloatingPointError(f"the descent diverged at step {number + 1}: the loss is {loss:g}")
        lowest = background + float(delta.min())
        if lowest <= 0:
            raise FloatingPointError(f"the descent diverged at step {number + 1}: the index falls to {lowest:g}")
        yield Step(
            number + 1,
            misfit,
            loss,
            delta,
            seconds + time.perf_counter() - started,
            parameter.detach().clone(),
            copy.deepcopy(adam.state_dict()),
            plans,
        )


def _start(
    data: Tensor,
    grid: Grid,
    background: float,
    microscope: Microscope,
    acquisition: Acquisition,
    recipe: Recipe,
) -> Tensor:
    if recipe.start == "linear":
        delta = linear_start(data, grid, background, microscope, acquisition)
    else:
        delta = data.new_zeros(grid.shape)
    return recipe.bounds.parameter(delta, margin=MARGIN)


def _draft(fidelity: Fidelity, recipe: Recipe, number: int) -> Fidelity:
    drafts = recipe.draft_sources is not None and recipe.draft_sources < fidelity.sources
    if drafts and number < 0.6 * recipe.steps:
        return replace(fidelity, sources=recipe.draft_sources)
    return fidelity
