"""Signs and orders: which of all descriptions of a stack explains it, by short fits in rounds.

All are tried coarsely, and the best of them more and more carefully, as a race. Each fit is a volume of its own within
the bounds of Δn, so that a sign of Δn that is known tells the sign of the shear.

With weak priors a wrong description explains the images too, by a wild volume. So from the second round on the priors
have one weight, that at which the best volume so far leaves the noise, and what is compared is misfit and priors.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from tqdm import tqdm

from recon.calibration.trials.declared import Otherwise, all_mistakes, images_of
from recon.calibration.trials.short_fits import last_step
from recon.fit.problem import Problem, Recipe
from torchdic import Acquisition
from torchdic.ranks.each import each


class Round(NamedTuple):
    """How many descriptions a round tries at most, the slices of their volumes, steps and condenser directions."""

    most: int
    slices: int
    steps: int
    sources: int


ROUNDS = (Round(10_000, 10, 2, 8), Round(4, 12, 6, 12), Round(2, 20, 8, 18))

# Descriptions of more mistakes than LIKELY are tried only where none of fewer stands out: where the best one leaves
# more than this share of what half of them leave.
LIKELY, STANDS_OUT = 2, 0.5

# A description is preferred to the declared one only where it lowers what that leaves by this share, the noise left
# out: a wrong sign, order or axis leaves far more. Near the noise next to nothing is left, and such a share of it is
# less than what noise moves a misfit by: so it must fall by this many of the misfit's standard errors, too.
LEAST, SURE = 0.05, 3.0

# Makes the problem of an acquisition of the whole stack, with so many slices, by a recipe.
ProblemOf = Callable[[Acquisition, int, Recipe], Problem]


@dataclass(frozen=True, eq=False)
class Tried:
    """A description and its last short fit.

    misfit: of its volume. loss: with the priors. rounds: how many it was in.
    """

    otherwise: Otherwise
    misfit: float
    loss: float
    rounds: int


@dataclass(frozen=True, eq=False)
class Orders:
    """What the short fits say.

    tried: all descriptions, the best first: those of the last round, then those of the one before it. noise: what noise
    leaves of the misfit. chosen: the one to go by. told: whether the images tell it from the next best. rival: another
    one from which they don't, the closest.
    """

    tried: tuple[Tried, ...]
    noise: float
    chosen: Otherwise
    told: bool
    rival: Otherwise | None = None

    def table(self, most: int = 8) -> str:
        """The best descriptions and their misfits over the noise's, as a table; `most` rows."""
        shown = self.tried[:most]
        width = max(len(tried.otherwise.name) for tried in shown)
        unit = "misfit / noise" if self.noise > 0 else "misfit"
        lines = [f"{'what would be wrong':{max(width, 19)}}  {unit:>14}  {'with priors':>11}  rounds"]
        for tried in shown:
            value, loss = (part / (self.noise or 1.0) for part in (tried.misfit, tried.loss))
            mark = "  ←" if tried.otherwise is self.chosen else ""
            lines.append(f"{tried.otherwise.name:{max(width, 19)}}  {value:14.3f}  {loss:11.3f}  {tried.rounds}{mark}")
        if any("prisms" in tried.otherwise.name for tried in shown):
            lines.append(
                "(prisms: of acquisition.prisms, from 1; in order 2, 1 the first images were recorded with prism 2)"
            )
        if len(self.tried) > most:
            lines.append(f"and {len(self.tried) - most} others, which explain less")
        return "\n".join(lines)


def find_orders(declared: Acquisition, problem_of: ProblemOf, recipe: Recipe, noise: Sequence[float] | None) -> Orders:
    """Try all that `recon.calibration.trials.declared` names.

    declared: the whole stack's acquisition. problem_of: see `ProblemOf`. recipe: with bounds and a prior.
    noise: standard deviation of each prism's; None where it isn't known.
    """
    every = all_mistakes(declared)
    likely = [other for other in every if other.mistakes <= LIKELY]
    race = _Race(problem_of, noise)
    race.run(likely, 1, recipe)
    if not race.one_stands_out:
        race.run([other for other in every if other.mistakes > LIKELY], 1, recipe)
    for number in range(2, len(ROUNDS) + 1):
        racing = race.best(ROUNDS[number - 1].most)
        recipe = _held(recipe, _fitted(race.asked(racing[0], number, recipe)).weight)
        race.run(racing, number, recipe)
    ranked = sorted(race.tried.values(), key=lambda tried: (-tried.rounds, tried.loss))
    return _chosen(tuple(ranked), race.alone, race.pixels)


class _Race:
    """Short fits of descriptions, round by round.

    tried: their last ones. alone: what noise leaves of the misfit. pixels: how many count in it.
    """

    def __init__(self, problem_of: ProblemOf, noise: Sequence[float] | None) -> None:
        self._problem_of, self._noise = problem_of, noise
        self.tried: dict[object, Tried] = {}
        self.alone, self.pixels = 0.0, 1

    def run(self, racing: Sequence[Otherwise], number: int, recipe: Recipe) -> None:
        """Fit each description as a round asks for."""
        fits = each(_fitted, (self.asked(other, number, recipe) for other in racing))
        with tqdm(desc=f"signs and orders, round {number} of {len(ROUNDS)}", unit="fit", total=len(racing)) as bar:
            for other, fit in zip(racing, fits, strict=True):
                self.tried[_key(other)] = Tried(other, fit.misfit, fit.misfit if number == 1 else fit.loss, number)
                bar.update()

    def asked(self, other: Otherwise, number: int, recipe: Recipe) -> tuple[Problem, Round]:
        """A description's short fit in a round, as `_fitted` takes it."""
        this = ROUNDS[number - 1]
        problem = self._problem_of(other.acquisition, this.slices, recipe)
        self.alone, self.pixels = problem.misfit.of_noise(self._noise) or 0.0, int(problem.misfit.pixels.sum())
        return problem, this

    def best(self, most: int) -> list[Otherwise]:
        """The best so many of the last round, and the declared one, with which the others are compared."""
        last = max(tried.rounds for tried in self.tried.values())
        ranked = sorted((t for t in self.tried.values() if t.rounds == last), key=lambda tried: tried.loss)
        return [t.otherwise for place, t in enumerate(ranked) if place < most or t.otherwise.mistakes == 0]

    @property
    def one_stands_out(self) -> bool:
        """Whether the best description leaves far less than half of them do."""
        left = sorted(tried.misfit for tried in self.tried.values())
        return left[0] < STANDS_OUT * left[len(left) // 2]


class _ShortFit(NamedTuple):
    """The misfit of a short fit's volume, also with priors, and their weight; infinite and None without a volume."""

    misfit: float = math.inf
    loss: float = math.inf
    weight: float | None = None


def _fitted(asked: tuple[Problem, Round]) -> _ShortFit:
    """A description's short fit; without a volume where its light can't be followed."""
    problem, this = asked
    last = last_step(problem, this.steps, this.sources)
    if last is None:
        return _ShortFit()
    return _ShortFit(last.misfit, last.loss, float(last.weights[-1]["tv"]) if last.weights else None)


def _held(recipe: Recipe, weight: float | None) -> Recipe:
    """The recipe with the priors' weight held at what it came to; as it is where that isn't known."""
    return recipe if recipe.tv != "auto" or weight is None else recipe.held(weight)


def _chosen(ranked: tuple[Tried, ...], noise: float, pixels: int) -> Orders:
    last = [tried for tried in ranked if tried.rounds == len(ROUNDS)]
    declared = next(tried for tried in last if tried.otherwise.mistakes == 0)
    best = last[0]
    by_noise = SURE * max(noise, best.misfit) * math.sqrt(2 / pixels)

    def worse(one: Tried, than: Tried) -> bool:
        """Whether one explains the images so much worse that noise isn't why."""
        return one.loss - than.loss > max(LEAST * (one.loss - noise), by_noise, 1e-12)

    chosen = best if worse(declared, best) else declared
    others = [tried for tried in last if tried is not chosen]
    rivals = [tried for tried in others if not worse(tried, chosen)]
    rival = min(rivals, key=lambda tried: tried.loss, default=None)
    return Orders(ranked, noise, chosen.otherwise, rival is None, rival.otherwise if rival else None)


def _key(other: Otherwise) -> object:
    return images_of(other.acquisition)
