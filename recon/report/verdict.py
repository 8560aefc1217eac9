"""Whether a volume explains its stack: the misfit over what noise leaves, what the residual looks like, and what to do.

Noise alone leaves a known part of the misfit. A volume that leaves as much explains the stack, which doesn't say that
it is right everywhere: what the apertures don't see, the priors fill in. One that leaves far more is wrong somewhere,
and `recon.report.causes` looks for where.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.calibration.trials.short_fits import can_be_tried
from recon.evidence.ends import MORE_SLICES, ends, open_ends
from recon.fit.bounds import Bounds
from recon.fit.problem import DIRECT, Problem
from recon.fit.step import Row
from recon.fit.unknowns import IndexDifference
from recon.prior.weight import FALLING, whiteness
from recon.report.causes import DOUBTS, ORDER, PRIORS, SIGN, Cause, ranked, seen_in_residual, tried
from recon.report.metrics import COARSE, coarse_residual

# Misfit over noise's above which a volume doesn't explain its stack, if LEAST of the specimen's contrast is unexplained
# as well: without noise, voxels and directions leave some 0.05 %. Right fits of the benchmarks end at 0.99 to 1.05.
LIMIT, LEAST = 1.1, 0.02

# Where the median of Δn is more than this part of the largest |Δn|, most of the volume isn't the medium. The priors
# leave it at 0 in a medium with specimens.
FILLED = 0.25

# Below it the volume has followed the noise.
FOLLOWS = 0.9

# Above it a misfit is more than an empty medium's, which is 1: brightness that was found in a part of the images
# is off by the noise.
EMPTY = 1.001

# A residual whose high frequencies are by more than this part weaker or stronger than all has structure.
WHITE = 0.1

# A volume of a wrong geometry may follow so much of the noise that its misfit is the noise's. Structure is left then:
# where the residual's means over a few pixels have more than STRUCTURE times the power that noise leaves of them, and
# LEAST of the contrast more, other descriptions are tried. One whose short fit leaves SURE less is told.
# Right fits of small noisy scenes have 0.99 to 1.1, wrong ones 1.5 to 2.4; short fits of the right ones leave a seventh
# to a third less.
STRUCTURE, SURE = 1.3, 0.08

# A descent of fewer steps hasn't come far enough for its misfit to tell anything but that.
FEW_STEPS = 8
# The cause of such a poor fit.
FEW = "few steps"


class PoorFitWarning(UserWarning):
    """The volume that was found doesn't explain the data within their noise."""


@dataclass(frozen=True)
class Verdict:
    """What a finished fit's misfit and residual say.

    misfit, noise: of the volume, and what noise leaves; None where that isn't known. white: see
    `recon.prior.weight.whiteness`; 1 is white. causes: what may be wrong, the likeliest first; empty where the volume
    explains the stack. free: whether the bounds leave the sign of Δn free. expected: whether the method's images are
    expected to come down to the noise. assumed: what nobody has said, by the names of a configuration's `assumed`.
    filled: the median of Δn where most of the volume isn't the medium; else None. ends: of the volume, see
    `recon.evidence.ends`.
    """

    misfit: float
    noise: float | None
    white: float
    causes: tuple[Cause, ...] = ()
    free: bool = False
    expected: bool = True
    assumed: tuple[str, ...] = ()
    filled: float | None = None
    ends: tuple[float, float] = (0.0, 0.0)

    @property
    def ratio(self) -> float | None:
        """The misfit over the noise's; None where that isn't known or 0."""
        return self.misfit / self.noise if self.noise else None

    @property
    def explained(self) -> float:
        """The share of the specimen's contrast, without the noise, that the volume explains."""
        return 1 - _unexplained(self.misfit, self.noise)

    @property
    def poor(self) -> bool:
        """Whether the volume leaves more than noise and the model do, or than an empty medium, or follows the noise.

        The last is so where another description of the stack explains it far better.
        """
        return leaves_too_much(self.misfit, self.noise) or bool(self.causes)

    @property
    def alarming(self) -> bool:
        """Whether to warn of it: not where a method or too few steps couldn't come closer, unless nothing is explained.

        A descent that was asked for few steps, or still falls, says itself that it isn't at its end.
        """
        unfinished = bool(self.causes) and self.causes[0].name == FEW
        return self.poor and (self.misfit > EMPTY or (self.expected and not unfinished))

    def with_volume(self, delta: Float[Tensor, "z y x"]) -> "Verdict":
        """The verdict with what the volume itself says: whether most of it isn't the medium, and where it ends."""
        median = float(delta.median())
        filled = median if abs(median) > FILLED * float(delta.abs().max()) else None
        return replace(self, filled=filled, ends=ends(delta))

    @property
    def words(self) -> str:
        """The verdict in one line."""
        return f"{self.measured}: {self._judgement()}"

    @property
    def measured(self) -> str:
        """The misfit beside the noise's, in words."""
        if self.noise is None:
            return f"misfit {self.misfit:.3g} (1 is an empty volume's; how much noise leaves isn't known)"
        if self.noise < LEAST / 100:
            return f"misfit {self.misfit:.3g} (1 is an empty volume's; there is next to no noise)"
        return f"misfit {self.misfit:.3g} is {self.misfit / self.noise:.3f} × what noise leaves ({self.noise:.3g})"

    def _judgement(self) -> str:
        residual = "white" if abs(self.white - 1) < WHITE else f"structured (whiteness {self.white:.2g})"
        if self.misfit > EMPTY:
            empty = "empty medium would explain the stack better; the optics may not be those of the stack"
            return f"{empty}; {self._likeliest()}" if self.causes else empty
        if self.poor and not self.expected:
            return "a method without a descent leaves that much even where all is right; 'newton' explains more"
        if self.poor and not leaves_too_much(self.misfit, self.noise):
            return f"the volume follows the noise, and another explains the stack better; {self._likeliest()}"
        if self.poor:
            return f"{1 - self.explained:.0%} of the contrast is unexplained, residual {residual}; {self._likeliest()}"
        free = self._gauge() + (self._offset() or self._depth())
        if self.ratio is not None and self.noise and self.noise >= LEAST and self.ratio < FOLLOWS:
            return f"the volume follows the noise; raise reconstruction.tv, or leave it 'auto'{free}"
        if self.noise is None:
            return f"it explains {self.explained:.1%} of the contrast, residual {residual}{free}"
        return f"the volume explains the stack{free}"

    def _gauge(self) -> str:
        """What explains the stack as well, where nobody has said that it isn't so."""
        if self.free:
            return "; Δn's sign is free: reversed shears and planes give the same images with −Δn"
        doubted = [name for name in (SIGN, ORDER) if name in self.assumed]
        if not doubted:
            return ""
        are = "are" if len(doubted) > 1 else "is"
        return f"; so does −Δn with reversed shears and planes: {' and '.join(doubted)} {are} assumed"

    def _offset(self) -> str:
        """What a constant Δn may hide, where there is one."""
        if self.filled is None:
            return ""
        return (
            f"; more than half of the volume has a Δn of about {self.filled:.2g}: images don't tell a constant one, so "
            "if that is the medium, Δn has the other sign (reconstruction.bounds)"
        )

    def _depth(self) -> str:
        """That the specimen goes on beyond the volume's first or last slice, where it does."""
        beyond = open_ends(*self.ends)
        if beyond is None:
            return ""
        return f"; it doesn't end within its depth ({beyond}), and how far it goes on isn't told: {MORE_SLICES}"

    def _likeliest(self) -> str:
        if not self.causes:
            checked = ", ".join(self.assumed)
            return (
                f"no single cause was found: check {f'what is assumed ({checked}), then ' if checked else ''}"
                "pixel size, focus step, wavelength, apertures, shear, bias, and try learn = ['bias', 'drift', 'lamp']"
            )
        first, *others = self.causes
        named = f"; or {', '.join(dict.fromkeys(cause.name for cause in others[:2]))}" if others else ""
        assumed = "; it is assumed" if DOUBTS.get(first.name) in self.assumed else ""
        return f"most likely: {first.name} ({first.reason}{assumed}): {first.advice}{named}"

    def as_json(self) -> dict[str, Any]:
        """The verdict as metrics.json holds it."""
        return {
            "ratio": self.ratio,
            "white": self.white,
            "explained": self.explained,
            "ends": list(self.ends),
            "poor": self.poor,
            "causes": [asdict(cause) for cause in self.causes],
            "words": self.words,
        }


def leaves_too_much(misfit: float, noise: float | None) -> bool:
    """Whether a misfit is above what noise leaves and a right model may add. noise: None where it isn't known."""
    if misfit > EMPTY or not math.isfinite(misfit):
        return True
    return noise is not None and misfit > LIMIT * noise and _unexplained(misfit, noise) > LEAST


def _unexplained(misfit: float, noise: float | None) -> float:
    """The part of the specimen's contrast that a volume leaves. noise: None counts as none."""
    alone = min(noise or 0.0, 1 - 1e-6)
    return max(0.0, (misfit - alone) / (1 - alone))


@torch.no_grad()
def judged(
    problem: Problem,
    images: Float[Tensor, "prism focus y x"],
    noise: Sequence[float] | None,
    method: str,
    rows: Sequence[Row],
    assumed: Sequence[str] = (),
    part: Problem | None = None,
) -> Verdict:
    """The verdict on a finished fit; where it is poor, causes are looked for, which takes as long as some steps.

    images: the model's, of the last step. noise: standard deviation of each prism's, None where it isn't known.
    method: that found the volume. rows: of the log. assumed: what nobody has said, by the names of a configuration's
    `assumed`. part: of the problem, in which the causes are looked for where all of it is too large; None is all.
    """
    misfit = float(problem.misfit(images))
    alone = problem.misfit.of_noise(noise) if noise is not None or problem.misfit.knows_all else None
    index = next((unknown for unknown in problem.unknowns if isinstance(unknown, IndexDifference)), None)
    free = index is not None and _free(index.bounds)
    white = whiteness(images, problem.misfit)
    found = Verdict(misfit, alone, white, (), free, method not in DIRECT, tuple(assumed))
    part = part or problem
    if not found.expected:
        return found
    if found.poor:
        return replace(found, causes=_causes(problem, part, images, found, rows))
    structured = noise is not None and _structured(problem, images, noise)
    if structured and (len(rows) >= FEW_STEPS or not rows) and can_be_tried(part):
        print("the residual has structure: short fits of what may have been declared wrongly …")
        # a volume without priors follows the noise more closely in any case
        causes = [cause for cause in _tried(part, found, SURE) if cause.name != PRIORS]
        return replace(found, causes=ranked(causes, found.assumed))
    return found


def _structured(problem: Problem, images: Tensor, noise: Sequence[float]) -> bool:
    """Whether the residual's means over a few pixels hold far more than noise leaves, and enough of the contrast.

    noise: standard deviation of each prism's.
    """
    misfit = problem.misfit
    power = coarse_residual(misfit.where_counted(images - misfit.data), noise)
    share = float((images.new_tensor(list(noise)).square() / misfit.variance.flatten()).mean())
    return power > STRUCTURE and (power - 1) / COARSE**2 * share > LEAST * max(1 - share, 0.0)


def _causes(problem: Problem, part: Problem, images: Tensor, found: Verdict, rows: Sequence[Row]) -> tuple[Cause, ...]:
    """What may be wrong with a poor fit, the likeliest first. part: as in `judged`. found: the verdict without them."""
    noise = found.noise or 0.0
    causes = list(_unfinished(rows))
    if len(rows) >= FEW_STEPS or not rows:
        causes += seen_in_residual(images, problem.misfit, noise, problem.setup.margin)
        if can_be_tried(part):
            print("the misfit is far above the noise's: short fits of what may have been declared wrongly …")
            causes += _tried(part, found)
    return ranked(causes, found.assumed)


def _tried(problem: Problem, found: Verdict, sure: float = 0.0) -> list[Cause]:
    """The causes that short fits find; those so far where Ctrl-C ends the search. sure: as in `tried`."""
    causes: list[Cause] = []
    try:
        with torch.enable_grad():
            for cause in tried(problem, found.misfit, found.noise or 0.0, found.assumed, sure):
                causes.append(cause)
    except KeyboardInterrupt:  # the volume is found and is still to be written
        print("the search for causes was interrupted")
    return causes


def _unfinished(rows: Sequence[Row]) -> list[Cause]:
    """A descent that hadn't come to its end."""
    if 0 < len(rows) < FEW_STEPS:
        return [Cause(FEW, 1.0, f"{len(rows)} steps are few", "let it take more: reconstruction.steps")]
    if len(rows) > 1:
        before, last = rows[-2][1], rows[-1][1]
        if last < (1 - FALLING) * before:
            reason = f"the last step lowered the misfit by {1 - last / before:.0%}"
            return [Cause(FEW, 0.3, reason, "let it take more: reconstruction.steps")]
    return []


def _free(bounds: Bounds) -> bool:
    """Whether Δn may be of either sign."""
    return (bounds.lower is None or bounds.lower < 0) and (bounds.upper is None or bounds.upper > 0)
