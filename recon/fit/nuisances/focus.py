"""The errors of the focus planes: a stage that doesn't step evenly."""

from dataclasses import dataclass, replace

from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.misfit.base import Misfit


@dataclass(frozen=True)
class FocusErrors(Nuisance):
    """What is to be added to each focus plane (focus,), µm, with a mean of 0 over the planes.

    An offset that all planes share is the volume's own depth, which Δn says: it can't be told from the images. A common
    factor of all planes is nearly the volume's scale along z; only the finite aperture tells them apart.
    learning_rate, step: in µm.
    """

    learning_rate: float = 0.02
    step: float = 0.05
    name = "focus"
    axes = ("focus",)
    centred = True

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """0 for each plane: the declared planes are right."""
        return misfit.data.new_zeros(misfit.data.shape[1])

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with its planes moved by these errors."""
        focus = [depth + error for depth, error in zip(setup.acquisition.focus, value.unbind(), strict=True)]
        return replace(setup, acquisition=replace(setup.acquisition, focus=focus))
