"""Short fits: a few coarse steps of Newton's, whose misfits tell which of several descriptions explains a stack.

A wrong sign, order or axis leaves most of the images unexplained, so that a fit need not be good to tell it.
"""

import contextlib
import math
import warnings
from collections.abc import Iterator
from dataclasses import replace

from recon.fit.descent import minimise
from recon.fit.newton.weak_hessian import check_linear_response
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem
from recon.fit.step import Step
from torchdic import Fidelity
from torchdic.errors import SamplingWarning, SidewaysError, UnstableError, WrapAroundWarning

# Steps and condenser directions of a short fit. The benchmarks' cell has a misfit of 0.17 after them if all is right,
# and of 0.57 to 0.76 where a sign, the order of the planes or the axes are wrong.
STEPS, SOURCES = 3, 12


def can_be_tried(problem: Problem) -> bool:
    """Whether short fits can be made: whether Newton's method can take its steps here."""
    try:
        check_linear_response(problem.setup.microscope, problem.setup.acquisition)
    except ValueError:
        return False
    return True


def short_fit(problem: Problem, steps: int = STEPS, sources: int = SOURCES) -> float:
    """The least misfit of a few coarse steps of Newton's; infinite where the light can't be followed.

    steps: at most. sources: condenser directions.
    """
    return min((step.misfit for step in coarse_steps(problem, steps, sources)), default=math.inf)


def last_step(problem: Problem, steps: int, sources: int, drafts: int | None = None) -> Step | None:
    """The last step of a short fit; None where the light can't be followed."""
    last = None
    for step in coarse_steps(problem, steps, sources, drafts):
        last = step
    return last


def coarse_steps(problem: Problem, steps: int, sources: int, drafts: int | None = None) -> Iterator[Step]:
    """The steps of a short fit; they end where the light can't be followed.

    sources: condenser directions. drafts: those of images that are corrected to these; None is all of them.
    """
    coarse = GivenFidelity(Fidelity("wave", sources=sources), drafts)
    with unwarned(), contextlib.suppress(FloatingPointError, UnstableError, SidewaysError):
        yield from minimise(replace(problem, fidelity=coarse, steps=steps, method="newton"))


@contextlib.contextmanager
def unwarned() -> Iterator[None]:
    """Within this block images are those of trials: a warning of their apertures says nothing of the user's."""
    with warnings.catch_warnings():
        for kind in (SamplingWarning, WrapAroundWarning):
            warnings.simplefilter("ignore", kind)
        yield
