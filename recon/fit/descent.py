"""A descent to the volume that explains the data, by the method that the problem names, as a generator of steps."""

from collections import deque
from collections.abc import Callable, Iterator

from jaxtyping import Float
from torch import Tensor

from recon.fit.adam import minimise_by_adam
from recon.fit.newton.descent import minimise_by_newton
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from torchdic import Acquisition, Fidelity, Grid, Microscope

# The descents by their names.
DESCENTS: dict[str, Callable[[Problem, Step | None], Iterator[Step]]] = {
    "newton": minimise_by_newton,
    "adam": minimise_by_adam,
}


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


def solved(problem: Problem) -> Step:
    """The last step of a problem's descent; earlier ones aren't held. Raises as `minimise` does."""
    return deque(minimise(problem), maxlen=1).pop()


def minimise(problem: Problem, resume: Step | None = None) -> Iterator[Step]:
    """Lower the misfit and the priors of a problem by its method; yields every step.

    resume: the step to go on from; the rest is as if there had been no interruption.
    Raises ValueError where the step has other unknowns or is another method's, and FloatingPointError where the fit
    diverges.
    """
    yield from DESCENTS[problem.method](problem, resume)
