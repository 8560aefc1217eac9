"""A step etched into glass, the paper's second manufactured specimen."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from data_synthetic.etched import EtchedGlass


@dataclass(frozen=True)
class EtchedGlassStep(EtchedGlass):
    """Glass whose surface is higher by `height` on the side that `direction` points to; see `EtchedGlass`.

    The edge runs through the point `offset` µm along the direction. A negative height is a step down.
    """

    def from_wall(self, u: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """The coordinate along the direction itself."""
        return u
