"""The shear of the prisms, which a specimen of known shape tells."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from recon.fit.nuisances.base import Nuisance
from recon.fit.setup import Setup
from recon.misfit.base import Misfit
from torchdic import Prism


@dataclass(frozen=True)
class ShearError(Nuisance):
    """A factor on the length of every prism's shear, and an angle in rad from +x towards +y by which all are turned.

    The value is (factor, angle), and the parameter the factor's logarithm and the angle. A declared axis of
    polarisation turns with the shear.

    The contrast of a weak specimen is the product of shear and Δn: learn the factor only against a specimen whose index
    and shape are known, such as a bead. Beside an unknown Δn it makes the volume worse.
    learning_rate, step: of the logarithm, and in rad.
    """

    learning_rate: float = 2e-3
    step: float = 0.02
    name = "shear"

    def start(self, setup: Setup, misfit: Misfit) -> Tensor:
        """A factor of 1 and an angle of 0. Raises ValueError where all images are bright field."""
        if all(prism is None for prism in setup.acquisition.prisms):
            raise ValueError("all images are bright field: there is no shear to learn")
        return misfit.data.new_zeros(2)

    def of_entries(self, entries: Tensor) -> Tensor:
        """(factor, angle)."""
        return torch.stack((entries[0].exp(), entries[1]))

    def put(self, value: Tensor, setup: Setup) -> Setup:
        """The setup with every shear stretched and turned."""
        prisms = [None if prism is None else turned_prism(prism, value) for prism in setup.acquisition.prisms]
        return replace(setup, acquisition=replace(setup.acquisition, prisms=prisms))


def turned_prism(prism: Prism, value: Tensor) -> Prism:
    """The prism with its shear stretched by a factor and turned by an angle from +x towards +y."""
    factor, angle = value
    y, x = prism.shear
    along, across = factor * angle.cos(), factor * angle.sin()
    axis = None if prism.axis is None else prism.axis + angle
    return replace(prism, shear=(y * along + x * across, x * along - y * across), axis=axis)
