"""Signs and orders: which of all descriptions of a stack explains it, by short fits in rounds.

All are tried coarsely, and the best of them more and more carefully, as a race. Each fit is a volume of its own within
the bounds of Δn, so that a sign of Δn that is known tells the sign of the shear.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from recon.calibration.declared import Otherwise, all_mistakes, images_of
from recon.calibration.short_fits import short_fit
from recon.fit.problem import Problem
from torchdic import Acquisition

# Of each round: how many descriptions are tried at most, the slices of their volumes, steps and condenser directions.
ROUNDS = ((10_000, 10, 2, 8), (4, 12, 4, 12), (2, 20, 6, 18))

# A description is preferred to the declared one only where it explains this share of what that leaves unexplained: a
# wrong sign, order or axis leaves far more.
LEAST = 0.2

# Makes the problem of an acquisition of the whole stack, with so many slices.
ProblemOf = Callable[[Acquisition, int], Problem]


@dataclass(frozen=True, eq=False)
class Tried:
    """A description and the misfit of its last short fit. rounds: how many it was in."""

    otherwise: Otherwise
    misfit: float
    rounds: int


@dataclass(frozen=True, eq=False)
class Orders:
    """What the short fits say.

    tried: all descriptions, the best first: those of the last round, then those of the one before it. noise: what noise
    leaves of the misfit. chosen: the one to go by. told: whether the images tell it from the next best.
    """

    tried: tuple[Tried, ...]
    noise: float
    chosen: Otherwise
    told: bool

    def table(self, most: int = 8) -> str:
        """The best descriptions and their misfits over the noise's, as a table; `most` rows."""
        shown = self.tried[:most]
        width = max(len(tried.otherwise.name) for tried in shown)
        unit = "misfit / noise" if self.noise > 0 else "misfit"
        lines = [f"{'what would be wrong':{max(width, 19)}}  {unit:>14}  rounds"]
        for tried in shown:
            value = tried.misfit / (self.noise or 1.0)
            mark = "  ←" if tried.otherwise is self.chosen else ""
            lines.append(f"{tried.otherwise.name:{max(width, 19)}}  {value:14.3f}  {tried.rounds}{mark}")
        if len(self.tried) > most:
            lines.append(f"and {len(self.tried) - most} others, which explain less")
        return "\n".join(lines)


def find_orders(declared: Acquisition, problem_of: ProblemOf, noise: Sequence[float] | None) -> Orders:
    """Try all that `recon.calibration.declared` names.

    declared: the whole stack's acquisition. problem_of: see `ProblemOf`. noise: standard deviation of each prism's;
    None where it isn't known.
    """
    racing: Sequence[Otherwise] = all_mistakes(declared)
    found: dict[object, Tried] = {}
    alone = 0.0
    for number, (most, slices, steps, sources) in enumerate(ROUNDS, 1):
        if number > 1 and len(racing) > most:
            best = sorted(racing, key=lambda other: found[_key(other)].misfit)[:most]
            # the declared one stays in the race: it is what the others are compared with
            racing = best if any(o.mistakes == 0 for o in best) else [*best, *(o for o in racing if o.mistakes == 0)]
        for other in racing:
            problem = problem_of(other.acquisition, slices)
            alone = problem.misfit.of_noise(noise) or 0.0
            found[_key(other)] = Tried(other, short_fit(problem, steps, sources), number)
    ranked = sorted(found.values(), key=lambda tried: (-tried.rounds, tried.misfit))
    return _chosen(tuple(ranked), alone)


def _chosen(ranked: tuple[Tried, ...], noise: float) -> Orders:
    last = [tried for tried in ranked if tried.rounds == len(ROUNDS)]
    declared = next(tried for tried in last if tried.otherwise.mistakes == 0)
    best = last[0]
    gained = (declared.misfit - best.misfit) / max(declared.misfit - noise, 1e-12)
    chosen = best if gained > LEAST else declared
    others = [tried for tried in last if tried is not chosen]
    nearest = min((tried.misfit for tried in others), default=math.inf)
    told = (nearest - chosen.misfit) > LEAST * max(nearest - noise, 1e-12)
    return Orders(ranked, noise, chosen.otherwise, told)


def _key(other: Otherwise) -> object:
    return images_of(other.acquisition)
