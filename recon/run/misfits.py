"""The misfit that a configuration names, for the stack that it was given."""

from collections.abc import Callable

import torch
from torch import Tensor

from recon.config.schema import Config, ConfigError
from recon.misfit.base import Misfit
from recon.misfit.gaussian import GaussianMisfit
from recon.misfit.poisson import PoissonMisfit
from recon.misfit.robust import RobustMisfit
from recon.recording.background import known_levels
from recon.recording.noise import NoiseModel, noise_of_level
from recon.recording.preparation import Measured


def misfit_for(config: Config, measured: Measured) -> Callable[[Tensor], Misfit]:
    """What makes the configuration's misfit from the prepared images.

    Without a gain in [data], the Gaussian misfit goes by one noise for each prism, and the Poisson misfit by the gain
    that the stack shows. Pixels that don't count are masked. Raises ConfigError where the stack shows no gain.
    """
    named, model, counted = config.reconstruction.misfit, noise_model(config, measured), measured.left_out.counted

    def mask(data: Tensor) -> Tensor | None:
        # the sample by which a descent's memory is foreseen has other pixels, of which all count
        return None if counted is None or counted.shape != data.shape else torch.from_numpy(counted)

    if named == "robust":
        known = known_levels(report.noise or None for report in measured.prisms)  # a noise of 0 standardises nothing
        noise = None if known is None else torch.tensor(known)
        return lambda data: RobustMisfit(data, noise, mask(data))
    if named == "gaussian":
        return lambda data: GaussianMisfit(data, model, mask(data))
    model = model or noise_of_level(measured.data, counted)
    if model is None:
        raise ConfigError(
            "reconstruction.misfit: 'poisson' needs data.gain, counts per photoelectron: the noise of this stack "
            "doesn't tell it; use 'gaussian'"
        )
    return lambda data: PoissonMisfit(data, model, mask(data))


def noise_model(config: Config, measured: Measured) -> NoiseModel | None:
    """Shot and read noise in the unit of the prepared images, where the configuration gives the camera's gain."""
    section = config.data
    if section is None or section.gain is None:
        return None
    unit = torch.tensor([report.scale for report in measured.prisms])[:, None, None, None]
    return NoiseModel(section.gain, section.read_noise).in_unit(unit)
