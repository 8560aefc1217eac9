"""What a stack's images tell of the specimen that was found behind them."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from recon.config.schema import Config
from recon.coverage.acquisition import NoisyAcquisition
from recon.coverage.seen import Coverage
from recon.coverage.shortcoming import shortcoming
from recon.fit.newton.weak_hessian import lacks_of_linear_response
from recon.prior.base import contrast


def coverage_of(
    config: Config, noise: Sequence[float] | None, delta: Float[Tensor, "z y x"], *, roughly: bool = False
) -> Coverage | None:
    """What the images tell of a specimen of this contrast; None where no noise is known, or no weak specimen shows.

    noise: standard deviation of each prism's. delta: Δn that was found. roughly: in a second.
    """
    if noise is None or min(noise) <= 0 or lacks_of_linear_response(config.microscope, config.acquisition) is not None:
        return None
    recording = NoisyAcquisition(
        config.volume.grid, config.volume.background, config.microscope, config.acquisition, tuple(noise)
    )
    found = contrast(delta)
    expected = replace(config.coverage, contrast=found) if found > 0 else config.coverage
    return recording.coverage(expected, roughly=roughly)


def what_lacks(config: Config, found: Coverage | None) -> str | None:
    """What the images can't say of the specimen, in one line; None where they say much, or nobody knows."""
    lacking = lacks_of_linear_response(config.microscope, config.acquisition)
    if lacking is not None:
        return f"these images show nothing of a weak specimen (they need {lacking}): what is found of it is a guess"
    return None if found is None else shortcoming(found)
