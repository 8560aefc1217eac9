"""Which effects a scene calls for, and the cheapest Fidelity that meets a tolerance.

The error of images is one number: at each prism and focus plane the rms difference from the truth over the standard
deviation of the true image, and of these the largest. The truth is the wave's own converged answer (thin slabs, second
order, many sources, wide sides), since it contains bending, amplitude and diffraction.

Nothing is looked up by a specimen's name. Small pilots are run instead, with a few prisms and focus planes, on a window
where the specimen is busiest:
- the number of sources doubles until the image stands still;
- slabs are halved and doubled; their error is second order, so two runs tell the third (Richardson);
- projection and rays are held against the converged wave;
- sides are widened where the light's cone reaches them.
What two parts lack is added as images, not as numbers, because their errors may cancel or add up.
"""

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdic.condenser import Condenser
from torchdic.fidelity import Fidelity
from torchdic.grid import Grid
from torchdic.image_error import relative
from torchdic.instrument import Acquisition, Microscope, SamplingWarning, check_apertures
from torchdic.microscope import image
from torchdic.rays import TurnedRaysError
from torchdic.volume import Volume
from torchdic.wave import UnstableError

# What a pilot predicts must stay below this part of the tolerance: the rest is for what a window and few planes miss.
MARGIN = 0.6
# Sources of the condenser's quadrature, K rings of 2K: each is as good as its number can be.
COUNTS = (1, 8, 18, 32, 50, 72, 128, 200, 392)
# Voxels along each side of a pilot's window; the whole array if it isn't much wider.
WINDOW = 64
# Reach of a lens's own blur in wavelengths over NA: the tail that a pupil's edge leaves falls off slowly.
BLUR = 12.0
# Slabs at least of pilots that ask about something other than slabs.
COARSE = 4
# Work in units of one FFT of a source's field, pointwise work included, measured on a CPU from 64² to 256² pixels.
SETUP, IMAGE, ABSORBING = 30.0, 4.5, 27.0
SLAB = {1: 3.5, 2: 5.0}
SLICE = {"linear": 5.0, "cubic": 90.0}
BENT_SLICE = 260.0


class ToleranceWarning(UserWarning):
    """No fidelity that was tried meets the tolerance; its message says by how much the best one misses it, and why."""


@dataclass(frozen=True)
class Effect:
    """An effect, and what it is worth.

    needed: whether leaving it out alone would break the tolerance. error: of the images if it is left out, estimated.
    cost: share of the run's work that would be saved without it. basis: where the estimate comes from, "pilot", "bound"
    (the error is at most this) or "absent" (the scene doesn't declare it). note: what was compared, or chosen.
    """

    name: str
    needed: bool
    error: float
    cost: float
    basis: str
    note: str = ""


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
            lines.append(f"{e.name:<18}{'yes' if e.needed else 'no':<8}{error:>14}{e.cost:>7.0%}  {known}")
        verdict = "meets" if self.met else "misses"
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
    parts = [f'"{fidelity.propagation}"']
    if fidelity.propagation == "wave":
        parts.append(f"{fidelity.steps or 'one a slice'} slabs of order {fidelity.order}")
    sides = f", {fidelity.padding} voxels of padding" if fidelity.padding else ""
    return ", ".join([*parts, f"{fidelity.sources} sources"]) + sides


@torch.no_grad()
def plan(volume: Volume, microscope: Microscope, acquisition: Acquisition, tolerance: float) -> Plan:
    """The cheapest Fidelity whose images err by at most `tolerance`, and what each effect is worth.

    The error is that of `torchdic.image_error`. Where the specimen stays clear of the sides the truth is the specimen
    alone in its medium; where it reaches them, the periodic array that `image` computes without padding. Nothing in it
    is random, and no choice hangs on a clock. Raises ValueError for a tolerance that isn't positive, and as `image`
    does. Warns ToleranceWarning where no fidelity meets the tolerance: the plan is then the best one found.
    """
    if not (isinstance(tolerance, int | float) and 0 < tolerance < math.inf):
        raise ValueError(f"tolerance {tolerance} must be above 0, and finite")
    check_apertures(microscope, float(volume.background))
    started = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        chosen = _plan(_detached(volume), microscope, acquisition, float(tolerance))
    chosen = replace(chosen, planning=time.perf_counter() - started)
    if not chosen.met:
        worst = max(chosen.effects, key=lambda e: e.error)
        warnings.warn(
            f"no fidelity tried meets the tolerance {tolerance:g}: the best errs by about {chosen.error:.2g} "
            f"({describe(chosen.fidelity)}; {worst.name} matters most); ask for {chosen.error / MARGIN:.2g}, or take "
            "finer voxels, a narrower condenser or wider sides",
            ToleranceWarning,
            stacklevel=3,
        )
    return chosen


@dataclass(frozen=True, eq=False)
class _Pilot:
    """A scene small enough to be imaged many times."""

    volume: Volume
    microscope: Microscope
    acquisition: Acquisition

    def __call__(self, fidelity: Fidelity) -> Tensor:
        return image(self.volume, self.microscope, self.acquisition, fidelity)

    def nothing(self) -> Tensor:
        """Images of nan, for what can't be computed."""
        _, ny, nx = self.volume.grid.shape
        return self.volume.delta.new_full((len(self.acquisition.prisms), len(self.acquisition.focus), ny, nx), math.nan)

    @property
    def slices(self) -> int:
        return self.volume.grid.shape[0]

    @property
    def coarse(self) -> Fidelity:
        """For what has nothing to do with slabs, in slabs half as deep as the objective's field or thinner."""
        grid, n0, objective = self.volume.grid, float(self.volume.background), self.microscope.objective
        na = n0 if objective is None else objective.na
        deepest = n0 * self.microscope.wavelength / (2 * na**2)
        return Fidelity("wave", steps=min(self.slices, max(COARSE, math.ceil(grid.extent[0] / deepest))), order=1)


@dataclass(frozen=True, eq=False)
class _Choice:
    """One way to compute, the images by which it falls short of the best one tried, and what that one may lack."""

    fidelity: Fidelity
    lacks: Tensor
    beyond: float = 0.0


def _plan(volume: Volume, microscope: Microscope, acquisition: Acquisition, tolerance: float) -> Plan:
    pilot = _Pilot(_window(volume, WINDOW), microscope, _extremes(acquisition, volume.mean_plane()))
    counts, dense = _sources(pilot, tolerance)
    few = _fewer(pilot, counts, dense, tolerance)
    ways, truth = _ways(few, tolerance)
    if counts:
        # the truth's image with all its sources, by what they change in the coarse one
        sparse = few(few.coarse)
        truth = truth + dense - sparse
    else:
        counts = [_Choice(_given(microscope), torch.zeros_like(truth))]
    sides = _sides(volume, microscope, pilot.acquisition)

    def total(way: _Choice, count: _Choice, side: tuple[int, float]) -> float:
        return math.hypot(relative(way.lacks + count.lacks, truth), count.beyond, side[1])

    def joined(way: _Choice, count: _Choice, side: tuple[int, float]) -> Fidelity:
        return replace(way.fidelity, sources=count.fidelity.sources, padding=side[0])

    trials = [
        (work(joined(w, c, s), volume, microscope, acquisition), total(w, c, s), (w, c, s))
        for w in ways
        for c in counts
        for s in sides
    ]
    meeting = [t for t in trials if t[1] <= MARGIN * tolerance]
    if meeting:
        _, error, best = min(meeting, key=lambda t: t[0])
    else:
        _, error, best = min(trials, key=lambda t: t[1])
    fidelity = joined(*best)
    effects = _effects(volume, microscope, acquisition, tolerance, few, truth, ways, counts, sides, fidelity)
    seconds = _seconds(volume, microscope, acquisition, fidelity)
    return Plan(fidelity, effects, error, seconds, tolerance, bool(meeting), 0.0)


def _sources(pilot: _Pilot, tolerance: float) -> tuple[list[_Choice], Tensor]:
    """Numbers of sources with what they lack, up to where the coarse image stands still, and that image.

    No choices where the condenser leaves none.
    """
    condenser = pilot.microscope.condenser
    if condenser is None or condenser.points is not None or condenser.na == 0:
        return [], pilot(pilot.coarse)
    seen: list[tuple[Fidelity, Tensor]] = []
    beyond = 0.0
    for count in COUNTS:
        if condenser.inner_na is not None and count < 2:
            continue
        seen.append((replace(pilot.coarse, sources=count), pilot(replace(pilot.coarse, sources=count))))
        if count < 18 or len(seen) < 3:
            continue  # fewer may agree by chance
        (_, before), (_, previous), (_, last) = seen[-3:]
        still = relative(last - previous, last)
        # behind a sharp pupil the error falls as 1/K at worst; a geometric fall shows in three numbers above a few
        left = min(1 / (count / seen[-2][0].sources - 1), 1.0)
        if seen[-3][0].sources > 1:
            fall = min(still / max(relative(previous - before, last), 1e-300), 0.9)
            left = min(left, max(fall / (1 - fall), 0.1))
        beyond = left * still
        if beyond <= MARGIN / 2 * tolerance:
            break
    return [_Choice(f, i - seen[-1][1], beyond) for f, i in seen], seen[-1][1]


def _fewer(pilot: _Pilot, counts: Sequence[_Choice], dense: Tensor, tolerance: float) -> _Pilot:
    """The pilot with as few sources as tell its ways of crossing the specimen apart."""
    wanted = 18
    if counts:
        enough = (c.fidelity.sources for c in counts if relative(c.lacks, dense) <= 0.1)
        wanted = min(max(next(enough, 18), 8), 18)
    return _lit(pilot, wanted)


def _lit(pilot: _Pilot, wanted: int) -> _Pilot:
    """The pilot with so many sources at most, a few of the condenser's own where it names them."""
    condenser = pilot.microscope.condenser
    if condenser is None:
        return pilot
    points, weights = condenser.sources(wanted, dtype=torch.float64)
    if len(points) > wanted:
        some = torch.linspace(0, len(points) - 1, wanted).round().long()
        points, weights = points[some], weights[some]
    return replace(pilot, microscope=replace(pilot.microscope, condenser=Condenser(condenser.na, points, weights)))


def _ways(pilot: _Pilot, tolerance: float) -> tuple[list[_Choice], Tensor]:
    """Ways to cross the specimen with the images that they lack, and the wave's converged image."""
    slices = pilot.slices
    runs: dict[tuple[int, int], Tensor] = {}

    def run(steps: int, order: int = 2) -> Tensor:
        if (steps, order) not in runs:
            try:
                runs[steps, order] = pilot(Fidelity("wave", steps=steps, order=1 if order == 1 else 2))
            except UnstableError:
                if steps >= 8 * slices:
                    raise
                runs[steps, order] = pilot.nothing()
        return runs[steps, order]

    fine = max(slices, 2)
    ladder = [-(-fine // 2), fine, 2 * fine]  # slabs that merge slices tell nothing of those that divide them
    while True:
        coarser, middle, finest = (run(m) for m in ladder[-3:])
        last = relative(finest - middle, finest)
        # between first order, at edges, and the split step's second
        ratio = min(max(1.5, relative(middle - coarser, finest) / max(last, 1e-300)), 4.0)
        if last / (ratio - 1) <= MARGIN / 2 * tolerance or ladder[-1] >= 8 * slices:
            break
        ladder.append(2 * ladder[-1])
    truth = finest + (finest - middle) / (ratio - 1)

    ways = [_Choice(Fidelity("projection"), pilot(Fidelity("projection")) - truth)]
    for order in (2, 1):
        steps = ladder[-1]
        while steps >= 1:
            lacks = run(steps, order) - truth
            if not bool(torch.isfinite(lacks).all()):
                break
            ways.append(_Choice(Fidelity("wave", steps=steps, order=1 if order == 1 else 2), lacks))
            if steps == 1 or relative(ways[-1].lacks, truth) > 4 * tolerance:
                break
            steps = -(-steps // 2)
    return ways, truth


def _sides(volume: Volume, microscope: Microscope, acquisition: Acquisition) -> list[tuple[int, float]]:
    """Paddings in voxels, each with the error that light which comes back on the other side leaves."""
    width = _needed_padding(volume, microscope, acquisition)
    if width == 0:
        return [(0, 0.0)]
    # few sources make more fringes than many, so this takes more of them
    whole = _lit(_Pilot(volume, microscope, acquisition), 32)
    widths = sorted({0, -(-width // 4), -(-width // 2), width})
    images = [whole(replace(whole.coarse, padding=w)) for w in widths]
    errors = [relative(i - images[-1], images[-1]) for i in images]
    left = errors[-2] / 3  # the blur's tail falls off slowly: so much lies beyond the widest
    return [(w, e + left) for w, e in zip(widths, errors, strict=True)]


def _needed_padding(volume: Volume, microscope: Microscope, acquisition: Acquisition) -> int:
    """Voxels on each side beyond which no recorded light comes back; 0 where the specimen reaches a side."""
    grid, strength = volume.grid, volume.delta.abs()
    if volume.absorption is not None:
        strength = strength + volume.absorption
    there = strength > 1e-3 * strength.max()
    if not bool(there.any()):
        return 0
    spans = []
    for axis in range(3):
        filled = there.any(dim=tuple(a for a in range(3) if a != axis)).nonzero()
        spans.append((int(filled[0]), int(filled[-1])))
    gaps = [min(low, grid.shape[a] - 1 - high) * grid.spacing[a] for a, (low, high) in enumerate(spans) if a > 0]
    if min(gaps) == 0:
        return 0
    depths = [grid.centre(0, i) for i in spans[0]]
    distance = max(abs(float(torch.as_tensor(z)) - d) for z in acquisition.focus for d in depths)
    n0 = float(volume.background)
    sine = min((n0 if microscope.objective is None else microscope.objective.na) / n0, 0.95)
    shear = max((float(torch.as_tensor(p.shear).abs().max()) for p in acquisition.prisms if p is not None), default=0.0)
    reach = distance * sine / math.sqrt(1 - sine**2) + shear + BLUR * microscope.wavelength / (n0 * sine)
    beyond = max((reach - gap) / grid.spacing[a + 1] for a, gap in enumerate(gaps))
    return min(max(0, math.ceil(beyond / 2)), max(grid.shape[1:]) // 2)


def work(fidelity: Fidelity, volume: Volume, microscope: Microscope, acquisition: Acquisition) -> float:
    """What an image costs, in FFT butterflies: sources × (what crosses the specimen + images) × N log2 N."""
    slices, ny, nx = volume.grid.widened(fidelity.padding, fidelity.padding).shape
    pixels = ny * nx
    condenser = microscope.condenser or Condenser(0.0)
    sources = len(condenser.sources(fidelity.sources)[1])
    if fidelity.propagation == "wave":
        extra = 0.0 if volume.absorption is None else ABSORBING
        inside = (fidelity.steps or slices) * (SLAB[fidelity.order] + extra)
    elif fidelity.propagation == "projection":
        inside = slices * SLICE[fidelity.interpolation] * (1 if volume.absorption is None else 2)
    else:
        inside = (fidelity.steps or slices) * BENT_SLICE
    polarisation = microscope.polarisation
    fields = 1
    if microscope.vectorial:
        assert polarisation is not None
        fields = polarisation.states
    elif polarisation is not None and not polarisation.ideal:
        fields = 2
    images = fields * len(acquisition.prisms) * len(acquisition.focus)
    colours = len(microscope.colours())
    return colours * sources * (SETUP + inside + IMAGE * images) * pixels * math.log2(max(pixels, 2))


def _effects(
    volume: Volume,
    microscope: Microscope,
    acquisition: Acquisition,
    tolerance: float,
    few: _Pilot,
    truth: Tensor,
    ways: Sequence[_Choice],
    counts: Sequence[_Choice],
    sides: Sequence[tuple[int, float]],
    fidelity: Fidelity,
) -> tuple[Effect, ...]:
    whole = work(fidelity, volume, microscope, acquisition)

    def saved(other: float) -> float:
        return max(0.0, 1 - other / whole)

    def effect(name: str, error: float, note: str, cost: float = 0.0, basis: str = "pilot") -> Effect:
        return Effect(name, error > tolerance, error, cost, basis, note)

    def absent(name: str) -> Effect:
        return Effect(name, False, 0.0, 0.0, "absent")

    straight = relative(ways[0].lacks, truth)
    projected = saved(work(replace(fidelity, propagation="projection"), volume, microscope, acquisition))
    effects = [effect(*row, basis=basis) for row, basis in _ladder(few, straight, tolerance)]
    effects[0] = replace(effects[0], cost=projected)

    K = fidelity.sources
    if counts[0].fidelity.sources == K and len(counts) == 1:
        note = f"the condenser's own {K} direction{'s' if K > 1 else ''}"
        effects.append(Effect("partial coherence", K > 1, 0.0, 0.0, "absent", note))
    else:
        alone = work(replace(fidelity, sources=counts[0].fidelity.sources), volume, microscope, acquisition)
        note = f"{counts[0].fidelity.sources} source in place of {K}"
        effects.append(effect("partial coherence", relative(counts[0].lacks, truth), note, saved(alone)))

    base = few(few.coarse)
    single = few(replace(few.coarse, steps=1, order=2)) - few(replace(few.coarse, order=2))
    one = work(replace(fidelity, steps=1), volume, microscope, acquisition)
    effects.append(effect("steps", relative(single, truth), "one slab in place of several", saved(one)))
    paraxial = few(replace(few.coarse, defocus="paraxial")) - base
    effects.append(effect("defocus", relative(paraxial, truth), "paraxial in place of exact"))
    if sides[-1][0] > 0:
        unpadded = work(replace(fidelity, padding=0), volume, microscope, acquisition)
        effects.append(effect("sides", sides[0][1], "no padding", saved(unpadded)))
    else:
        effects.append(absent("sides"))

    def without(name: str, declared: object, other: _Pilot) -> Effect:
        if declared is None:
            return absent(name)
        less = saved(work(fidelity, replace_volume(volume, other), other.microscope, acquisition))
        return effect(name, relative(other(few.coarse) - base, base), "left out", less)

    def replace_volume(full: Volume, other: _Pilot) -> Volume:
        keeps = other.volume.absorption is not None
        return Volume(full.grid, full.delta, full.background, full.absorption if keeps else None)

    scalar = replace(few, microscope=replace(few.microscope, polarisation=None))
    effects.append(without("polarisation", microscope.polarisation, scalar))
    window = few.volume
    clear = replace(few, volume=Volume(window.grid, window.delta, window.background))
    effects.append(without("absorption", volume.absorption, clear))
    if microscope.spectrum is not None:
        one_colour = replace(few, microscope=replace(few.microscope, spectrum=None))
        effects.append(without("spectrum", microscope.spectrum, one_colour))
    camera = microscope.camera
    if camera is None:
        effects.append(absent("camera"))
    elif camera.pixel_size is None:
        effects.append(Effect("camera", False, 0.0, 0.0, "bound", "its noise is added to a noiseless image"))
    else:
        sharp = replace(few, microscope=replace(few.microscope, camera=None))(few.coarse)
        pixel = camera.pixel_spacing((few.volume.grid.spacing[1], few.volume.grid.spacing[2]))
        blurred = _through_pixels(sharp, few.volume.grid, pixel)
        effects.append(effect("camera", relative(blurred - sharp, blurred), "pixels that see no area"))
    return tuple(effects)


def _through_pixels(images: Tensor, grid: Grid, pixel: tuple[float, float]) -> Tensor:
    """Images averaged over a pixel's area at each voxel."""
    fy, fx = grid.frequencies(dtype=images.dtype, device=images.device)
    window = torch.sinc(fy * pixel[0]) * torch.sinc(fx * pixel[1])
    return torch.fft.ifft2(torch.fft.fft2(images) * window).real


def _ladder(few: _Pilot, straight: float, tolerance: float) -> list[tuple[tuple[str, float, str], str]]:
    """What each rung between straight rays and waves adds; bounds where projection is good enough or rays fail.

    Rays cost so much that they see a smaller window, at three directions and in few steps.
    """
    names = "bending", "amplitude", "diffraction", "object aberration"
    whole = "all that projection lacks"
    if straight <= tolerance / 2:
        return [((name, straight, whole), "bound") for name in names]
    focus = [few.acquisition.focus[0], few.acquisition.focus[-1]]
    small = _Pilot(_window(few.volume, 32), few.microscope, Acquisition(few.acquisition.prisms[:1], focus))
    small = _lit(small, 3)
    rays = Fidelity("rays", steps=min(small.slices, 12))
    try:
        projected = small(Fidelity("projection"))
        bent = small(replace(rays, amplitude=False))
        carried = small(rays)
    except (TurnedRaysError, ValueError) as error:
        why = str(error).splitlines()[0]
        return [((name, straight, f"{whole}; {why}"), "bound") for name in names]
    wave = small(Fidelity("wave"))
    rows = [
        (("bending", relative(bent - projected, wave), "bent rays against straight ones"), "pilot"),
        (("amplitude", relative(carried - bent, wave), "rays with and without it"), "pilot"),
        (("diffraction", relative(wave - carried, wave), "the wave against rays"), "pilot"),
    ]
    try:
        own = small(Fidelity("projection", object_aberration="linear", steps=min(small.slices, 12)))
        note = "in straight rays; the wave has it already"
        rows.append((("object aberration", relative(own - projected, wave), note), "pilot"))
    except ValueError:
        rows.append((("object aberration", straight, f"{whole}; the specimen is too strong a lens"), "bound"))
    return rows


def _seconds(volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity) -> float:
    """Seconds of an image: those of two sources, few slabs and one focus on the whole array, scaled by the work."""
    condenser = microscope.condenser or Condenser(0.0)
    points, weights = condenser.sources(fidelity.sources, dtype=torch.float64)
    few = replace(microscope, condenser=Condenser(condenser.na, points[-2:], weights[-2:]))
    if float(weights[-2:].sum()) == 0:
        few = replace(microscope, condenser=Condenser(condenser.na, points[-2:]))
    short = replace(fidelity, steps=min(fidelity.steps or volume.grid.shape[0], 8))
    brief = Acquisition(acquisition.prisms, acquisition.focus[:1])
    best = math.inf
    for _ in range(2):
        started = time.perf_counter()
        image(volume, few, brief, short)
        best = min(best, time.perf_counter() - started)
    return best * work(fidelity, volume, microscope, acquisition) / work(short, volume, few, brief)


def _given(microscope: Microscope) -> Fidelity:
    condenser = microscope.condenser or Condenser(0.0)
    return Fidelity(sources=len(condenser.sources(1)[1]))


def _detached(volume: Volume) -> Volume:
    absorption = None if volume.absorption is None else volume.absorption.detach()
    return Volume(volume.grid, volume.delta.detach(), volume.background.detach(), absorption)


def _window(volume: Volume, side: int) -> Volume:
    """The part of a volume, about `side` voxels wide, where Δn varies most, faded out towards its own sides.

    An axis up to a quarter as long again is kept whole.
    """
    shape = volume.grid.shape
    size = [n if n <= 1.25 * side else side for n in shape[1:]]
    if size == list(shape[1:]):
        return volume
    strength = volume.delta if volume.absorption is None else volume.delta.abs() + volume.absorption
    steep = sum(torch.gradient(strength, dim=a)[0].square() for a in (1, 2) if shape[a] > 1)
    busy = (steep + 1e-6 * strength.square()).sum(0)[None, None]  # pyright: ignore[reportOperatorIssue, reportAttributeAccessIssue]
    sums = F.avg_pool2d(busy, size, stride=1)[0, 0]
    row, column = divmod(int(sums.argmax()), sums.shape[1])
    fades = []
    for length, full in zip(size, shape[1:], strict=True):
        ramp = torch.ones(length, dtype=strength.dtype, device=strength.device)
        if length < full:
            width = length // 8
            rise = torch.sin(math.pi / 2 * (torch.arange(width, device=ramp.device) + 0.5) / width).square().to(ramp)
            ramp[:width], ramp[-width:] = rise, rise.flip(0)
        fades.append(ramp)
    fade = fades[0][:, None] * fades[1]
    parts = [
        None if part is None else part[:, row : row + size[0], column : column + size[1]] * fade
        for part in (volume.delta, volume.absorption)
    ]
    assert parts[0] is not None
    grid = Grid((shape[0], size[0], size[1]), volume.grid.spacing)
    return Volume(grid, parts[0], volume.background, parts[1])


def _extremes(acquisition: Acquisition, plane: float) -> Acquisition:
    """The hardest images: the darkest, brightest and most sheared prism, the farthest focus and the nearest."""
    prisms = acquisition.prisms
    levels = [1.0 if p is None else math.sin(float(torch.as_tensor(p.bias)) / 2) ** 2 for p in prisms]
    shears = [0.0 if p is None else float(torch.as_tensor(p.shear).norm()) for p in prisms]
    picked = {levels.index(min(levels)), levels.index(max(levels)), shears.index(max(shears)), len(prisms) - 1}
    depths = [float(torch.as_tensor(z)) for z in acquisition.focus]
    away = [abs(z - plane) for z in depths]
    planes = {depths.index(min(depths)), away.index(min(away)), depths.index(max(depths))}
    return Acquisition([prisms[i] for i in sorted(picked)], [acquisition.focus[i] for i in sorted(planes)])
