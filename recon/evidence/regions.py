"""The numbers that are asked for of a volume's parts: volume, mean index and dry mass, each with its error.

Dry mass: a solution's index grows by the increment α with each g/ml of protein, α = 0.185 ml/g (R. Barer, J. Opt. Soc.
Am. 47, 545, 1957; R. Barer and S. Joseph, Quart. J. Microsc. Sci. 95, 399, 1954), so that a region holds ΣΔn·dV/α
more than as much of its medium. 1 g/ml is 1 pg/µm³.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from skimage.filters import threshold_otsu
from torch import Tensor

from recon.evidence.refits import Refit
from torchdic import Grid

# ml/g, of most proteins.
INCREMENT = 0.185

QUANTITIES = ("volume", "mean", "mass")

# How far a number is off in refits with noise from that without, and by which parts of itself it is off in copies.
Scatter = tuple[list[float], list[float]]

# Values that differ by less than this part of the largest are alike.
SPAN = 1e-6

# The largest part of a number that is believed to be lost.
MOST_LOST = 0.5


@dataclass(frozen=True, eq=False)
class Region:
    """A part of the volume: what lies above a threshold within an outline.

    name: of it. outline: drawn around it, (z, y, x). threshold: in Δn; below 0, what lies below it; None is all of the
    outline.
    """

    name: str
    outline: Bool[Tensor, "z y x"]
    threshold: float | None

    @classmethod
    def within(cls, name: str, outline: Bool[Tensor, "z y x"], delta: Float[Tensor, "z y x"]) -> "Region":
        """The region that stands out in an outline, by Otsu's threshold between it and what is around it."""
        values = delta[outline].double()
        sign = -1.0 if float(values.sum()) < 0 else 1.0
        span, largest = float(values.max() - values.min()), float(values.abs().max())
        if span <= SPAN * largest:
            return cls(name, outline, None if bool(values.any()) else 0.0)  # of nothing, nothing
        return cls(name, outline, sign * float(threshold_otsu((sign * values).numpy())))

    def voxels(self, delta: Float[Tensor, "z y x"]) -> Bool[Tensor, "z y x"]:
        """The region's voxels in a volume."""
        if self.threshold is None:
            return self.outline
        return self.outline & (delta > self.threshold if self.threshold >= 0 else delta < self.threshold)

    def measures(self, delta: Float[Tensor, "z y x"], grid: Grid, increment: float) -> dict[str, float]:
        """Volume in µm³, mean Δn and dry mass in pg; the mean of nothing is 0."""
        there = self.voxels(delta)
        number, voxel = int(there.sum()), math.prod(grid.spacing)
        total = float(delta[there].double().sum())
        return {"volume": number * voxel, "mean": total / number if number else 0.0, "mass": total * voxel / increment}


@dataclass(frozen=True)
class Known:
    """A number and how well it is known.

    found: as it is in the estimate. usual: by which part of themselves such numbers come out too large (or, below 0,
    too small) in copies of which the truth is known, on average. noise: its standard deviation by noise. whole: that of
    its whole error, as its copies' numbers scatter about nothing, not about their mean: of what the estimate has lost
    already, its copies can't lose as much once more.
    """

    found: float
    usual: float
    noise: float
    whole: float

    @property
    def value(self) -> float:
        """The best estimate: the number without what such numbers usually lose or gain (a bootstrap's correction)."""
        return self.found / (1 + self.usual)

    @property
    def error(self) -> float:
        """Standard deviation of the error."""
        return max(self.noise, self.whole)

    @property
    def loss(self) -> float:
        """The error's part that isn't noise."""
        return math.sqrt(self.error**2 - self.noise**2)

    def as_dict(self) -> dict[str, float]:
        """For JSON."""
        return {"value": self.value, "error": self.error, "loss": self.loss, **asdict(self)}


def known_measures(
    region: Region,
    delta: Float[Tensor, "z y x"],
    grid: Grid,
    increment: float,
    refits: Sequence[Refit],
    outlines: Mapping[int, Bool[Tensor, "z y x"]],
) -> dict[str, Known]:
    """The numbers of a region with their errors.

    In each refit its threshold is found anew, as it was in the estimate; and it is kept, for which the error may be
    larger, because where the part begins isn't known either. The larger one counts.
    delta: the estimate. refits: of all kinds, one of them without noise.
    outlines: the region's outline in each turned copy, by its number.
    """

    def anew(volume: Tensor, outline: Tensor) -> dict[str, float]:
        return Region.within(region.name, outline, volume).measures(volume, grid, increment)

    def kept(volume: Tensor, outline: Tensor) -> dict[str, float]:
        return replace(region, outline=outline).measures(volume, grid, increment)

    own = region.measures(delta, grid, increment)
    ways = [_scattered(way, region, refits, outlines) for way in (anew, kept)]
    return {name: _known(own[name], *(scatters[name] for scatters in ways)) for name in QUANTITIES}


def _scattered(
    measures: Callable[[Tensor, Tensor], dict[str, float]],
    region: Region,
    refits: Sequence[Refit],
    outlines: Mapping[int, Bool[Tensor, "z y x"]],
) -> dict[str, Scatter]:
    """How each of a region's numbers scatters. measures: all of them in a volume, within an outline.

    A copy tells nothing of a region that its turn has brought out of the field.
    """
    (noiseless,) = (measures(refit.delta, region.outline) for refit in refits if refit.kind == "noiseless")
    noisy = [measures(refit.delta, region.outline) for refit in refits if refit.kind == "noise"]
    pairs = [
        (measures(refit.truth, outlines[refit.number]), measures(refit.delta, outlines[refit.number]))
        for refit in refits
        if refit.truth is not None and bool(outlines[refit.number].any())
    ]
    return {
        name: (
            [one[name] - noiseless[name] for one in noisy],
            [found[name] / true[name] - 1 for true, found in pairs if true[name] != 0],
        )
        for name in QUANTITIES
    }


def _known(found: float, anew: Scatter, kept: Scatter) -> Known:
    """A number that was found. anew, kept: how it scatters with a threshold that is found anew, or kept."""
    usual = max(float(np.mean(anew[1])), -MOST_LOST) if anew[1] else 0.0
    noise, whole = (max(_root_mean_square(scatter[part]) for scatter in (anew, kept)) for part in (0, 1))
    return Known(found, usual, noise / (1 + usual), abs(found) * whole / (1 + usual))


def _root_mean_square(values: Sequence[float]) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if values else 0.0


def as_json(regions: Mapping[str, tuple[Region, Mapping[str, Known]]], background: float) -> dict[str, Any]:
    """Regions and their numbers as values that JSON can hold; the mean index is the medium's and Δn."""
    found: dict[str, Any] = {}
    for name, (region, numbers) in regions.items():
        told = {quantity: known.as_dict() for quantity, known in numbers.items()}
        index = told.pop("mean")
        found[name] = {
            "threshold": region.threshold,
            "volume_um3": told["volume"],
            "mean_index": {**index, "value": background + index["value"], "found": background + index["found"]},
            "dry_mass_pg": told["mass"],
        }
    return found
