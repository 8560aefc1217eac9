"""What a descent finds: Δn, and any other quantity of the specimen, the microscope or the acquisition.

An optimiser moves free parameters, which may take any value. An `Unknown` says which quantity its parameter stands for,
and where in the model's setup the quantity goes. `Unknowns` are the unknowns of one descent, each with its parameter.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from recon.fit.bounds import Bounds, SupportedBounds
from recon.fit.setup import Setup
from recon.fit.start import linear_start
from recon.misfit.base import Misfit
from recon.prior.schedule import cosine
from torchdic import Volume

# Distance in Δn from its bounds that every voxel starts with; less where a descent goes on from a given volume.
OFF_BOUNDS, OFF_BOUNDS_GIVEN = 1e-3, 1e-5

# What goes on from one step to the next: of each unknown, by its name, the parameter and Adam's moments.
State = dict[str, dict[str, Any]]


class Unknown(ABC):
    """One quantity that a descent finds.

    A subclass says what the quantity's parameter is at the start, what value a parameter stands for, and where the
    value goes in a setup. It keeps no tensor: one `Unknown` may serve several descents.
    name: of the quantity in a step's values and in a checkpoint. learning_rate: Adam's first, in the parameter's unit.
    """

    name: str
    learning_rate: float

    @abstractmethod
    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The parameter at the start. setup: what is known before the descent. misfit: holds the data."""

    @abstractmethod
    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with this value in its place."""

    def value(self, parameter: Tensor) -> Tensor:
        """The value that a parameter stands for; differentiable. Without bounds it is the parameter itself."""
        return parameter

    def rate(self, step: int, steps: int) -> float:
        """The learning rate at one of the steps, counted from 0: it falls to 0 along half a cosine."""
        return cosine(step, steps, self.learning_rate)


@dataclass(frozen=True)
class IndexDifference(Unknown):
    """Δn of every voxel (z, y, x).

    learning_rate: Adam's first, in Δn. bounds: least and greatest Δn. first: "linear" starts from the weak specimen
    that explains the data, see `recon.fit.start`; "zero" starts from the medium alone. given: Δn (z, y, x) of the whole
    volume, from which the descent starts in place of those, Newton's too; None is none.
    """

    learning_rate: float
    bounds: Bounds
    first: Literal["linear", "zero"]
    given: Tensor | None = field(default=None, compare=False, repr=False)
    name = "delta"

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The parameter of the first volume, OFF_BOUNDS away from the bounds."""
        if self.given is not None:
            return self.bounds.parameter(self.given, margin=OFF_BOUNDS_GIVEN)
        zero = misfit.data.new_zeros(()).expand(setup.volume.grid.shape)
        delta = _linear(setup, misfit) if self.first == "linear" else zero
        return self.bounds.parameter(delta, margin=OFF_BOUNDS)

    def value(self, parameter: Tensor) -> Tensor:
        """Δn within its bounds."""
        return self.bounds.delta(parameter)

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with a volume of this Δn; its background and absorption stay."""
        known = setup.volume
        return replace(setup, volume=Volume(known.grid, value, known.background, known.absorption))


def _linear(setup: Setup, misfit: Misfit) -> Tensor:
    """Δn of the weak specimen within the field; in the margin it goes on as at the field's edge.

    Images on a camera's pixels are interpolated: a start needs no more.
    """
    data, margin = setup.at_rest(misfit.data), setup.margin
    microscope = setup.microscope if setup.sees_voxels else replace(setup.microscope, camera=None)
    delta = linear_start(data, setup.field, setup.volume.background, microscope, setup.acquisition)
    return delta if margin == 0 else F.pad(delta[None], (margin,) * 4, mode="replicate")[0]


def with_support(unknown: Unknown, change: Callable[[Tensor], Tensor]) -> Unknown:
    """An unknown with its support changed; itself where it isn't Δn or Δn is sought everywhere.

    change: makes the new support (z, y, x) of the old one.
    """
    if not isinstance(unknown, IndexDifference) or not isinstance(unknown.bounds, SupportedBounds):
        return unknown
    return replace(unknown, bounds=replace(unknown.bounds, support=change(unknown.bounds.support)))


def with_values(unknowns: Sequence[Unknown], values: Mapping[str, Tensor], setup: Setup) -> Setup:
    """The setup with each unknown's value, given by name, in its place."""
    for unknown in unknowns:
        setup = unknown.put(values[unknown.name], setup)
    return setup


def check_saved(names: Iterable[str], saved: Iterable[str]) -> None:
    """Raise ValueError where a saved step has other unknowns than a descent."""
    if set(names) != set(saved):
        raise ValueError(f"the saved step has the unknowns {', '.join(saved)}, the descent has {', '.join(names)}")


class Unknowns:
    """The unknowns of one descent, each with its parameter.

    unknowns: in the order in which their values are put into a setup. parameters: one for each, by its name.
    """

    def __init__(self, unknowns: Sequence[Unknown], parameters: Mapping[str, Tensor]) -> None:
        self._unknowns = tuple(unknowns)
        self._parameters = {unknown.name: parameters[unknown.name].requires_grad_() for unknown in unknowns}

    @classmethod
    def at_start(cls, unknowns: Sequence[Unknown], setup: Setup, misfit: Misfit) -> "Unknowns":
        """The unknowns at the start of a descent."""
        return cls(unknowns, {unknown.name: unknown.start(setup, misfit).detach().clone() for unknown in unknowns})

    @classmethod
    def restored(cls, unknowns: Sequence[Unknown], state: State, device: torch.device) -> "Unknowns":
        """The unknowns as `state` saved them. Raises ValueError where it saved others."""
        names = [unknown.name for unknown in unknowns]
        check_saved(names, state)
        return cls(unknowns, {name: state[name]["parameter"].to(device).clone() for name in names})

    def values(self) -> dict[str, Tensor]:
        """What each parameter stands for now, by name: copies without a graph."""
        return {u.name: u.value(self._parameters[u.name].detach().clone()) for u in self._unknowns}

    def into(self, setup: Setup) -> Setup:
        """The setup with the current values in it; differentiable in the parameters."""
        values = {unknown.name: unknown.value(self._parameters[unknown.name]) for unknown in self._unknowns}
        return with_values(self._unknowns, values, setup)

    def adam(self, state: State | None = None) -> torch.optim.Adam:
        """Adam with a group of parameters for each unknown, its moments as `state` saved them."""
        groups = [{"params": [self._parameters[u.name]], "lr": u.learning_rate} for u in self._unknowns]
        adam = torch.optim.Adam(groups)
        if state is not None:
            moments = {
                index: {key: value for key, value in state[unknown.name].items() if key != "parameter"}
                for index, unknown in enumerate(self._unknowns)
            }
            # copied, because Adam changes its moments in place
            saved = {"state": copy.deepcopy(moments), "param_groups": adam.state_dict()["param_groups"]}
            adam.load_state_dict(saved)
        return adam

    def set_rates(self, adam: torch.optim.Adam, step: int, steps: int) -> None:
        """Give each unknown its learning rate of a step."""
        for group, unknown in zip(adam.param_groups, self._unknowns, strict=True):
            group["lr"] = unknown.rate(step, steps)

    def state(self, adam: torch.optim.Adam) -> State:
        """All that is needed to go on from here: copies of the parameters and of Adam's moments, by name."""
        return {
            name: {"parameter": parameter.detach().clone(), **copy.deepcopy(adam.state[parameter])}
            for name, parameter in self._parameters.items()
        }
