"""What most likely is wrong where a volume leaves far more than noise does, by the residual and by a few short fits.

A wrong sign, order or aperture leaves a residual that looks like the specimen, whatever the mistake. So the likely ones
are tried: each is a descent of a few coarse steps beside one with what was declared. What explains the stack far better
is named first. Other mistakes show in the residual itself: in a few pixels, at the border, in one prism, in one image.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.calibration.trials.declared import images_of, one_mistake
from recon.calibration.trials.short_fits import short_fit
from recon.fit.bounds import Bounds, SupportedBounds
from recon.fit.problem import Problem
from recon.fit.setup import Setup
from recon.fit.unknowns import IndexDifference
from recon.misfit.base import Misfit
from torchdic.scalar import number

# A change that explains less than LEAST of what is unexplained is no cause; after one that explains ENOUGH, no more is
# tried.
LEAST, ENOUGH = 0.25, 0.9

# The condenser's aperture is tried wider and narrower by this factor.
APERTURE = 1.3

# Where FEW of the pixels hold more than HALF of the squared residual, and their neighbours less than ALONE of theirs,
# the pixels are stuck.
FEW, HALF, ALONE = 0.01, 0.5, 0.25

# What is less than this part of the noise isn't seen.
STANDS_OUT = 0.1

# The frame's width over the shorter side, and how many times the squared residual within it must be that of the rest.
FRAME, BORDER = 1 / 10, 3.0

# The squared residual of one prism over the least one's, and of one image over the images' median, that stand out.
PRISM, IMAGE = 3.0, 6.0


PRIORS = "priors"

# Shears, planes and the sign of Δn, all three reversed, give the same images to first order. So what one of these
# reversals explains is explained as well by the rest of the three: this, and Δn of the other sign.
REST = {"sign": "reverse acquisition.focus", "focus": "reverse the sign of every shear", "sign and focus": ""}

# The name under which a configuration's `assumed` lists what a cause doubts.
SIGN, ORDER = "sign of Δn", "order of the planes"
DOUBTS = {"Δn's sign": SIGN, "focus": ORDER, "sign and focus": ORDER, "condenser": "condenser's NA"}

# A cause that doubts what is assumed comes before another that explains more by at most this share.
NEAR = 0.1


@dataclass(frozen=True)
class Cause:
    """What may be wrong.

    name: in one or two words. share: of what is unexplained, that this would explain; causes are ranked by it.
    reason: what speaks for it. advice: what to do.
    """

    name: str
    share: float
    reason: str
    advice: str


@dataclass(frozen=True, eq=False)
class Variant:
    """A problem as it would be had something been declared otherwise. what: the mistake, in words."""

    name: str
    what: str
    advice: str
    problem: Problem


def ranked(causes: Sequence[Cause], assumed: Sequence[str] = ()) -> tuple[Cause, ...]:
    """The likeliest cause first; of those that explain nearly as much, one that doubts what is assumed."""
    return tuple(sorted(causes, key=lambda cause: -cause.share - NEAR * (DOUBTS.get(cause.name) in assumed)))


# --- what the residual shows ------------------------------------------------------------------------------------------


@torch.no_grad()
def seen_in_residual(
    images: Float[Tensor, "prism focus y x"], misfit: Misfit, noise: float, margin: int
) -> Iterator[Cause]:
    """The causes that the residual shows by where it is.

    images: the model's. noise: what noise leaves of the misfit. margin: voxels of the volume beyond the field.
    """
    residual = misfit.where_counted(images - misfit.data) / misfit.variance.sqrt()
    squares = residual.square()
    excess = max(float(squares.mean()) - noise, STANDS_OUT * noise, 1e-12)
    yield from _stuck(squares.mean((0, 1)))
    level = float(residual.mean((2, 3)).square().mean())
    if level > HALF * excess:
        yield Cause(
            "brightness",
            min(1.0, level / excess),
            "the residual is uniform within each image",
            "bring the stack to the model's level (data.scale = 'background', data.flatten = true), or correct what "
            "sets it: the bias of each prism and the apertures (na)",
        )
    if margin == 0:
        yield from _cut(squares.mean((0, 1)), noise)
    yield from _uneven(squares.mean((2, 3)), noise)


def _stuck(power: Float[Tensor, "y x"]) -> Iterator[Cause]:
    """Pixels that leave most of the residual in all images, each by itself."""
    number_of = max(1, round(FEW * power.numel()))
    top = power.flatten().topk(number_of)
    share = float(top.values.sum() / power.sum())
    padded = torch.nn.functional.pad(power[None, None], (1, 1, 1, 1), mode="replicate")
    around = torch.nn.functional.unfold(padded, 3)[0].reshape(9, -1)
    beside = torch.cat([around[:4], around[5:]]).median(0).values[top.indices]
    alone = float((top.values * (beside < ALONE * top.values)).sum() / power.sum())
    if alone > HALF:
        yield Cause(
            "stuck pixels",
            share,
            f"{number_of} of {power.numel()} pixels hold {share:.0%} of the residual, each by itself",
            "leave them out: data.stuck = 'auto', or data.mask",
        )


def _cut(power: Float[Tensor, "y x"], noise: float) -> Iterator[Cause]:
    """A specimen that goes on beyond the field."""
    width = max(1, round(FRAME * min(power.shape)))
    within = power[width:-width, width:-width]
    if within.numel() == 0:
        return
    total = float((power - noise).sum())
    frame = total - float((within - noise).sum())
    ratio = frame / (power.numel() - within.numel()) / max(float((within - noise).mean()), STANDS_OUT * noise, 1e-12)
    if ratio > BORDER and total > 0:
        yield Cause(
            "cut specimen",
            min(1.0, frame / total),
            f"the residual at the images' border is {ratio:.1f} times that within",
            "widen the volume beyond the field: reconstruction.margin",
        )


def _uneven(power: Float[Tensor, "prism focus"], noise: float) -> Iterator[Cause]:
    """A prism or an image that isn't explained where the others are."""
    prisms = power.mean(1)
    worst, least = int(prisms.argmax()), float(prisms.min())
    total = max(float((prisms - noise).sum()), 1e-12)
    if len(prisms) > 1 and float(prisms[worst]) > PRISM * max(least, noise):
        yield Cause(
            f"prism {worst + 1}",
            min(1.0, float(prisms[worst] - noise) / total) / 2,
            f"its residual is {float(prisms[worst]) / max(least, 1e-12):.1f} times that of the best prism",
            f"check shear, bias and files of prism {worst + 1} (counted from 1), or fit it (learn = ['bias'])",
        )
    median = float(power.median())
    p, f = divmod(int(power.argmax()), power.shape[1])
    if power.numel() > 2 and float(power[p, f]) > IMAGE * max(median, noise):
        yield Cause(
            "one image",
            min(1.0, float(power[p, f] - noise) / max(float((power - noise).sum()), 1e-12)),
            f"prism {p + 1}, plane {f + 1} (counted from 1) leaves "
            f"{float(power[p, f]) / max(median, 1e-12):.1f} times the median image's",
            "look at that image (moved, blurred, in the wrong place?) and mask it or leave it out",
        )


# --- what short fits show ---------------------------------------------------------------------------------------------


def tried(
    problem: Problem, misfit: float, noise: float, assumed: Sequence[str] = (), sure: float = 0.0
) -> Iterator[Cause]:
    """The causes that explain the stack better in a short fit than what was declared does.

    misfit: of the finished volume. noise: what noise leaves of it. assumed: what nobody has said, by the names of a
    configuration's `assumed`. sure: part of the declared short fit's misfit by which another must be lower. A fit whose
    light can't be followed explains nothing. Without priors any fit comes closer, so that one must come closer than the
    finished one.
    """
    declared = short_fit(problem)
    for variant in variants(problem, assumed):
        found = short_fit(variant.problem)
        usual = misfit if variant.name == PRIORS else declared
        share = min(1.0, (usual - found) / max(usual - noise, 1e-12))
        if share < LEAST or usual - found < sure * usual:
            continue
        reason = f"a short fit so has a misfit of {found:.3g}, as declared {usual:.3g}"
        yield Cause(variant.name, share, f"{variant.what}: {reason}", variant.advice)
        if share > ENOUGH:
            return


def variants(problem: Problem, assumed: Sequence[str] = ()) -> Iterator[Variant]:
    """The problem with each likely mistake undone, the likeliest first; those that change nothing are left out.

    assumed: as in `tried`.
    """
    setup = problem.setup
    bounds = _index(problem).bounds
    lower = _of_the_other_sign(problem)
    if lower is not None:
        ways = (f"set {_written(_mirrored(bounds))}", f"reverse the sign of every shear and {REST['sign']}")
        advice = _either(*ways, prefer_rest=ORDER in assumed and SIGN not in assumed)
        yield Variant("Δn's sign", "Δn is on the other side of 0", advice, lower)
    seen = [images_of(setup.acquisition)]
    for other in one_mistake(setup.acquisition):
        made = images_of(other.acquisition)
        if made not in seen:
            seen.append(made)
            changed = replace(problem, setup=replace(setup, acquisition=other.acquisition))
            advice = other.advice
            if other.name in REST:
                prefer_rest = SIGN in assumed and DOUBTS.get(other.name) not in assumed
                advice = _either(advice, _rest(other.name, setup, bounds), prefer_rest=prefer_rest)
            yield Variant(other.name, other.what, advice, changed)
    for na, changed in _apertures(setup):
        advice = f"check the condenser's aperture diaphragm and immersion (na {na:.2g} explains more)"
        yield Variant("condenser", f"the condenser's na is nearer to {na:.2g}", advice, replace(problem, setup=changed))
    if problem.priors and problem.weight is None:  # a weight that follows the noise isn't too strong
        advice = "lower reconstruction.tv and l1, or leave tv = 'auto'"
        yield Variant(PRIORS, "the priors are too strong", advice, replace(problem, priors=(), weight=None))


def _rest(name: str, setup: Setup, bounds: Bounds) -> str:
    """What beside a reversal that explains a stack gives the same images: the rest of the three, in words."""
    rest = REST[name] if len(setup.acquisition.focus) > 1 else ""  # one plane has no order
    other = _mirrored(bounds)
    sign = "" if other == Bounds(bounds.lower, bounds.upper) else f"set {_written(other)}"
    return " and ".join(filter(None, (rest, sign))) or "take −Δn for Δn"


def _either(way: str, rest: str, *, prefer_rest: bool) -> str:
    """Two changes that give the same images, in words. prefer_rest: names the second one first."""
    first, second = (rest, way) if prefer_rest else (way, rest)
    return f"{first}; or, with the same images, {second} (images can't tell the sign of Δn)"


def _mirrored(bounds: Bounds) -> Bounds:
    """The bounds of −Δn."""
    return Bounds(*(None if bound is None else -bound + 0.0 for bound in (bounds.upper, bounds.lower)))


def _written(bounds: Bounds) -> str:
    """Bounds as a configuration has them."""
    lower, upper = ('"none"' if bound is None else f"{bound:g}" for bound in (bounds.lower, bounds.upper))
    return f"reconstruction.bounds = {{ lower = {lower}, upper = {upper} }}"


def _index(problem: Problem) -> IndexDifference:
    return next(unknown for unknown in problem.unknowns if isinstance(unknown, IndexDifference))


def _of_the_other_sign(problem: Problem) -> Problem | None:
    """The problem with Δn on the other side of 0; None where its bounds don't end there, or a support has its own."""
    index = _index(problem)
    bounds = index.bounds
    if isinstance(bounds, SupportedBounds) or {bounds.lower, bounds.upper} != {0, None}:
        return None
    mirrored = _mirrored(bounds)
    changed = [replace(index, bounds=mirrored) if unknown is index else unknown for unknown in problem.unknowns]
    return replace(problem, unknowns=changed)


def _apertures(setup: Setup) -> Iterator[tuple[float, Setup]]:
    """The setup with a wider and with a narrower condenser, within what the medium lets pass."""
    condenser = setup.microscope.condenser
    if condenser is None or number(condenser.na) <= 0 or condenser.points is not None or condenser.inner_na is not None:
        return
    for factor in (APERTURE, 1 / APERTURE):
        na = number(condenser.na) * factor
        if na < number(setup.volume.background):
            yield na, replace(setup, microscope=replace(setup.microscope, condenser=replace(condenser, na=na)))
