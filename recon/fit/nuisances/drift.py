"""The drift of the specimen between the images: a stage that moves, or a prism that displaces the picture."""

from dataclasses import dataclass, replace

from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.misfit.base import Misfit


@dataclass(frozen=True)
class Drift(Nuisance):
    """How far the picture has moved in each image, (prism, focus, 2) in µm (y, x), with a mean of 0 over the images.

    A shift that all images share is the volume's own place, which Δn says. A stage or a prism moves the picture by some
    hundredths of a µm: images that say nothing of their place, such as planes far out of focus, stay near 0.
    learning_rate, step: in µm.
    """

    learning_rate: float = 5e-3
    step: float = 0.02
    width = 0.05
    name = "drift"
    axes = ("prism", "focus")
    centred = True
    forms = False

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The setup's drift, or 0."""
        if setup.drift is None:
            return misfit.data.new_zeros(*misfit.data.shape[:2], 2)
        return setup.drift.detach().to(misfit.data)

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with this drift."""
        return replace(setup, drift=value)
