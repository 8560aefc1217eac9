"""The nuisances that a configuration can name."""

from collections.abc import Callable

from recon.fit.nuisances.base import Nuisance
from recon.fit.nuisances.bias import Bias
from recon.fit.nuisances.drift import Drift
from recon.fit.nuisances.focus import FocusErrors
from recon.fit.nuisances.light import Brightness, Lamp
from recon.fit.nuisances.shear import ShearError

NUISANCES: dict[str, Callable[[], Nuisance]] = {
    "brightness": Brightness,
    "bias": Bias,
    "drift": Drift,
    "lamp": Lamp,
    "focus": FocusErrors,
    "shear": ShearError,
}
