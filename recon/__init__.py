"""The inverse of torchdic: refractive-index volumes fitted to DIC stacks, in the units and axes of `torchdic`.

`descend` is the descent itself, a generator of steps: log, pictures and stopping are in the caller's loop. `minimise`
goes on with a `Problem` whose parts are the caller's: `Recipe`, misfit, priors. `error_bars` says how far a fit can be
trusted, `NoisyAcquisition` what images will tell before they are recorded, `calibrate` what a bead tells of the optics.
What a configuration asks for is done by the command `torchdic`.

This package never sees the truth: `data_synthetic` is imported by its command line alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recon.calibration.known_specimen import ModelledSpecimen, OpticsFound, calibrate
    from recon.coverage.acquisition import NoisyAcquisition, shot_noise
    from recon.coverage.expected import ExpectedSpecimen
    from recon.coverage.seen import Coverage
    from recon.earlier.one_image import phase_of_image
    from recon.evidence.bars import ErrorBars
    from recon.evidence.error_bars import error_bars
    from recon.evidence.regions import Known, Region
    from recon.fit.bounds import Bounds
    from recon.fit.descent import descend, minimise, solved
    from recon.fit.problem import Problem, Recipe
    from recon.fit.setup import Setup, empty_medium
    from recon.fit.step import Step
    from recon.misfit.base import Misfit
    from recon.misfit.gaussian import GaussianMisfit
    from recon.misfit.poisson import PoissonMisfit
    from recon.misfit.robust import RobustMisfit
    from recon.prior.base import Majorant, Prior
    from recon.prior.edges import gradient_length
    from recon.recording.background import background_surface, noise_level
    from recon.recording.noise import NoiseModel
    from recon.recording.shear_axis import ShearAxis, estimate_shear_axis
    from recon.run.exact_images import exact_images

__all__ = [
    "Bounds",
    "Coverage",
    "ErrorBars",
    "ExpectedSpecimen",
    "GaussianMisfit",
    "Known",
    "Majorant",
    "Misfit",
    "ModelledSpecimen",
    "NoiseModel",
    "NoisyAcquisition",
    "OpticsFound",
    "PoissonMisfit",
    "Prior",
    "Problem",
    "Recipe",
    "Region",
    "RobustMisfit",
    "Setup",
    "ShearAxis",
    "Step",
    "background_surface",
    "calibrate",
    "descend",
    "empty_medium",
    "error_bars",
    "estimate_shear_axis",
    "exact_images",
    "gradient_length",
    "minimise",
    "noise_level",
    "phase_of_image",
    "shot_noise",
    "solved",
]

# The file of each name. It is loaded with the first use of one of its names: each part of the command line imports this
# package, and torch, which takes seconds, must not come with it.
_FILES = {
    "calibration.known_specimen": ("ModelledSpecimen", "OpticsFound", "calibrate"),
    "coverage.acquisition": ("NoisyAcquisition", "shot_noise"),
    "coverage.expected": ("ExpectedSpecimen",),
    "coverage.seen": ("Coverage",),
    "earlier.one_image": ("phase_of_image",),
    "evidence.bars": ("ErrorBars",),
    "evidence.error_bars": ("error_bars",),
    "evidence.regions": ("Known", "Region"),
    "fit.bounds": ("Bounds",),
    "fit.descent": ("descend", "minimise", "solved"),
    "fit.problem": ("Problem", "Recipe"),
    "fit.setup": ("Setup", "empty_medium"),
    "fit.step": ("Step",),
    "misfit.base": ("Misfit",),
    "misfit.gaussian": ("GaussianMisfit",),
    "misfit.poisson": ("PoissonMisfit",),
    "misfit.robust": ("RobustMisfit",),
    "prior.base": ("Majorant", "Prior"),
    "prior.edges": ("gradient_length",),
    "recording.background": ("background_surface", "noise_level"),
    "recording.noise": ("NoiseModel",),
    "recording.shear_axis": ("ShearAxis", "estimate_shear_axis"),
    "run.exact_images": ("exact_images",),
}
_FILE_OF = {name: file for file, names in _FILES.items() for name in names}


def __getattr__(name: str) -> Any:
    """A public name, from its file (PEP 562)."""
    if name not in _FILE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_FILE_OF[name]}"), name)
    globals()[name] = value  # asked for once
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
