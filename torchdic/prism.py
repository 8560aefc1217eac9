"""The Nomarski prism: two beams, displaced by the shear and out of phase by the bias."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Prism:
    """A Nomarski prism with its compensator.

    shear: full displacement (y, x) in µm between the two beams. bias: phase in rad by which beam 1, which is displaced
    by −shear/2 (so that it sees U(x + shear/2)), leads. Numbers or tensors; tensors are learned.
    Raises ValueError where a value is not finite or the shear isn't a pair.
    """

    shear: tuple[float | Tensor, float | Tensor] | Float[Tensor, " 2"]
    bias: float | Tensor

    def __post_init__(self) -> None:
        if len(self.shear) != 2:
            raise ValueError(f"shear has {len(self.shear)} components: it must be (y, x) in µm")
        for name, value in (("shear y", self.shear[0]), ("shear x", self.shear[1]), ("bias", self.bias)):
            number = float(torch.as_tensor(value, dtype=torch.float64).detach())
            if not math.isfinite(number):
                raise ValueError(f"{name} {number} must be a finite number")

    def transfer(self, frequencies: Float[Tensor, "2 y x"]) -> Float[Tensor, "y x"]:
        """sin(π f·s + bias/2): the two beams' interference behind a crossed analyser, but for a constant factor i.

        It is taken at the envelope's frequency f, not at the field's f + f_s: the condenser prism at work, which
        cancels the tilt's phase.
        """
        y, x = (torch.as_tensor(s, dtype=frequencies.dtype, device=frequencies.device) for s in self.shear)
        half_bias = torch.as_tensor(self.bias, dtype=frequencies.dtype, device=frequencies.device) / 2
        return torch.sin(math.pi * (frequencies[0] * y + frequencies[1] * x) + half_bias)
