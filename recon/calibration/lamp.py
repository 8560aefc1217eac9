"""A lamp that lights the field unevenly: what is left of it where the background was flattened around a specimen.

A background that is fitted to a field of which the specimen fills much is a little wrong, and a few per cent of it
change the bias by degrees. Beside a known specimen the rest shows.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.misfit.base import Misfit

# Terms of a curved surface: y, x, y², xy, x², each without its mean over the field; y and x run from −1 to 1.
TERMS = 5


@dataclass(frozen=True, eq=False)
class UnevenSetup(Setup):
    """A setup whose lamp lights each prism's images by 1 + a curved surface.

    lamp: the surface's coefficients (prism, 5); None is an even lamp.
    """

    lamp: Float[Tensor, "prism 5"] | None = None

    def _lit(self, images: Tensor) -> Tensor:
        lit = super()._lit(images)
        if self.lamp is None:
            return lit
        return lit * (1 + torch.einsum("pt,tyx->pyx", self.lamp.to(lit), _surfaces(lit)))[:, None]


@dataclass(frozen=True)
class Lamp(Nuisance):
    """The lamp's surface behind each prism (prism, 5), see `UnevenSetup`. learning_rate, step: of its coefficients."""

    learning_rate: float = 2e-3
    step: float = 0.02
    name = "lamp"
    axes = ("prism",)
    forms = False

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """An even lamp."""
        return misfit.data.new_zeros(misfit.data.shape[0], TERMS)

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with this lamp. Raises TypeError for one without a lamp."""
        if not isinstance(setup, UnevenSetup):
            raise TypeError("this setup's lamp is even")
        return replace(setup, lamp=value)


def _surfaces(images: Tensor) -> Float[Tensor, "5 y x"]:
    ny, nx = images.shape[-2:]
    y = torch.linspace(-1, 1, ny, dtype=images.dtype, device=images.device)[:, None].expand(ny, nx)
    x = torch.linspace(-1, 1, nx, dtype=images.dtype, device=images.device).expand(ny, nx)
    terms = torch.stack((y, x, y.square(), x * y, x.square()))
    return terms - terms.mean((1, 2), keepdim=True)
