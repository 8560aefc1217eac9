"""What a propagation is: one object that describes one way for light to cross a specimen.

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

# Takes a field on the grid to its spectrum: a Fourier transform, or one in which each point has its own defocus.
ToSpectrum = Callable[[Tensor], Tensor]


class Crossing(ABC):
    """Light's way through one volume. It is prepared once for an image and serves every batch of sources and colour."""

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

        wavelength: in vacuum, µm.
        momentum: n·sinθ (y, x) of each source's direction, (source, 2).
        slabs: whether the backward pass computes the steps through the volume again, slab by slab.
        to_spectrum: how a field becomes a spectrum. Propagations that make no field don't use it.
        The result has the shape (source, component, y, x). There is 1 component if light is a scalar. There are 2,
        along +x and +y for light that comes in along +x, if the propagation carries polarisation and was asked to.
        """


class Propagation(ABC):
    """One way for light to cross a specimen.

    name: by which a `Fidelity` calls it.
    spreads: whether what a weak slice scatters spreads by diffraction up to the reference plane; on rays it goes
        straight on along its source's direction.
    carries_polarisation: whether its light carries its polarisation along, which matters behind strained lenses.
    small_batches: whether small batches of sources are faster than large ones whose steps are computed again.
    holds_by_content: whether its memory depends on how much of the array is empty.
    ample: more bytes than images without a gradient hold for each source and pixel, in float32. Scenes that fit by it
        aren't measured before they are computed.
    """

    name: ClassVar[str]
    spreads: ClassVar[bool] = True
    carries_polarisation: ClassVar[bool] = False
    small_batches: ClassVar[bool] = False
    holds_by_content: ClassVar[bool] = False
    ample: ClassVar[int] = 2048

    def check(self, fidelity: Fidelity) -> None:  # noqa: B027  (most have nothing to forbid)
        """Raise ValueError if a fidelity asks for something that this propagation can't do."""

    def reference_plane(self, volume: Volume, fidelity: Fidelity) -> float:
        """Depth in µm of the plane to which the light behind a volume is referred."""
        return volume.mean_plane() if fidelity.reference_plane is None else fidelity.reference_plane

    @abstractmethod
    def prepare(self, volume: Volume, fidelity: Fidelity, plane: float, *, polarised: bool = False) -> Crossing:
        """The crossing of a volume.

        volume: with its padding.
        plane: depth in µm of the crossing's reference plane.
        polarised: whether the light is to carry its polarisation.
        """

    @abstractmethod
    def work(self, grid: Grid, fidelity: Fidelity, *, absorbs: bool) -> float:
        """The crossing's cost for each source, in FFTs of a field on the grid. absorbs: whether the volume absorbs."""

    def describe(self, fidelity: Fidelity) -> list[str]:
        """What to say about this propagation's part of a fidelity besides its name, in a few words each."""
        return []

    def planned(self) -> Iterable[Fidelity]:
        """Fidelities that the planner tries besides the truth's own slabs."""
        return []

    def rungs(self, grid: Grid, margin: int) -> "Iterable[tuple[Fidelity, str | None]]":
        """Fidelities from the cheapest on that show what accuracy costs, each with a dtype to compute in, or None.

        grid: of the volume.
        margin: voxels of padding to try; 0 is none.
        """
        return []


def register(propagation: Propagation) -> None:
    """Add a propagation to the table, in which a `Fidelity` finds it by its name."""
    PROPAGATIONS[propagation.name] = propagation


def propagation_of(fidelity: Fidelity) -> Propagation:
    """The propagation that a fidelity names."""
    return cast(Propagation, PROPAGATIONS[fidelity.propagation])


def propagations() -> list[Propagation]:
    """All propagations, in the order in which they were registered."""
    return [cast(Propagation, propagation) for propagation in PROPAGATIONS.values()]
