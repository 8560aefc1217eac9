"""How long a descent will take: foreseen before its first step, and followed as its steps are taken."""

import warnings
from collections import deque
from collections.abc import MutableMapping
from dataclasses import replace
from statistics import mean
from typing import Any

import torch
from tqdm import tqdm

from recon.fit.newton.correction import drafts
from recon.fit.newton.descent import coarse_steps, expected_misled
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem
from torchdic import Acquisition, Fidelity, Microscope, Volume
from torchdic.instrument.microscope import limited
from torchdic.planning.cost import directions, timed, work
from torchdic.ranks.group import rank
from torchdic.scalar import number

# What things cost, in images: an image with its gradient; of a Newton step, the model's minimum, in images of a single
# direction; the weak specimen's Hessian of some directions, in images of them; how often the correction is renewed; and
# what draft images miss of the careful ones, to first order, in images of both.
WITH_GRADIENT, MODEL, HESSIAN, RENEWED, MISSED = 2.75, 100.0, 4.0, 1 / 3, 0.7
# Steps whose seconds are averaged.
LAST = 3
# Newton's steps end by themselves, as a rule after about so many.
USUAL_STEPS = 17
# The first images of a process take longer, and the first of a scene that fills its budget of memory by a second or
# two, in which what it holds is measured. A trial of at most SHORT seconds is made TRIALS times more, one of at most
# LONG once.
SHORT, TRIALS, LONG = 0.5, 3, 15.0


class Forecast:
    """The seconds that are left of a descent.

    A step's cost is known in images, and its seconds from the steps of its kind that have been taken; before there are
    any, from those of another kind, or from a trial: an image of the first step, with its gradient, that is timed.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._trial: float | None = None
        self._misled = False
        self._costs = _costs(problem)
        self._last: deque[tuple[float, float]] = deque(maxlen=LAST)
        self._of_kind: dict[float, deque[float]] = {}

    def of_another(self, problem: Problem) -> "Forecast":
        """That of another descent, whose steps take for their cost what they have taken in this one."""
        other = Forecast(problem)
        other._trial, other._of_kind = self._rate(), self._of_kind
        if self._misled:
            other._misled, other._costs = True, _costs(problem, misled=True)
        return other

    @property
    def untried(self) -> bool:
        """Whether nothing has been timed yet."""
        return self._trial is None and not self._last

    def cost(self, number: int) -> float:
        """What a step costs, in the work of its images. number: counted from 0."""
        return self._costs[number]

    def taken(self, number: int, spent: float) -> None:
        """Note the seconds that a step took; number: counted from 1."""
        cost = self._costs[number - 1]
        self._last.append((cost, spent))
        self._of_kind.setdefault(cost, deque(maxlen=LAST)).append(spent)

    def whole(self, number: int = 0) -> float | None:
        """The seconds that a descent will take after a step, if it ends when descents do; None is unknown.

        The first call makes the trial. number: steps so far. Raises as the images of a step do.
        """
        if self.untried and (first := _first(self._problem)) is not None:
            self._trial = _trial(self._problem, first) / (WITH_GRADIENT * work(first, *_scene(self._problem)))
            if _expected_misled(self._problem):
                self._misled, self._costs = True, _costs(self._problem, misled=True)
        usual = USUAL_STEPS if self._problem.method == "newton" else len(self._costs)
        rate = self._rate()
        return None if rate is None else rate * sum(self._costs[number : max(usual, number + 1)])

    def left(self, number: int) -> float | None:
        """The seconds that the steps after one will take, if all are taken. number: steps so far. None is unknown."""
        rate = self._rate() if number < len(self._costs) else 0.0
        if rate is None:
            return None
        known = {cost: mean(seconds_taken) for cost, seconds_taken in self._of_kind.items()}
        return sum(known.get(cost, rate * cost) for cost in self._costs[number:])

    def _rate(self) -> float | None:
        """Seconds for each unit of cost."""
        if self._last:
            costs, spent = (sum(column) for column in zip(*self._last, strict=True))
            return spent / costs
        return self._trial


def spoken(seconds: float) -> str:
    """A time in words."""
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"


def _first(problem: Problem) -> Fidelity | None:
    """The fidelity of the first step; None where it has yet to be planned."""
    if problem.method == "newton":
        return drafts(problem.fidelity.coarse, problem.fidelity.draft_sources)[0]
    if not isinstance(problem.fidelity, GivenFidelity):
        return None
    return problem.fidelity.at(0, problem.steps, problem.setup, ())[0]


def _trial(problem: Problem, fidelity: Fidelity) -> float:
    """The seconds of an image with its gradient."""
    setup, device = problem.setup, problem.misfit.data.device

    def image_with_gradient() -> None:
        delta = problem.misfit.data.new_zeros(setup.volume.grid.shape).requires_grad_()
        volume = Volume(setup.volume.grid, delta, setup.volume.background, setup.volume.absorption)
        images = replace(setup, volume=volume).images(fidelity)
        torch.autograd.grad(problem.misfit(images), delta)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the descent's own images will warn
        (first,) = timed(image_with_gradient, 1, device)
        if first > LONG:
            return first
        return min(timed(image_with_gradient, TRIALS if first <= SHORT else 1, device))


def _scene(problem: Problem) -> tuple[Volume, Microscope, Acquisition]:
    """What the images of a problem are made of, lit by the light that enters the medium."""
    setup = problem.setup
    volume = setup.volume
    return volume, limited(setup.microscope, number(volume.background), volume.delta.dtype), setup.acquisition


def _careful(problem: Problem) -> Fidelity | None:
    """The fidelity of the last steps; None where it has yet to be planned."""
    return problem.fidelity.fidelity if isinstance(problem.fidelity, GivenFidelity) else None


def _expected_misled(problem: Problem) -> bool:
    """Whether Newton's later steps will probably have all directions, for few mislead."""
    if problem.method != "newton" or problem.steps <= coarse_steps(problem) or _careful(problem) is None:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the descent's own images will warn
        return expected_misled(problem)


def _costs(problem: Problem, misled: bool = False) -> list[float]:
    """What each step costs, in the work of its images. misled: whether few directions mislead Newton's later steps."""
    return [_cost(problem, number, misled) for number in range(problem.steps)]


def _cost(problem: Problem, number: int, misled: bool) -> float:
    """What a step costs, see `_costs`; number: counted from 0."""
    setup, scene = problem.setup, _scene(problem)
    careful = _careful(problem)
    if problem.method == "adam":
        if careful is None:
            return 1.0
        fidelity, _ = problem.fidelity.at(number, problem.steps, setup, ())
        return WITH_GRADIENT * work(fidelity, *scene)
    careful = careful or problem.fidelity.coarse
    coarse, fine = drafts(careful, problem.fidelity.draft_sources)
    if misled:
        _, fine = drafts(careful, None)
    first = coarse_steps(problem)
    draft = coarse if number < first else fine
    each = work(draft, *scene)
    cost = WITH_GRADIENT * each + MODEL * each / directions(scene[1], draft.sources)
    if number in (0, first):
        cost += HESSIAN * each
    if number >= first and fine != careful:
        exact = work(careful, *scene)
        cost += exact + MISSED * (exact + each) if number == first else RENEWED * exact
    return cost


class Bar(tqdm):
    """A progress bar over a descent's steps, whose time left is the forecast's; of several processes, the first's."""

    def __init__(self, forecast: Forecast, total: int, initial: int) -> None:
        self._forecast = forecast
        self._left: float | None = forecast.left(initial)
        form = "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} steps [{elapsed}, {left}{postfix}]"
        super().__init__(total=total, initial=initial, bar_format=form, disable=rank() > 0)

    def step(self, number: int, spent: float, misfit: float) -> None:
        """Show a step. number: counted from 1. spent: seconds that it took. misfit: before it."""
        self._forecast.taken(number, spent)
        self._left = self._forecast.left(number)
        self.set_postfix(misfit=f"{misfit:.4g}", refresh=False)
        self.update()

    @property
    def format_dict(self) -> MutableMapping[str, Any]:
        """What the bar shows."""
        left = "time unknown" if self._left is None else f"{self.format_interval(self._left)} left"
        return {**super().format_dict, "left": left}
