"""Images near given values of the nuisances, from few propagations of light.

A nuisance's entries mostly act on a single image, or on the images of a single prism or plane. All such entries are
moved at once, one step up and one down; the two differences of the images are then the first and second derivative of
each image by its own entry. Images that differ by their prisms, or by their planes, alone are formed together, so that
light is propagated through the volume once.
"""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.fit.unknowns import with_values
from torchdic import Fidelity, Prism
from torchdic.scalar import number

# The setups one step up and one step down along a direction.
Pair = tuple[Setup, Setup]


@dataclass(frozen=True, eq=False)
class Bend:
    """First and second derivative of formed images along one direction, in units of its step."""

    slope: Float[Tensor, "prism focus row column"]
    curvature: Float[Tensor, "prism focus row column"]


class Nearby:
    """The images of nuisances near given parameters: what is formed to second order, what is recorded exactly.

    unknowns: in the order in which values are put into the setup. parameters: of each, by its name.
    setup: what their values are put into. fidelity: of the images. images: formed with these values, where known.
    """

    def __init__(
        self,
        unknowns: Sequence[Nuisance],
        parameters: Mapping[str, Tensor],
        setup: Setup,
        fidelity: Fidelity,
        images: Float[Tensor, "prism focus row column"] | None = None,
    ) -> None:
        self.unknowns, self.parameters, self.setup = tuple(unknowns), dict(parameters), setup
        self.bends: dict[tuple[str, int], Bend] = {}
        for planes in (False, True):
            # planes are joined where planes are moved, else prisms
            acting = [u for u in unknowns if u.forms and (u.axes == ("focus",)) == planes]
            pairs = {(u.name, i): pair for u in acting for i, pair in enumerate(self._pairs(u, self.parameters))}
            setups = [setup for pair in pairs.values() for setup in pair]
            if images is None:
                images, *formed = formed_together([self.placed(self.parameters), *setups], fidelity, planes)
            else:
                formed = formed_together(setups, fidelity, planes)
            for key, up, down in zip(pairs, formed[::2], formed[1::2], strict=True):
                self.bends[key] = Bend((up - down) / 2, (up - images) + (down - images))
        assert images is not None
        self.images = images

    def placed(self, parameters: Mapping[str, Tensor]) -> Setup:
        """The setup with the values of parameters in it."""
        return with_values(self.unknowns, {u.name: u.value(parameters[u.name]) for u in self.unknowns}, self.setup)

    def recorded(self, parameters: Mapping[str, Tensor]) -> Float[Tensor, "prism focus y x"]:
        """The images with these parameters, nothing being propagated."""
        return self.placed(parameters).recorded(self._formed(parameters))

    def jacobian(self, parameters: Mapping[str, Tensor]) -> list[Float[Tensor, "prism focus y x"]]:
        """What the images change by along each direction of each unknown, in units of its step."""
        here, formed = self.placed(parameters), self._formed(parameters)
        columns = []
        for unknown in self.unknowns:
            if unknown.forms:
                for index in range(len(unknown.directions(parameters[unknown.name]))):
                    bend, steps = self.bends[unknown.name, index], self._steps(unknown.name, index, parameters)
                    # what is recorded is linear in what is formed
                    columns.append(here.recorded(bend.slope + steps * bend.curvature))
            else:
                pairs = self._pairs(unknown, parameters)
                columns += [(up.recorded(formed) - down.recorded(formed)) / 2 for up, down in pairs]
        return columns

    def _formed(self, parameters: Mapping[str, Tensor]) -> Tensor:
        formed = self.images
        for (name, index), bend in self.bends.items():
            steps = self._steps(name, index, parameters)
            formed = formed + steps * (bend.slope + steps / 2 * bend.curvature)
        return formed

    def _steps(self, name: str, index: int, parameters: Mapping[str, Tensor]) -> Tensor:
        """How many steps along one direction each image is away: (prism, focus, 1, 1)."""
        unknown = next(u for u in self.unknowns if u.name == name)
        here = self.parameters[name]
        away = (parameters[name] - here).flatten().double() / unknown.step
        acting = unknown.acting(here, (self.images.shape[0], self.images.shape[1]))
        return (acting[:, :, index] @ away).to(self.images)[..., None, None]

    def _pairs(self, unknown: Nuisance, parameters: Mapping[str, Tensor]) -> list[Pair]:
        """The setups one step up and one step down along each direction of an unknown."""
        parameter = parameters[unknown.name]
        told, values = unknown.told(parameter), {u.name: u.value(parameters[u.name]) for u in self.unknowns}

        def moved(by: Tensor) -> Setup:
            return with_values(self.unknowns, values | {unknown.name: unknown.of_entries(told + by)}, self.setup)

        steps = unknown.step * unknown.directions(parameter)
        return [(moved(step), moved(-step)) for step in steps]


def formed_together(setups: Sequence[Setup], fidelity: Fidelity, planes: bool) -> list[Tensor]:
    """Each setup's formed images; those that differ by their prisms alone are formed with one propagation.

    planes: those that differ by their planes alone are, instead.
    """
    groups: dict[Hashable, list[Setup]] = {}
    for setup in setups:
        common = tuple(map(_key, setup.acquisition.prisms if planes else setup.acquisition.focus))
        groups.setdefault((id(setup.volume), id(setup.microscope), common), []).append(setup)
    formed: dict[int, Tensor] = {}
    for members in groups.values():
        acquisition = members[0].acquisition
        if planes:
            acquisition = replace(acquisition, focus=[f for member in members for f in member.acquisition.focus])
        else:
            acquisition = replace(acquisition, prisms=[p for member in members for p in member.acquisition.prisms])
        bare = Setup(members[0].volume, members[0].microscope, acquisition)
        parts = bare.formed(fidelity).chunk(len(members), dim=1 if planes else 0)
        formed |= {id(member): part for member, part in zip(members, parts, strict=True)}
    return [formed[id(setup)] for setup in setups]


def _key(part: Prism | float | Tensor | None) -> Hashable:
    """The values of a prism or a plane."""
    if isinstance(part, Prism):
        axis = None if part.axis is None else number(part.axis)
        return number(part.shear[0]), number(part.shear[1]), number(part.bias), axis
    return None if part is None else number(part)
