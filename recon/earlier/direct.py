"""The methods without a descent, as a descent of one step."""

import math
import time
from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from recon.earlier.path_length import path_length
from recon.earlier.tikhonov import tikhonov
from recon.fit.problem import Problem, Recipe
from recon.fit.step import Step
from recon.fit.unknowns import IndexDifference, with_values
from recon.prior.weight import record


def solved_directly(
    recipe: Recipe, problem: Problem, noise: Sequence[float] | None
) -> tuple[Step, Float[Tensor, "focus y x"] | None]:
    """The volume by the recipe's method as the one step of a descent, and the sections of path length in µm, if any.

    noise: standard deviation in each prism's images; None is unknown.
    """
    started, data = time.perf_counter(), problem.misfit.data
    if recipe.method == "linear":
        index = next(u for u in problem.unknowns if isinstance(u, IndexDifference))
        found = tikhonov(data, problem.setup, noise, index.bounds)
        sections = None
    else:
        found = path_length(data, problem.setup, noise)
        sections = found.opl
    weight = found.weight if math.isfinite(found.weight) else None
    seconds = time.perf_counter() - started
    values = {u.name: u.value(u.start(problem.setup, problem.misfit)) for u in problem.unknowns[1:]}
    values[IndexDifference.name] = found.delta
    # where the fidelity has yet to be planned, it is for this volume
    _, plans = problem.fidelity.careful(0, with_values(problem.unknowns, values, problem.setup), ())
    step = Step(1, math.nan, math.nan, found.delta, seconds, values, {}, plans, (record(1, weight, found.rule),))
    return step, sections
