"""A grating etched into glass: the step, there and back, again and again."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from data_synthetic.etched import EtchedGlass
from data_synthetic.specimen import require_above_zero, require_finite


@dataclass(frozen=True)
class EtchedGlassGrating(EtchedGlass):
    """Glass with a ridge of `duty`·`period` in each period along `direction`; see `EtchedGlass`.

    A ridge begins at `offset` µm along the direction, rising by `height` there as the step does. period in
    µm; duty: the ridge's share of it. A negative height makes the ridges grooves. Raises ValueError also for
    a period not above 0 and a duty not between 0 and 1.
    """

    period: float = field(kw_only=True)
    duty: float = field(default=0.5, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_above_zero("period", self.period, "µm")
        require_finite("duty", self.duty, "")
        if not 0 < self.duty < 1:
            raise ValueError(f"duty {self.duty} must lie between 0 and 1")

    def from_wall(self, u: Float[Tensor, "*point"]) -> Float[Tensor, "*point"]:
        """Half the ridge's width less the distance from the middle of the nearest ridge."""
        half = self.duty * self.period / 2
        from_middle = torch.remainder(u - half + self.period / 2, self.period) - self.period / 2
        return half - from_middle.abs()
