"""Adam's descent from a start to the volume that explains the data, as a generator of steps."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.planned import PlanRecord
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.fit.unknowns import IndexDifference, State, Unknowns
from torchdic import Acquisition, Fidelity, Grid, Microscope
from torchdic.errors import UnstableError

# A step's row of the log: number, misfit, loss, seconds.
Row = tuple[int, float, float, float]


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a descent, and all that is needed to go on from it. Its tensors are not changed afterwards.

    number: steps taken so far. misfit, loss: of the volume before this step. delta: Δn (z, y, x) after it.
    seconds: that the descent has taken, its start included. values: what every unknown stands for after the step, by
    name. state: parameters and Adam's moments, by the unknown's name. plans: all that were made for a tolerance so far;
    the last is that of the current fidelity.
    """

    number: int
    misfit: float
    loss: float
    delta: Float[Tensor, "z y x"]
    seconds: float
    values: dict[str, Tensor]
    state: State
    plans: tuple[PlanRecord, ...] = ()

    @property
    def row(self) -> Row:
        """The step's row of the log."""
        return self.number, self.misfit, self.loss, self.seconds


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
    """Fit a volume of Δn to images; yields every step.

    data: (prism, focus, y, x), relative to the empty bright field; their dtype and device are the volume's.
    grid: of the volume. background: index of the medium. microscope, acquisition: what the data were recorded with.
    fidelity: of the modelled images, or a tolerance of these, for which one is planned, and again each time the volume
    has doubled; draft_sources then has no say. recipe: how to descend.
    resume: the step to go on from; the rest is as if there had been no interruption.
    Raises ValueError where the data's shape is not the acquisition's, or FloatingPointError where the fit diverges.
    """
    setup = Setup(empty_medium(grid, background, data), microscope, acquisition)
    yield from minimise(Problem.from_recipe(data, setup, fidelity, recipe), resume)


def minimise(problem: Problem, resume: Step | None = None) -> Iterator[Step]:
    """Lower the misfit and the priors of a problem by Adam; yields every step.

    resume: the step to go on from; the rest is as if there had been no interruption.
    Raises ValueError where the step has other unknowns, or FloatingPointError where the fit diverges.
    """
    started = time.perf_counter()
    if resume is None:
        unknowns = Unknowns.at_start(problem.unknowns, problem.setup, problem.misfit)
        adam, first, seconds, plans = unknowns.adam(), 0, 0.0, ()
    else:
        unknowns = Unknowns.restored(problem.unknowns, resume.state, problem.misfit.data.device)
        adam, first, seconds, plans = unknowns.adam(resume.state), resume.number, resume.seconds, resume.plans

    for step in range(first, problem.steps):
        unknowns.set_rates(adam, step, problem.steps)
        misfit, loss, plans = _move(problem, unknowns, adam, step, plans)
        values = unknowns.values()
        delta = values.get(IndexDifference.name, problem.setup.volume.delta)
        _check_convergence(step + 1, loss, values, float(problem.setup.volume.background) + float(delta.min()))
        taken = seconds + time.perf_counter() - started
        yield Step(step + 1, misfit, loss, delta, taken, values, unknowns.state(adam), plans)


def _move(
    problem: Problem, unknowns: Unknowns, adam: torch.optim.Adam, step: int, plans: tuple[PlanRecord, ...]
) -> tuple[float, float, tuple[PlanRecord, ...]]:
    """Take one step of Adam; returns the misfit and the loss before it, and the plans so far."""
    setup = unknowns.into(problem.setup)
    fidelity, plans = problem.fidelity.at(step, problem.steps, setup, plans)
    try:
        images = setup.images(fidelity)
    except UnstableError as error:
        raise FloatingPointError(f"the descent diverged at step {step + 1}: {error}") from error
    misfit = problem.misfit(images)
    loss = misfit
    for prior in problem.priors:
        weight = prior.weight(step, problem.steps)
        if weight > 0:
            loss = loss + weight * prior(setup.volume)
    adam.zero_grad()
    loss.backward()
    adam.step()
    return float(misfit.detach()), float(loss.detach()), plans


def _check_convergence(number: int, loss: float, values: dict[str, Tensor], lowest: float) -> None:
    """Raise FloatingPointError where a step led to numbers that are not finite, or to an index that isn't positive."""
    if not math.isfinite(loss) or not all(bool(torch.isfinite(value).all()) for value in values.values()):
        raise FloatingPointError(f"the descent diverged at step {number}: the loss is {loss:g}")
    if lowest <= 0:
        raise FloatingPointError(f"the descent diverged at step {number}: the index falls to {lowest:g}")
