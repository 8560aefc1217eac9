"""Where a Newton's descent stands, what the model says there, and how it is saved and restored."""

from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.newton.correction import Correction
from recon.fit.newton.proximal import Split
from recon.fit.newton.secants import Pair
from recon.fit.unknowns import check_saved
from recon.prior.edges import EDGE
from recon.prior.weight import WeightRecord

# λ over the Hessian's mean at first.
FIRST = 0.3

# Edges at first, over the last width.
WIDE = 1.0 / EDGE


@dataclass(frozen=True, eq=False)
class Place:
    """Where a descent stands: all that is needed to go on, besides what the problem says.

    delta: Δn (z, y, x). parameters: of the nuisances, by name. responding: those that the Hessian was made for, which a
    resumed descent makes again. split: of the last model. correction: of the draft images.
    weight: of the priors. scale: the specimen's contrast, at first that of a linear estimate. known: whether the priors
    know it. width: of edges, over the last one. misled: whether few directions mislead here, so that each step has all.
    damping: λ over the Hessian's mean. accepted: number of steps that were. before: the misfit by which the weight
    goes, one accepted step earlier. moved: whether the last step was accepted. still: accepted steps in a row that
    changed next to nothing.
    pairs: for the secants. records: of the weight.
    """

    delta: Float[Tensor, "z y x"]
    parameters: dict[str, Tensor]
    responding: dict[str, Tensor]
    split: Split
    correction: Correction
    weight: float
    scale: float
    known: bool = False
    width: float = WIDE
    misled: bool = False
    damping: float = FIRST
    accepted: int = 0
    before: float | None = None
    moved: bool = True
    still: int = 0
    pairs: tuple[Pair, ...] = ()
    records: tuple[WeightRecord, ...] = ()

    @property
    def edge(self) -> float:
        """The width of an edge, in Δn."""
        return EDGE * self.scale * (self.width if self.known else 1.0)


@dataclass(frozen=True, eq=False)
class Formed:
    """The images of a volume, with their graph.

    delta: Δn, the graph's leaf. images: as the microscope forms them, on the volume's pixels. recorded: with the
    correction and the nuisances of a place. misfit: of those, a 0-d tensor.
    """

    delta: Float[Tensor, "z y x"]
    images: Float[Tensor, "prism focus y x"]
    recorded: Float[Tensor, "prism focus row column"]
    misfit: Float[Tensor, ""]

    @property
    def value(self) -> float:
        """The misfit as a number."""
        return float(self.misfit.detach())


@dataclass(frozen=True, eq=False)
class Judged:
    """A volume's misfit, that by which the priors' weight goes, the gradient, and the recorded images of the model."""

    misfit: float
    heeded: float
    gradient: Float[Tensor, "z y x"]
    images: Float[Tensor, "prism focus row column"]


def state_of(place: Place) -> dict[str, dict[str, Any]]:
    """A place as plain values and tensors, for a checkpoint."""
    numbers = {f.name: getattr(place, f.name) for f in fields(Place)}
    for name in ("delta", "parameters"):
        del numbers[name]
    numbers |= {"split": vars(place.split), "correction": vars(place.correction)}
    return {
        "delta": {"parameter": place.delta},
        **{name: {"parameter": parameter} for name, parameter in place.parameters.items()},
        "newton": numbers,
    }


def restored(state: dict[str, dict[str, Any]], names: list[str], device: torch.device) -> Place:
    """The place that `state_of` saved. names: of the descent's unknowns. Raises ValueError where it saved others."""
    if "newton" not in state:
        raise ValueError("the saved step is none of Newton's method")
    saved = [name for name in state if name != "newton"]
    check_saved(names, saved)
    values = dict(_moved(state["newton"], device))
    for name, kind in (("split", Split), ("correction", Correction)):
        values[name] = kind(**values[name])
    parameters = {n: v["parameter"].to(device) for n, v in state.items() if n not in ("delta", "newton")}
    return Place(state["delta"]["parameter"].to(device), parameters, **values)


def _moved(value: Any, device: torch.device) -> Any:
    """A value with all tensors in it on a device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, dict):
        return {name: _moved(below, device) for name, below in value.items()}
    return tuple(_moved(below, device) for below in value) if isinstance(value, tuple) else value
