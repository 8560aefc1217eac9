"""What a propagation is: one object that says all there is to say about one way for light to cross a specimen.

A new propagation is one file with two classes, a `Propagation` and its `Crossing`, and a call of `register`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import ClassVar, cast

from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import PROPAGATIONS, Fidelity
from torchdic.grid import Grid
from torchdic.plane_waves import to_spectrum
from torchdic.specimen.volume import Volume

# From a field on the grid to its spectrum: a Fourier transform, or a spread of each point with a defocus of its own.
ToSpectrum = Callable[[Tensor], Tensor]


class Crossing(ABC):
    """Light's way through one volume: prepared once for an image, used by every batch of sources and every colour."""

    @abstractmethod
    def spectrum(
        self,
        wavelength: float,
        momentum: Float[Tensor, "source 2"],
        *,
        slabs: bool = False,
        to_spectrum: ToSpectrum = to_spectrum,
    ) -> Complex[Tensor, "source component y x"]:
        """The spectrum of each source's envelope behind the specimen, referred to the crossing's reference plane.

        wavelength: in vacuum, µm. momentum: n·sinθ (y, x) of each source's direction. slabs: whether the steps through
        the volume are computed again in the backward pass, slab by slab. to_spectrum: how a field becomes a spectrum;
        propagations that make no field don't use it. component: 1 where light is a scalar; 2, along +x and +y of light
        that comes in along +x, where the propagation carries polarisation and was asked to.
        """


class Propagation(ABC):
    """One way for light to cross a specimen.

    name: what a `Fidelity` calls it.
    carries_polarisation: whether its light carries its polarisation along, which matters behind strained lenses.
    small_batches: whether small batches of sources are faster than large ones whose steps are computed again.
    holds_by_content: whether its memory depends on how much of the array is empty.
    """

    name: ClassVar[str]
    carries_polarisation: ClassVar[bool] = False
    small_batches: ClassVar[bool] = False
    holds_by_content: ClassVar[bool] = False

    def check(self, fidelity: Fidelity) -> None:  # noqa: B027  (most have nothing to forbid)
        """Raise ValueError where a fidelity asks for what this propagation can't have."""

    def reference_plane(self, volume: Volume, fidelity: Fidelity) -> float:
        """Depth in µm to which the light behind a volume is referred."""
        return volume.mean_plane() if fidelity.reference_plane is None else fidelity.reference_plane

    @abstractmethod
    def prepare(self, volume: Volume, fidelity: Fidelity, plane: float, *, polarised: bool = False) -> Crossing:
        """The crossing of a volume, referred to depth `plane` (µm); polarised: whether it carries polarisation."""

    @abstractmethod
    def work(self, grid: Grid, fidelity: Fidelity, *, absorbs: bool) -> float:
        """What the crossing costs for each source, in FFTs of a field on the grid."""

    def describe(self, fidelity: Fidelity) -> list[str]:
        """What a fidelity says of this propagation beside its name, in a few words each."""
        return []

    def planned(self) -> Iterable[Fidelity]:
        """Fidelities that the planner tries beside the truth's own slabs."""
        return []

    def rungs(self, grid: Grid, margin: int) -> "Iterable[tuple[Fidelity, str | None]]":
        """Fidelities from the cheapest on, and the dtype to compute in or None, that show what accuracy costs.

        grid: of the volume. margin: voxels of padding to try; 0 is none.
        """
        return []


def register(propagation: Propagation) -> None:
    """Add a propagation to the table, in which a `Fidelity` finds it by its name."""
    PROPAGATIONS[propagation.name] = propagation


def propagation_of(fidelity: Fidelity) -> Propagation:
    """The propagation that a fidelity names."""
    return cast(Propagation, PROPAGATIONS[fidelity.propagation])


def propagations() -> list[Propagation]:
    """All propagations that there are, in the order in which they were registered."""
    return [cast(Propagation, propagation) for propagation in PROPAGATIONS.values()]
