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
from torchdic.memory.batches import halved_batches
from torchdic.memory.shortage import announce_halving, may_be_halved

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
    """The last step of a problem's descent; earlier ones aren't held.

    problem: as `Problem.from_recipe` makes it. Raises as `minimise` does.
    """
    return deque(minimise(problem), maxlen=1).pop()


def minimise(problem: Problem, resume: Step | None = None) -> Iterator[Step]:
    """Lower the misfit and the priors of a problem by its method; yields every step.

    problem: as `Problem.from_recipe` makes it, or with parts of one's own.
    resume: the step to go on from; the rest is as if there had been no interruption.
    Where a GPU's memory runs out, the step is taken again with batches of half the sources, and the later ones too;
    ShortageWarning says so.
    Raises ValueError where the step has other unknowns or is another method's, and FloatingPointError where the fit
    diverges.
    """
    descent, last = DESCENTS[problem.method], resume
    try:
        for step in descent(problem, resume):
            last = step
            yield step
    except (MemoryError, RuntimeError) as error:
        if not may_be_halved(error, problem.misfit.data.device):
            raise
        announce_halving(error, problem.misfit.data.device)
    else:
        return
    yield from _halved(descent(problem, last))


def _halved(steps: Iterator[Step]) -> Iterator[Step]:
    """Each step computed with batches of half the sources; what the caller computes in between isn't."""
    while True:
        with halved_batches():
            step = next(steps, None)
        if step is None:
            return
        yield step
