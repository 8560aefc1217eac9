"""The cheapest Fidelity that meets a tolerance, and which effects a scene needs.

The error of images is one number, see `torchdic.planning.image_error`. The truth is the wave's own converged image, of
thin slabs in second order, many sources and wide sides, because it contains bending, amplitude and diffraction.

Nothing is looked up by a specimen's name. Small images, the pilots, are computed instead: with a few prisms and focus
planes, in a window where the specimen is busiest (`torchdic.planning.pilots`). Their sources, slabs and sides are
refined one after the other until the image stands still (`torchdic.planning.ladders`), and they tell what each effect
is worth (`torchdic.planning.effects`).
"""

import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from numbers import Real
from typing import Any

import torch

from torchdic.errors import (
    ApertureWarning,
    SamplingWarning,
    SlabWarning,
    ToleranceWarning,
    UnstableError,
    WrapAroundWarning,
)
from torchdic.fidelity import Fidelity
from torchdic.instrument.microscope import Acquisition, Microscope, check_sampling, in_medium
from torchdic.planning.cost import seconds
from torchdic.planning.effects import Effect, effects
from torchdic.planning.image_error import relative
from torchdic.planning.ladders import PILOT_SHARE, Climbed, climb
from torchdic.planning.pilots import Scene
from torchdic.planning.worth import PlannedScene, counted
from torchdic.propagation.base import propagation_of
from torchdic.scalar import number
from torchdic.specimen.volume import Volume


@dataclass(frozen=True)
class Plan:
    """The cheapest fidelity that meets a tolerance, and what to expect of it.

    fidelity: what to call `torchdic.image` with.
    effects: what each effect of the scene is worth, in the order of the table; empty where nobody asked.
    error: of the images, predicted; see `torchdic.planning.image_error`.
    seconds: predicted, of one image without its gradient.
    tolerance: the largest error that was asked for.
    met: whether the predicted error is so far below the tolerance that the images are sure to meet it.
    planning: seconds that it took to make the plan.
    """

    fidelity: Fidelity
    effects: tuple[Effect, ...]
    error: float
    seconds: float
    tolerance: float
    met: bool
    planning: float = field(compare=False)

    def table(self) -> str:
        """The effects as text, one row each, and below them the fidelity that was chosen."""
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
        """The plan as values that JSON can hold."""
        return {
            "fidelity": dict(vars(self.fidelity)),
            "effects": [dict(vars(e)) for e in self.effects],
            **{name: getattr(self, name) for name in ("error", "seconds", "tolerance", "met", "planning")},
        }


def describe(fidelity: Fidelity) -> str:
    """A fidelity in one line of words."""
    parts = [f'"{fidelity.propagation}"', *propagation_of(fidelity).describe(fidelity)]
    parts.append(counted(fidelity.sources, "source"))
    if fidelity.padding:
        parts.append(f"{counted(fidelity.padding, 'voxel')} of padding")
    return ", ".join(parts)


@torch.no_grad()
def plan(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, tolerance: float, *, with_effects: bool = True
) -> Plan:
    """Find the cheapest Fidelity whose images err by at most `tolerance`, and what each effect is worth.

    volume: the specimen.
    microscope: with which it is seen.
    acquisition: the prism settings and focus planes (µm) that are recorded.
    tolerance: the largest error of an image, as a part of its contrast, above 0: 0.05 is 5 % of the image's standard
        deviation; see `torchdic.planning.image_error`.
    with_effects: whether to find what each effect is worth; the fidelity is the same without, and found sooner.

    Images are compared with the wave's converged ones on the same voxels: what is lost where voxels are too coarse for
    the specimen doesn't count. Where the specimen stays clear of the volume's sides, the truth is the specimen alone in
    its medium; where it reaches them, the truth is the periodic array that `image` computes without padding. The same
    scene gives the same fidelity each time: nothing is random, and no choice depends on a clock.
    Raises ValueError for a tolerance that isn't positive and finite, and what `image` raises. Warns with
    ToleranceWarning where no fidelity is sure to meet the tolerance; the plan is then the best one found.
    """
    if not (isinstance(tolerance, Real) and 0 < tolerance < math.inf):
        raise ValueError(f"tolerance {tolerance} must be above 0, and finite")
    n0 = number(volume.background)
    microscope = in_medium(microscope, n0, volume.delta.dtype)
    check_sampling(microscope, volume.grid, n0)
    started = time.perf_counter()
    scene = Scene(_detached(volume), microscope, acquisition)
    with warnings.catch_warnings():
        for about_pilots in (ApertureWarning, SamplingWarning, SlabWarning, WrapAroundWarning):
            warnings.simplefilter("ignore", about_pilots)
        chosen = _plan(scene, float(tolerance), with_effects)
    chosen = replace(chosen, planning=time.perf_counter() - started)
    if not chosen.met:
        worst = max(chosen.effects, key=lambda e: e.error, default=None)
        matters = "" if worst is None else f"; {worst.name} matters most"
        warnings.warn(
            f"no fidelity tried is sure to meet the tolerance {tolerance:g}, which takes a predicted error of "
            f"{PILOT_SHARE * tolerance:.2g}: the best errs by about {chosen.error:.2g} "
            f"({describe(chosen.fidelity)}{matters}); ask for "
            f"{_two_digits_up(chosen.error / PILOT_SHARE)}, or take finer voxels, a narrower condenser or wider sides",
            ToleranceWarning,
            stacklevel=3,
        )
    return chosen


def _plan(scene: Scene, tolerance: float, with_effects: bool) -> Plan:
    """A scene's plan; slabs that don't carry the light are made finer until they do."""
    pilot = scene.hardest().window()
    slabs = pilot.coarse()
    coarse = next(slabs)
    while True:
        try:
            climbed = climb(scene, pilot, coarse, tolerance)
            fidelity, error = _cheapest(scene, pilot, climbed, tolerance)
            worth = effects(PlannedScene(scene, climbed, fidelity, tolerance)) if with_effects else ()
            break
        except UnstableError:
            finer = next(slabs, None)
            if finer is None:
                raise
            coarse = finer
    met = error <= PILOT_SHARE * tolerance
    duration = seconds(scene.volume, scene.microscope, scene.acquisition, fidelity)
    return Plan(fidelity, worth, error, duration, tolerance, met, 0.0)


def _cheapest(scene: Scene, pilot: Scene, climbed: Climbed, tolerance: float) -> tuple[Fidelity, float]:
    """The cheapest choice whose error is a small enough part of the tolerance, with that error; otherwise the best one.

    pilot: with all of the condenser's sources, because slabs that carry the light of a few may not carry that of all.
    """
    strained = pilot.strained or climbed.pilot.strained
    tried = list(_joined(climbed))
    meeting = [choice for choice in tried if choice[1] <= PILOT_SHARE * tolerance]
    meeting.sort(key=lambda choice: scene.work(choice[0]))
    for choice in (*meeting, *sorted(tried, key=lambda choice: choice[1])):
        if not strained or pilot.carries(choice[0]):
            return choice
    most = max(way.fidelity.steps or 0 for way in climbed.ways)
    raise UnstableError(f"no number of slabs up to {most} carries the light of all sources")


def _joined(climbed: Climbed) -> Iterator[tuple[Fidelity, float]]:
    """Every way with every number of sources and every padding, and its error."""
    for way in climbed.ways:
        for count in climbed.counts:
            error = relative(way.lacks + count.lacks, climbed.truth)
            for side in climbed.sides:
                choice = replace(way.fidelity, sources=count.fidelity.sources, padding=side.padding)
                yield choice, math.hypot(error, count.beyond, side.error(choice.sources))


def _two_digits_up(value: float) -> str:
    """A value rounded up to two digits, so that it is enough to ask for; 0, inf and nan stay as they are."""
    if not 0 < value < math.inf:
        return f"{value:g}"
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / unit) * unit:.2g}"


def _detached(volume: Volume) -> Volume:
    """The volume without a graph."""
    absorption = None if volume.absorption is None else volume.absorption.detach()
    return Volume(volume.grid, volume.delta.detach(), volume.background.detach(), absorption)
