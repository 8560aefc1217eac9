"""Single changes of a recording, and what each adds to what its images tell."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

from recon.coverage.acquisition import NoisyAcquisition
from torchdic import Prism
from torchdic.scalar import number

# Shears and biases that differ by less than this are alike, in rad.
ALIKE = 0.1


@dataclass(frozen=True, eq=False)
class Change:
    """A change of a recording. name: what is changed, in words. recording: with it. images: over those before."""

    name: str
    recording: NoisyAcquisition
    images: float


def changes(recording: NoisyAcquisition) -> Iterator[Change]:
    """The single changes that make sense: of prisms, planes, aperture and light. One takes planes away."""
    for name, other in (*_of_prisms(recording), *_of_planes(recording), *_of_light(recording)):
        yield Change(name, other, _images(other) / _images(recording))


def _images(recording: NoisyAcquisition) -> int:
    return len(recording.acquisition.prisms) * len(recording.acquisition.focus)


def _of_prisms(recording: NoisyAcquisition) -> Iterator[tuple[str, NoisyAcquisition]]:
    sheared = [(prism, noise) for prism, noise in recording.prisms if prism is not None]
    axes = [_axis(prism) for prism, _ in sheared]
    if sheared and all(_between(axis, axes[0]) < ALIKE for axis in axes):
        turned = [(_turned(prism), noise) for prism, noise in sheared]
        yield "a second shear axis, across the first", recording.with_prisms([*recording.prisms, *turned])
    signs = {(number(prism.bias) > 0) for prism, _ in sheared}
    if sheared and len(signs) == 1 and any(abs(math.sin(number(prism.bias))) > ALIKE for prism, _ in sheared):
        opposite = [(replace(prism, bias=-number(prism.bias)), noise) for prism, noise in sheared]
        yield "each setting with the opposite bias too", recording.with_prisms([*recording.prisms, *opposite])


def _axis(prism: Prism) -> float:
    """A shear's axis, 0 to π."""
    y, x = (number(part) for part in prism.shear)
    return math.atan2(y, x) % math.pi


def _between(one: float, other: float) -> float:
    """The angle between two axes."""
    apart = abs(one - other) % math.pi
    return min(apart, math.pi - apart)


def _turned(prism: Prism) -> Prism:
    """A prism whose shear is turned by a quarter of a turn."""
    y, x = (number(part) for part in prism.shear)
    return replace(prism, shear=(x, -y), axis=None)


def _of_planes(recording: NoisyAcquisition) -> Iterator[tuple[str, NoisyAcquisition]]:
    focus = recording.focus
    if len(focus) < 2:
        half = recording.grid.extent[0] / 4
        yield f"planes at ±{half:.2g} µm too", recording.with_focus([focus[0] - half, focus[0], focus[0] + half])
        return
    step = (focus[-1] - focus[0]) / (len(focus) - 1)
    more = max(1, len(focus) // 4)
    wider = [
        *(focus[0] - step * i for i in range(more, 0, -1)),
        *focus,
        *(focus[-1] + step * i for i in range(1, more + 1)),
    ]
    yield f"{2 * more} planes more, from {wider[0]:.3g} to {wider[-1]:.3g} µm", recording.with_focus(wider)
    between = [(a + b) / 2 for a, b in pairwise(focus)]
    yield f"planes half as far apart, {step / 2:.2g} µm", recording.with_focus(sorted([*focus, *between]))
    if len(focus) > 2 * more:
        inner = focus[more:-more]
        yield f"no planes beyond {inner[0]:.3g} to {inner[-1]:.3g} µm", recording.with_focus(inner)


def _of_light(recording: NoisyAcquisition) -> Iterator[tuple[str, NoisyAcquisition]]:
    condenser, objective = recording.microscope.condenser, recording.microscope.objective
    if condenser is not None and condenser.points is None and objective is not None:
        reach = round(objective.reach(recording.background), 3)
        if condenser.na < 0.95 * reach:
            wide = replace(recording.microscope, condenser=replace(condenser, na=reach, inner_na=None))
            yield f"the condenser opened to the objective's NA {reach:g}", replace(recording, microscope=wide)
    bright = tuple(noise / 2 for noise in recording.noise)
    yield "four times the light", replace(recording, noise=bright)
