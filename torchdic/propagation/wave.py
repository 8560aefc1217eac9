"""Waves: the split-step solution of the one-way wave equation."""

from collections.abc import Iterable
from dataclasses import dataclass

from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.plane_waves import to_spectrum
from torchdic.propagation.base import Crossing, Propagation, ToSpectrum
from torchdic.propagation.split_step import split_step
from torchdic.specimen.volume import Volume

# Work of a slab in FFTs of a field, by its order, and further work if light is absorbed. Measured on a CPU from 64² to
# 256² pixels.
SLAB, ABSORBING = {1: 3.5, 2: 5.0}, 5.0


class Wave(Propagation):
    """The one-way wave equation, solved in slabs."""

    name = "wave"
    ample = 192

    def check(self, fidelity: Fidelity) -> None:
        """A wave needs no object aberration: its field spreads by itself."""
        if fidelity.object_aberration is not None:
            raise ValueError(
                f'object_aberration {fidelity.object_aberration!r} has no use in propagation "{self.name}", whose '
                "field has it already"
            )

    def reference_plane(self, volume: Volume, fidelity: Fidelity) -> float:
        """The last face, where the wave leaves the volume."""
        return volume.grid.extent[0] / 2

    def prepare(self, volume: Volume, fidelity: Fidelity, plane: float, *, polarised: bool = False) -> "SplitStep":
        """The waves through a volume."""
        return SplitStep(volume, fidelity)

    def work(self, grid: Grid, fidelity: Fidelity, *, absorbs: bool) -> float:
        """Each slab takes the Fourier transforms of its order."""
        return (fidelity.steps or grid.shape[0]) * (SLAB[fidelity.order] + (ABSORBING if absorbs else 0.0))

    def describe(self, fidelity: Fidelity) -> list[str]:
        """The number of slabs, and their order."""
        steps = fidelity.steps
        slabs = "a slab a slice" if steps is None else f"{steps} slab{'' if steps == 1 else 's'}"
        return [f"{slabs} of order {fidelity.order}"]

    def rungs(self, grid: Grid, margin: int) -> Iterable[tuple[Fidelity, str | None]]:
        """From few sources, slabs and orders to many, once in float64, and with padding."""
        slices = grid.shape[0]
        few, half, twice = max(1, slices // 4), max(1, slices // 2), 2 * slices
        return [
            (Fidelity(self.name, sources=12, steps=few), None),
            (Fidelity(self.name, sources=12, order=1), None),
            (Fidelity(self.name, sources=12), None),
            (Fidelity(self.name, sources=24), None),
            (Fidelity(self.name, steps=half), None),
            (Fidelity(self.name), None),
            (Fidelity(self.name), "float64"),
            (Fidelity(self.name, padding=margin), None),
            (Fidelity(self.name, steps=twice), None),
            (Fidelity(self.name, sources=72), None),
            (Fidelity(self.name, steps=twice, sources=72, padding=margin), None),
        ]


@dataclass(frozen=True, eq=False)
class SplitStep(Crossing):
    """Waves through a volume, seen on its last face."""

    volume: Volume
    fidelity: Fidelity

    def spectrum(
        self,
        wavelength: float,
        momentum: Float[Tensor, "source 2"],
        *,
        slabs: bool = False,
        to_spectrum: ToSpectrum = to_spectrum,
    ) -> Complex[Tensor, "source 1 y x"]:
        """The spectrum of each source's envelope, see `Crossing.spectrum`."""
        return split_step(self.volume, wavelength, momentum, self.fidelity, slabs=slabs)[:, None]
