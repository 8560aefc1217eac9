"""Several specimens in one medium."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from data_synthetic.specimen import Specimen
from torchdic.grid import Grid


@dataclass(frozen=True)
class Together(Specimen):
    """Several specimens in one medium; where they overlap, their Δn add up.

    parts: at least one. Raises ValueError where their media differ.
    """

    parts: tuple[Specimen, ...]

    def __post_init__(self) -> None:
        media = sorted({part.background for part in self.parts})
        if len(media) != 1:
            raise ValueError(f"specimens lie in media of index {media}: there must be one medium")
        object.__setattr__(self, "background", media[0])

    def _delta(self, grid: Grid) -> Float[Tensor, "z y x"]:
        return torch.stack([part.delta(grid) for part in self.parts]).sum(0)
