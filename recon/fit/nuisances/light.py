"""The light of the images: a lamp that isn't steady or even, or exposures that differ."""

from dataclasses import dataclass, replace

from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import TERMS, Setup
from recon.misfit.base import Misfit


@dataclass(frozen=True)
class Brightness(Nuisance):
    """The factor of each image (prism, focus). Its parameter is the factor's logarithm.

    learning_rate, step: of the logarithm.
    """

    learning_rate: float = 2e-3
    step: float = 0.03
    name = "brightness"
    axes = ("prism", "focus")
    forms = False

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The logarithm of the setup's brightness, or of 1. Raises ValueError unless that is above 0."""
        if setup.brightness is None:
            return misfit.data.new_zeros(misfit.data.shape[:2])
        if not bool((setup.brightness > 0).all()):
            raise ValueError(f"brightness {float(setup.brightness.min()):g} must be above 0")
        return setup.brightness.detach().to(misfit.data).log()

    def of_entries(self, entries: Tensor) -> Tensor:
        """The factors."""
        return entries.exp()

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with this brightness."""
        return replace(setup, brightness=value)


@dataclass(frozen=True)
class RelativeBrightness(Brightness):
    """The factor of each image, 1 in the geometric mean over each prism's planes.

    Where a bias is learned too: it sets how bright a prism's background is, and with a factor of its own for each prism
    the bias, that factor and the specimen's contrast could not be told apart.
    """

    def told(self, parameter: Tensor) -> Tensor:
        """The logarithms without each prism's mean."""
        return parameter - parameter.mean(1, keepdim=True)


@dataclass(frozen=True)
class Lamp(Nuisance):
    """What is uneven of the light behind each prism (prism, 5), see `Setup.lamp`.

    A background that was fitted around a specimen which fills much of the field is a little wrong, and divided out all
    the same. learning_rate, step: of its coefficients.
    """

    learning_rate: float = 2e-3
    step: float = 0.02
    name = "lamp"
    axes = ("prism",)
    forms = False

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """The setup's lamp, or an even one."""
        even = misfit.data.new_zeros(misfit.data.shape[0], TERMS)
        return even if setup.lamp is None else setup.lamp.detach().to(even)

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with this lamp."""
        return replace(setup, lamp=value)
