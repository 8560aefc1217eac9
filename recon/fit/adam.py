"""Adam's descent from a start to the volume that explains the data, as a generator of steps."""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from recon.fit.planned import PlanRecord
from recon.fit.problem import Problem
from recon.fit.step import Step, check_convergence
from recon.fit.unknowns import IndexDifference, Unknowns
from recon.prior.base import contrast, weighted
from recon.prior.edges import EDGE
from recon.prior.weight import BEGUN, WeightRecord, record
from torchdic.errors import UnstableError

# Share of the steps before the priors know the specimen's contrast, and steps between two weights that follow the
# noise.
UNTIL_CONTRAST, BETWEEN_WEIGHTS = 0.2, 10

# What the message about a descent that diverged ends with.
ADVICE = "; a smaller learning_rate or more tv may help"


@dataclass(frozen=True)
class _Taken:
    """What a step of Adam found before it moved: misfit and loss, the plans and the priors' weights so far."""

    misfit: float
    loss: float
    plans: tuple[PlanRecord, ...]
    weights: tuple[WeightRecord, ...]


def minimise_by_adam(problem: Problem, resume: Step | None = None) -> Iterator[Step]:
    """Lower the misfit and the priors of a problem by Adam; yields every step.

    resume: the step to go on from; the rest is as if there had been no interruption.
    Raises ValueError where the step has other unknowns, or FloatingPointError where the fit diverges.
    """
    started = time.perf_counter()
    if resume is None:
        unknowns = Unknowns.at_start(problem.unknowns, problem.setup, problem.misfit)
        adam, first, seconds, plans = unknowns.adam(), 0, 0.0, ()
        weights = _first_weight(problem, unknowns)
    else:
        unknowns = Unknowns.restored(problem.unknowns, resume.state, problem.misfit.data.device)
        adam, first, seconds = unknowns.adam(resume.state), resume.number, resume.seconds
        plans, weights = resume.plans, resume.weights

    for step in range(first, problem.steps):
        unknowns.set_rates(adam, step, problem.steps)
        taken = _move(problem, unknowns, adam, step, plans, weights)
        plans, weights = taken.plans, taken.weights
        values = unknowns.values()
        delta = values.get(IndexDifference.name, problem.setup.volume.delta)
        lowest = float(problem.setup.volume.background) + float(delta.min())
        check_convergence(step + 1, taken.loss, values, lowest, ADVICE)
        passed, state = seconds + time.perf_counter() - started, unknowns.state(adam)
        yield Step(step + 1, taken.misfit, taken.loss, delta, passed, values, state, plans, weights)


def _move(
    problem: Problem,
    unknowns: Unknowns,
    adam: torch.optim.Adam,
    step: int,
    plans: tuple[PlanRecord, ...],
    weights: tuple[WeightRecord, ...],
) -> _Taken:
    """Take one step of Adam. plans, weights: so far."""
    setup = unknowns.into(problem.setup)
    fidelity, plans = problem.fidelity.at(step, problem.steps, setup, plans)
    try:
        images = setup.images(fidelity)
    except UnstableError as error:
        raise FloatingPointError(f"the descent diverged at step {step + 1}: {error}{ADVICE}") from error
    misfit = problem.misfit(images)
    delta = setup.volume.delta.detach()
    if step > 0 and step % BETWEEN_WEIGHTS == 0:
        weights = _followed(problem, step, float(misfit.detach()), images.detach(), delta, weights)
    found = (problem.contrast or contrast(delta)) if step >= UNTIL_CONTRAST * problem.steps else 0.0
    priors = [prior.at_contrast(found) for prior in problem.priors]
    loss = misfit
    for weight, prior in weighted(priors, weights[-1]["tv"] if weights else 1.0, step, problem.steps):
        loss = loss + weight * prior(setup.volume)
    adam.zero_grad()
    loss.backward()
    adam.step()
    return _Taken(float(misfit.detach()), float(loss.detach()), plans, weights)


def _first_weight(problem: Problem, unknowns: Unknowns) -> tuple[WeightRecord, ...]:
    """The record of the first weight that follows the noise; none where weights are given."""
    rule = problem.weight
    if rule is None:
        return ()
    found = contrast(unknowns.into(problem.setup).volume.delta.detach())
    first = rule.first if rule.first is not None else BEGUN * problem.setup.dilution / max(found, 1e-4)
    return (record(0, first, "by the contrast"),)


def _followed(
    problem: Problem, step: int, misfit: float, images: Tensor, delta: Tensor, weights: tuple[WeightRecord, ...]
) -> tuple[WeightRecord, ...]:
    """The weights so far, and the one for the next steps where it follows the noise.

    images, delta: current ones. The first weight is held until the priors know the specimen's contrast.
    """
    if problem.weight is None:
        return weights
    before = weights[-1]["misfit"]
    if math.isnan(before):
        before = math.inf if step < UNTIL_CONTRAST * problem.steps else None
    misfit, white = problem.weight.heeded(images, misfit), problem.weight.white(images, problem.misfit)
    width = EDGE * max(contrast(delta), 1e-9) / problem.setup.dilution
    weight, reason = problem.weight.next(weights, misfit, before, white, width)
    return (*weights, record(step + 1, weight, reason, misfit, white))
