"""The error bars that refits tell: of each voxel, and of the numbers of a volume's parts."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from recon.coverage.seen import cutoff
from recon.evidence.errors import ErrorModel, near, noise_deviation, noise_interval
from recon.evidence.estimate import Estimate
from recon.evidence.refits import Refit
from recon.evidence.regions import Known, Region, known_measures
from recon.evidence.turned import middle, turn, turned
from torchdic import Grid

# The whole volume's own region.
SPECIMEN = "specimen"


@dataclass(frozen=True, eq=False)
class ErrorBars:
    """What a volume's error bars are.

    grid: of the volume. delta: Δn. deviation: its standard deviation by noise. total: that of its whole error, noise
    and what is lost; all (z, y, x). interval: how many standard deviations by noise hold 68 % of what it does. regions:
    the volume's parts with their numbers, by name.
    """

    grid: Grid
    delta: Float[Tensor, "z y x"]
    deviation: Float[Tensor, "z y x"]
    total: Float[Tensor, "z y x"]
    interval: float
    regions: Mapping[str, tuple[Region, Mapping[str, Known]]]

    def typical(self, deviation: Float[Tensor, "z y x"]) -> float:
        """Root mean square of a deviation inside and near the specimen; 0 of an empty volume."""
        where = near(self.delta)
        return math.sqrt(float(deviation[where].double().square().mean())) if bool(where.any()) else 0.0

    @property
    def lost(self) -> float:
        """What is lost besides noise, root mean square inside and near the specimen."""
        return math.sqrt(self.typical(self.total) ** 2 - self.typical(self.deviation) ** 2)


def bars_of(
    estimate: Estimate,
    refits: Sequence[Refit],
    increment: float,
    outlines: Mapping[str, Bool[Tensor, "z y x"]] | None = None,
) -> ErrorBars:
    """The error bars that refits of an estimate tell.

    refits: of all kinds, one of them without noise. increment: of the index with concentration, ml/g.
    outlines: drawn around parts of the field's volume, by name.
    """
    setup = estimate.problem.setup
    grid, delta = setup.field, setup.within_field(estimate.delta).cpu()
    (noiseless,) = (refit.delta for refit in refits if refit.kind == "noiseless")
    off = torch.stack([refit.delta - noiseless for refit in refits if refit.kind == "noise"])
    deviation, interval = noise_deviation(off), noise_interval(off, near(delta))
    copies = [refit for refit in refits if refit.kind == "turned"]
    model = ErrorModel.of_copies(copies, grid, 1 / cutoff(setup))
    total = deviation if model is None else torch.maximum(model.deviation(delta), deviation)
    drawn = {SPECIMEN: torch.ones(delta.shape, dtype=torch.bool), **(outlines or {})}
    regions = {}
    for name, outline in drawn.items():
        region = Region.within(name, outline, delta)
        moved = {refit.number: _turned_outline(estimate, outline, refit.number) for refit in copies}
        regions[name] = region, known_measures(region, delta, grid, increment, refits, moved)
    return ErrorBars(grid, delta, deviation, total, interval, regions)


def _turned_outline(estimate: Estimate, outline: Bool[Tensor, "z y x"], copy: int) -> Bool[Tensor, "z y x"]:
    """An outline, turned as a copy of that number is."""
    setup = estimate.problem.setup
    whole = F.pad(outline.float()[None], (setup.margin,) * 4, mode="replicate")[0]
    moved = turned(whole, setup.volume.grid, middle(estimate.delta), turn(copy), order=0)
    return setup.within_field(moved) > 0
