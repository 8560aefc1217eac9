"""What a specimen of known shape and index tells of the optics, as unknowns of few numbers.

They act on images as the nuisances of a descent do, with differences of images that are formed together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.nuisances.drift import Drift
from recon.fit.nuisances.shear import turned_prism
from recon.fit.setup import Setup
from recon.misfit.base import Misfit
from torchdic import Acquisition, Prism
from torchdic.scalar import number


@dataclass(frozen=True)
class Displacement(Drift):
    """Where the specimen's picture is in each image, (prism, focus, 2) in µm (y, x) from where the model has it."""

    width = None
    centred = False


@dataclass(frozen=True)
class ShearOfAxes(Nuisance):
    """For each shear axis a factor on the length, and an angle in rad from +x towards +y by which it is turned.

    The value is (axis, 2), and the parameter the factor's logarithm and the angle. axes_of: of each prism its axis,
    counted from 0; of bright field any. learning_rate, step: of the logarithm, and in rad.
    """

    axes_of: tuple[int, ...] = ()
    learning_rate: float = 2e-3
    step: float = 0.02
    name = "shear"
    axes = ("prism",)

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """Factors of 1 and angles of 0."""
        return misfit.data.new_zeros(max(self.axes_of) + 1, 2)

    def of_entries(self, entries: Tensor) -> Tensor:
        """(factor, angle) of each axis."""
        return torch.stack((entries[:, 0].exp(), entries[:, 1]), 1)

    def acting(self, parameter: Tensor, images: tuple[int, int]) -> Tensor:
        """As `Nuisance.acting`: a prism's images are moved by the entries of its axis."""
        acting = torch.zeros(*images, 2, len(parameter), 2, dtype=torch.float64, device=parameter.device)
        for prism, axis in enumerate(self.axes_of):
            acting[prism, :, :, axis] = torch.eye(2, dtype=torch.float64, device=parameter.device)
        return acting.flatten(3)

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with every shear stretched and turned as its axis is."""
        prisms = [
            None if prism is None else turned_prism(prism, value[axis])
            for prism, axis in zip(setup.acquisition.prisms, self.axes_of, strict=True)
        ]
        return replace(setup, acquisition=replace(setup.acquisition, prisms=prisms))


@dataclass(frozen=True)
class FocusZero(Nuisance):
    """What is to be added to all focus planes, 0-d in µm: where the specimen lies along z.

    learning_rate, step: in µm.
    """

    learning_rate: float = 0.02
    step: float = 0.05
    name = "focus_zero"

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """0."""
        return misfit.data.new_zeros(())

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with its planes moved."""
        focus = [depth + value for depth in setup.acquisition.focus]
        return replace(setup, acquisition=replace(setup.acquisition, focus=focus))


@dataclass(frozen=True)
class CondenserAperture(Nuisance):
    """The condenser's NA over the declared one, 0-d; its parameter is the factor's logarithm.

    most: NA at most. learning_rate, step: of the logarithm.
    """

    most: float = float("inf")
    learning_rate: float = 2e-3
    step: float = 0.03
    name = "condenser"

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """0: a factor of 1."""
        return misfit.data.new_zeros(())

    def of_entries(self, entries: Tensor) -> Tensor:
        """The factor."""
        return entries.exp()

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with the condenser's aperture stretched."""
        condenser = setup.microscope.condenser
        assert condenser is not None
        inner = condenser.inner_na
        factor = min(float(value), self.most / condenser.na)
        stretched = replace(condenser, na=condenser.na * factor, inner_na=None if inner is None else inner * factor)
        return replace(setup, microscope=replace(setup.microscope, condenser=stretched))


@dataclass(frozen=True)
class Aberrations(Nuisance):
    """What is to be added to the objective's Zernike terms (term,), rad. terms: their Noll indices.

    learning_rate, step: in rad.
    """

    terms: tuple[int, ...] = ()
    learning_rate: float = 0.02
    step: float = 0.1
    name = "aberrations"

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """0 for each term."""
        return misfit.data.new_zeros(len(self.terms))

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with these terms added."""
        objective = setup.microscope.objective
        assert objective is not None
        known = dict(objective.aberrations or {})
        for term, phase in zip(self.terms, value.unbind(), strict=True):
            known[term] = known.get(term, 0.0) + phase
        changed = replace(objective, aberrations=known)
        return replace(setup, microscope=replace(setup.microscope, objective=changed))


def axes_of(acquisition: Acquisition) -> tuple[int, ...]:
    """Of each prism the number of its shear axis, from 0: prisms whose shears differ by their sign share one.

    Bright field has that of the first.
    """
    known: list[tuple[float, float]] = []
    found = []
    for prism in acquisition.prisms:
        if prism is None:
            found.append(0)
            continue
        shear = (number(prism.shear[0]), number(prism.shear[1]))
        axis = next((i for i, other in enumerate(known) if _same_line(shear, other)), None)
        if axis is None:
            axis = len(known)
            known.append(shear)
        found.append(axis)
    return tuple(found)


def firsts_of(acquisition: Acquisition) -> list[Prism]:
    """The first prism of each shear axis, in the order of `axes_of`."""
    found: dict[int, Prism] = {}
    for prism, axis in zip(acquisition.prisms, axes_of(acquisition), strict=True):
        if prism is not None:
            found.setdefault(axis, prism)
    return [found[axis] for axis in sorted(found)]


def _same_line(a: Sequence[float], b: Sequence[float]) -> bool:
    return any(all(abs(x - sign * y) < 1e-6 for x, y in zip(a, b, strict=True)) for sign in (1, -1))
