"""The camera: what it records of an image's intensity."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Camera:
    """A camera that counts photoelectrons.

    photons: electrons per pixel in the empty bright field; None is a camera without shot noise. read_noise: standard
    deviation in electrons; None is none. `torchdic.image` gives the expected intensity; `record` draws from it.
    Raises ValueError where a number isn't positive, or read noise has no photons to be compared with.
    """

    photons: float | None = None
    read_noise: float | None = None

    def __post_init__(self) -> None:
        if self.photons is not None and not (0 < self.photons < math.inf):
            raise ValueError(f"photons {self.photons} per pixel of the empty bright field must be above 0")
        if self.read_noise is not None and not (0 <= self.read_noise < math.inf):
            raise ValueError(f"read_noise {self.read_noise} electrons must be at least 0")
        if self.read_noise is not None and self.photons is None:
            raise ValueError(f"read_noise {self.read_noise} electrons needs photons to be compared with")

    def record(self, intensity: Float[Tensor, "*image"], generator: torch.Generator) -> Float[Tensor, "*image"]:
        """One noisy recording of an intensity, both relative to the empty bright field; its shape, dtype and device."""
        if self.photons is None:
            return intensity
        electrons = torch.poisson(intensity * self.photons, generator=generator)
        if self.read_noise is not None:
            noise = torch.randn(intensity.shape, generator=generator, dtype=intensity.dtype, device=intensity.device)
            electrons = electrons + self.read_noise * noise
        return electrons / self.photons
