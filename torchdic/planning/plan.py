"""The cheapest Fidelity that meets a tolerance, and which effects the scene calls for.

The error of images is one number: at each prism and focus plane the rms difference from the truth over the standard
deviation of the true image, and of these the largest. The truth is the wave's own converged answer (thin slabs, second
order, many sources, wide sides), since it contains bending, amplitude and diffraction.

Nothing is looked up by a specimen's name. Small pilots are run instead, with a few prisms and focus planes, on a window
where the specimen is busiest (`torchdic.pilots`); they climb ladders of sources, of slabs and of sides until the image
stands still (`torchdic.ladders`), and tell what each effect is worth (`torchdic.effects`).
"""

import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import torch

from torchdic.errors import SamplingWarning, SlabWarning, ToleranceWarning, UnstableError, WrapAroundWarning
from torchdic.fidelity import Fidelity
from torchdic.instrument.microscope import Acquisition, Microscope, check_apertures, check_sampling
from torchdic.planning.cost import directions, seconds, work
from torchdic.planning.effects import Climbed, Effect, counted, effects
from torchdic.planning.image_error import relative
from torchdic.planning.ladders import PREDICTED, Choice, side_ladder, source_ladder, sparse, way_ladder
from torchdic.planning.pilots import Scene
from torchdic.propagation.base import propagation_of
from torchdic.scalar import number
from torchdic.specimen.volume import Volume


@dataclass(frozen=True)
class Plan:
    """The cheapest fidelity that meets a tolerance, with what it is expected to give.

    error: predicted, as `torchdic.image_error` defines it. seconds: of one `image` without gradients, predicted. met:
    whether the tolerance is. planning: seconds that the plan took.
    """

    fidelity: Fidelity
    effects: tuple[Effect, ...]
    error: float
    seconds: float
    tolerance: float
    met: bool
    planning: float = field(compare=False)

    def table(self) -> str:
        """The effects as text, a row each, and what was chosen."""
        lines = [f"{'effect':<18}{'needed':<8}{'error without':>14}{'cost':>7}  how it is known"]
        for e in self.effects:
            error = "—" if e.basis == "absent" else f"{'≤ ' if e.basis == 'bound' else ''}{e.error:.2g}"
            known = e.basis + (f": {e.note}" if e.note else "")
            cost = "—" if e.basis == "absent" else f"{e.cost:.0%}"
            lines.append(f"{e.name:<18}{'yes' if e.needed else 'no':<8}{error:>14}{cost:>7}  {known}")
        verdict = "meets" if self.met else "misses" if self.error > self.tolerance else "too near to be sure of"
        return "\n".join(
            [
                *lines,
                f"{describe(self.fidelity)}: predicted error {self.error:.2g}, {verdict} {self.tolerance:g}; "
                f"predicted {self.seconds:.3g} s, planned in {self.planning:.2g} s",
            ]
        )

    def as_dict(self) -> dict[str, Any]:
        """What JSON can hold."""
        return {
            "fidelity": dict(vars(self.fidelity)),
            "effects": [dict(vars(e)) for e in self.effects],
            **{name: getattr(self, name) for name in ("error", "seconds", "tolerance", "met", "planning")},
        }


def describe(fidelity: Fidelity) -> str:
    """A fidelity's choices in a line."""
    parts = [f'"{fidelity.propagation}"', *propagation_of(fidelity).describe(fidelity)]
    parts.append(counted(fidelity.sources, "source"))
    if fidelity.padding:
        parts.append(f"{counted(fidelity.padding, 'voxel')} of padding")
    return ", ".join(parts)


@torch.no_grad()
def plan(volume: Volume, microscope: Microscope, acquisition: Acquisition, tolerance: float) -> Plan:
    """The cheapest Fidelity whose images err by at most `tolerance`, and what each effect is worth.

    The error is that of `torchdic.image_error`, against the wave on the same voxels: what voxels too coarse for the
    specimen lose is not in it. Where the specimen stays clear of the sides the truth is the specimen alone in its
    medium; where it reaches them, the periodic array that `image` computes without padding. Nothing in it is random,
    and no choice hangs on a clock. Raises ValueError for a tolerance that isn't positive, and as `image` does. Warns
    ToleranceWarning where no fidelity is sure to meet the tolerance: the plan is then the best one found.
    """
    if not (isinstance(tolerance, Real) and 0 < tolerance < math.inf):
        raise ValueError(f"tolerance {tolerance} must be above 0, and finite")
    check_apertures(microscope, number(volume.background))
    check_sampling(microscope, volume.grid)
    started = time.perf_counter()
    scene = Scene(_detached(volume), microscope, acquisition)
    with warnings.catch_warnings():
        for about_pilots in (SamplingWarning, SlabWarning, WrapAroundWarning):
            warnings.simplefilter("ignore", about_pilots)
        chosen = _plan(scene, float(tolerance))
    chosen = replace(chosen, planning=time.perf_counter() - started)
    if not chosen.met:
        worst = max(chosen.effects, key=lambda e: e.error)
        warnings.warn(
            f"no fidelity tried is sure to meet the tolerance {tolerance:g}, which takes a predicted error of "
            f"{PREDICTED * tolerance:.2g}: the best errs by about {chosen.error:.2g} "
            f"({describe(chosen.fidelity)}; {worst.name} matters most); ask for "
            f"{_two_digits_up(chosen.error / PREDICTED)}, or take finer voxels, a narrower condenser or wider sides",
            ToleranceWarning,
            stacklevel=3,
        )
    return chosen


def _plan(scene: Scene, tolerance: float) -> Plan:
    pilot = scene.hardest().window()
    slabs = pilot.coarse()
    coarse = next(slabs)
    while True:
        try:
            climbed = _climb(scene, pilot, coarse, tolerance)
            fidelity, error = _cheapest(scene, pilot, climbed, tolerance)
            worth = effects(scene, climbed, fidelity, tolerance)
            break
        except UnstableError:
            finer = next(slabs, None)
            if finer is None:
                raise
            coarse = finer
    met = error <= PREDICTED * tolerance
    duration = seconds(scene.volume, scene.microscope, scene.acquisition, fidelity)
    return Plan(fidelity, worth, error, duration, tolerance, met, 0.0)


def _climb(scene: Scene, pilot: Scene, coarse: Fidelity, tolerance: float) -> Climbed:
    """The three ladders of a scene; the pilot's `coarse` slabs serve the questions that aren't about slabs."""
    counts, dense = source_ladder(pilot, coarse, tolerance)
    few = sparse(pilot, counts, dense)
    ways, truth = way_ladder(few, tolerance)
    if counts:
        # the truth's image with all its sources, by what they change in the coarse one
        truth = truth + dense - few(coarse)
    else:
        counts = [Choice(replace(coarse, sources=directions(scene.microscope, 1)), torch.zeros_like(truth))]
    whole = replace(scene, microscope=pilot.microscope, acquisition=pilot.acquisition)
    sides = side_ladder(whole, coarse, tolerance)
    return Climbed(few, coarse, truth, ways, counts, sides)


def _cheapest(scene: Scene, pilot: Scene, climbed: Climbed, tolerance: float) -> tuple[Fidelity, float]:
    """The cheapest choice whose error stays within its part of the tolerance, or else the best, with its error.

    pilot: with all of the condenser's sources, because slabs that carry the light of a few may not carry that of all.
    """

    def joined() -> Iterator[tuple[Fidelity, float]]:
        for way in climbed.ways:
            for count in climbed.counts:
                error = relative(way.lacks + count.lacks, climbed.truth)
                for side in climbed.sides:
                    choice = replace(way.fidelity, sources=count.fidelity.sources, padding=side.padding)
                    yield choice, math.hypot(error, count.beyond, side.error(choice.sources))

    def cost(choice: tuple[Fidelity, float]) -> float:
        return work(choice[0], scene.volume, scene.microscope, scene.acquisition)

    strained = pilot.strained or climbed.pilot.strained
    tried = list(joined())
    meeting = sorted((choice for choice in tried if choice[1] <= PREDICTED * tolerance), key=cost)
    for choice in (*meeting, *sorted(tried, key=lambda choice: choice[1])):
        if not strained or pilot.carries(choice[0]):
            return choice
    most = max(way.fidelity.steps or 0 for way in climbed.ways)
    raise UnstableError(f"no number of slabs up to {most} carries the light of all sources")


def _two_digits_up(value: float) -> str:
    """A value to two digits, rounded up, so that asking for it is enough; as it is where it isn't finite."""
    if not 0 < value < math.inf:
        return f"{value:g}"
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / unit) * unit:.2g}"


def _detached(volume: Volume) -> Volume:
    absorption = None if volume.absorption is None else volume.absorption.detach()
    return Volume(volume.grid, volume.delta.detach(), volume.background.detach(), absorption)
