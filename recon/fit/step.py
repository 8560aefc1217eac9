"""One step of a descent, by whatever method."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.planned import PlanRecord
from recon.fit.unknowns import State
from recon.prior.weight import WeightRecord

# A step's row of the log: number, misfit, loss, seconds.
Row = tuple[int, float, float, float]


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a descent, and all that is needed to go on from it. Its tensors are not changed afterwards.

    number: steps taken so far. misfit, loss: of the volume before this step. delta: Δn (z, y, x) after it.
    seconds: that the descent has taken, its start included. values: what every unknown stands for after the step, by
    name. state: parameters and Adam's moments, by the unknown's name. plans: all that were made for a tolerance so far;
    the last is that of the current fidelity. weights: of the priors, where they follow the noise, and why.
    """

    number: int
    misfit: float
    loss: float
    delta: Float[Tensor, "z y x"]
    seconds: float
    values: dict[str, Tensor]
    state: State
    plans: tuple[PlanRecord, ...] = ()
    weights: tuple[WeightRecord, ...] = ()

    @property
    def row(self) -> Row:
        """The step's row of the log."""
        return self.number, self.misfit, self.loss, self.seconds


def check_convergence(number: int, loss: float, values: dict[str, Tensor], lowest: float, advice: str = "") -> None:
    """Raise FloatingPointError where a step led to numbers that are not finite, or to an index that isn't positive.

    advice: what the message ends with.
    """
    if not math.isfinite(loss) or not all(bool(torch.isfinite(value).all()) for value in values.values()):
        raise FloatingPointError(f"the descent diverged at step {number}: the loss is {loss:g}{advice}")
    if lowest <= 0:
        raise FloatingPointError(f"the descent diverged at step {number}: the index falls to {lowest:g}{advice}")
