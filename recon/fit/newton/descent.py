"""A proximal Newton descent to the volume that explains the data, as a generator of steps.

    minimise misfit(Δn) + weight·Σ priors(Δn),   lower ≤ Δn ≤ upper

Each step replaces the misfit by a parabola with the weak specimen's Hessian and what earlier steps have shown of the
true one, and the priors by their majorants, and minimises that (J. D. Lee, Y. Sun and M. A. Saunders, SIAM J. Optim.
24, 1420, 2014). A step that doesn't lower the objective is taken back, and the next one is shorter: by the ratio of the
actual to the predicted decrease (J. Moré's rule for λ of Levenberg and Marquardt).
"""

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.newton.correction import Correction, drafts
from recon.fit.newton.missed import MissedResponse
from recon.fit.newton.place import WIDE, Formed, Judged, Place, restored, state_of
from recon.fit.newton.proximal import Penalties, Split, minimised
from recon.fit.newton.secants import MEMORY, Pair, Secants
from recon.fit.newton.weak_hessian import WeakHessian, check_linear_response
from recon.fit.nuisances.base import Nuisance
from recon.fit.nuisances.refinement import refined
from recon.fit.planned import PlanRecord, path_of
from recon.fit.problem import Problem
from recon.fit.setup import Setup
from recon.fit.step import Step, check_convergence
from recon.fit.unknowns import IndexDifference, with_values
from recon.misfit.level import neighbours
from recon.prior.base import Majorant, contrast, weighted
from recon.prior.edges import EDGE
from recon.prior.weight import BEGUN, record
from torchdic import Fidelity
from torchdic.errors import SidewaysError, TurnedRaysError, UnstableError
from torchdic.scalar import number as number_of

# The least λ over the Hessian's mean, and the factors by which the ratio of actual to predicted decrease moves it
# (ratios above GOOD, below POOR, and below BAD, where the step is taken back).
LEAST = 3e-3
# Above it no step is long enough to change anything, and the descent ends.
MOST = 1e6
GOOD, POOR, BAD = 0.7, 0.3, 0.05
SHORTER, LONGER, BACK = 2.0, 0.4, 4.0

# Accepted steps before the priors know the specimen's contrast, and before the weight follows the noise.
UNTIL_CONTRAST, UNTIL_WEIGHT = 3, 2

# Edges are narrower by this factor from one accepted step to the next: a logarithm at once keeps false edges.
NARROWER = 0.75

# Steps with the fewest directions.
COARSE_STEPS = 4

# ADMM's penalty on differences, over the weight: 1/(this share of the width of an edge).
PENALTY = 0.4

# Tikhonov's weight over the Hessian's mean, in the volume that gives the first contrast; and in a smoother one, whose
# noise few directions don't miss as if it were the specimen.
TIKHONOV, SMOOTH = 0.03, 0.1
# Phase along the light, in rad, up to which a specimen is so weak that few directions don't mislead.
WEAK = 1.0

# Where the renewed correction makes a step raise the objective by more than this share, the step is taken back too:
# draft images lead astray there.
CREEP = 2e-3

# Where a trial's light can't be followed, the trial is taken back.
NO_IMAGES = (UnstableError, SidewaysError, TurnedRaysError)

# Few directions mislead where their images err by more than this share of the images' variance, beyond what a weak
# specimen's would, and by more than this share of what noise leaves: the specimen is so strong that a correction, which
# holds at one volume, doesn't make their gradient that of all directions.
ASTRAY, ABOVE_NOISE = 0.004, 0.1

# A descent ends where two accepted steps in a row have changed objective and weight by less than these shares.
STILL, STEADY = 2e-5, 0.01


def minimise_by_newton(problem: Problem, resume: Step | None = None) -> Iterator[Step]:
    """Lower the misfit and the priors of a problem by Newton's method; yields every step, also those taken back.

    It ends after the problem's steps, or where nothing changes any more. The unknowns are Δn and any nuisances.
    resume: the step to go on from; the rest is as if there had been no interruption.
    Raises ValueError where Δn isn't among the unknowns, another unknown is no nuisance, no image shows a weak specimen
    to first order, or the step is of another descent; NotImplementedError for a prior without a majorant; and
    FloatingPointError where the first volume has no images.
    """
    yield from _Descent(problem).steps(resume)


def coarse_steps(problem: Problem) -> int:
    """The steps of a problem's descent with the fewest directions.

    There are none where a volume is given: it is already as the many directions see it.
    """
    given = any(isinstance(u, IndexDifference) and u.given is not None for u in problem.unknowns)
    return 0 if given else COARSE_STEPS


def expected_misled(problem: Problem) -> bool:
    """Whether few directions will probably mislead a problem's descent, by a linear estimate. Its fidelity is given.

    It costs about half a step, and two for a specimen that isn't weak. Raises as `minimise_by_newton` does.
    """
    return _Descent(problem).expected_misled()


class _Descent:
    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        found = [u for u in problem.unknowns if isinstance(u, IndexDifference)]
        if not found:
            raise ValueError("Newton's method finds Δn, which is none of the unknowns; use method 'adam'")
        self.index = found[0]
        self.nuisances = [u for u in problem.unknowns if isinstance(u, Nuisance)]
        others = [u.name for u in problem.unknowns if u is not self.index and u not in self.nuisances]
        if others:
            raise ValueError(f"Newton's method finds Δn and nuisances, not {', '.join(others)}; use method 'adam'")
        check_linear_response(problem.setup.microscope, problem.setup.acquisition)
        self.bounds = self.index.bounds
        self.coarse = coarse_steps(problem)
        grid = problem.setup.volume.grid
        self.ratio = grid.spacing[2] / grid.spacing[0]
        self.voxels = math.prod(grid.shape)
        self.plans: tuple[PlanRecord, ...] = ()
        self.missed: MissedResponse | None = None

    def steps(self, resume: Step | None) -> Iterator[Step]:
        started, problem = time.perf_counter(), self.problem
        place, first, seconds = None, 0, 0.0
        if resume is not None:
            names = [unknown.name for unknown in problem.unknowns]
            place = restored(resume.state, names, problem.misfit.data.device)
            first, seconds, self.plans = resume.number, resume.seconds, resume.plans
        hessian = now = None
        for number in range(first, problem.steps):
            if place is not None and self.ended(place, number):
                return
            draft, exact, turns = self.drafted(place, number)
            try:
                if place is None:
                    place, hessian, now = self.start(draft, exact)
                elif turns:
                    place, hessian, now = self.turned(place, draft, exact)
                elif hessian is None or now is None:
                    hessian = self.responses(place.responding, draft, exact)
                    now = self.judged(self.formed(place, draft))
                if place.misled:  # that may have been found just now
                    draft, exact, _ = self.drafted(place, number)
            except UnstableError as error:
                raise FloatingPointError(f"the descent diverged at step {number + 1}: {error}") from error
            place = self.weighted(place, now, number)
            misfit, loss = now.misfit, now.misfit + self.penalty(place, place.delta, number)
            check_convergence(number + 1, loss, self.values(place), self.lowest(place.delta))
            try:
                place, now = self.advanced(place, now, hessian, (draft, exact), number)
            except NO_IMAGES:  # of the drafts' directions, or of the careful ones
                place = self.taken_back(place)
            taken, values = seconds + time.perf_counter() - started, self.values(place)
            yield Step(number + 1, misfit, loss, place.delta, taken, values, state_of(place), self.plans, place.records)

    def drafted(self, place: Place | None, number: int) -> tuple[Fidelity, Fidelity | None, bool]:
        """The fidelity of a step's images, the careful one to which they are corrected, if any, and whether they turn.

        They turn where a step's images are computed otherwise than those of the step before.
        """
        fidelity = self.problem.fidelity

        def of(step: int) -> tuple[Fidelity, Fidelity | None]:
            coarse = step < self.coarse
            careful = fidelity.coarse if coarse else fidelity.last(self.plans)
            misled = place is not None and place.misled
            first, fine = drafts(careful, None if misled else fidelity.draft_sources)
            return (first, None) if coarse else (fine, careful if careful != fine else None)

        before = None if place is None else of(number - 1)
        # however few steps there are, the fidelity that judges the volume is there in the end
        if number >= min(self.coarse, self.problem.steps - 1):
            _, self.plans = fidelity.careful(number, self.placed(place), self.plans)
        draft, exact = of(number)
        return draft, exact, before is not None and before != (draft, exact)

    # --- what the model says of a place -------------------------------------------------------------------------------

    def values(self, place: Place) -> dict[str, Tensor]:
        """Δn and the values of the nuisances, by name."""
        return {self.index.name: place.delta, **{u.name: u.value(place.parameters[u.name]) for u in self.nuisances}}

    def placed(self, place: Place | None, delta: Tensor | None = None) -> Setup:
        """The setup with the values of a place, or another Δn in it; the problem's own before the first place."""
        if place is None:
            return self.problem.setup
        values = self.values(place)
        setup = with_values(self.nuisances, values, self.problem.setup)
        return self.index.put(place.delta if delta is None else delta, setup)

    def formed(self, place: Place, draft: Fidelity) -> Formed:
        """The images of a place's volume and their misfit. Raises UnstableError where the slabs make energy."""
        delta = place.delta.detach().requires_grad_()
        return self.seen(place, delta, self.placed(place, delta).formed(draft))

    def seen(self, place: Place, delta: Tensor, images: Float[Tensor, "prism focus y x"]) -> Formed:
        """Images that were formed of delta, as a place's nuisances and its correction make them."""
        corrected = place.correction.to(images, delta, self.missed)
        recorded = self.placed(place, delta).recorded(corrected)
        return Formed(delta, images, recorded, self.problem.misfit(recorded))

    def judged(self, formed: Formed) -> Judged:
        """The misfit and its gradient of a volume."""
        (gradient,) = torch.autograd.grad(formed.misfit, formed.delta)
        recorded, rule = formed.recorded.detach(), self.problem.weight
        heeded = formed.value if rule is None else rule.heeded(recorded, formed.value)
        return Judged(formed.value, heeded, gradient, recorded)

    def corrected(self, place: Place, formed: Formed, exact: Fidelity) -> Correction:
        """The correction of a place's images to those of the careful fidelity."""
        return place.correction.renewed(self.placed(place), formed.images, exact, self.missed, self.size)

    def renewed(
        self,
        place: Place,
        formed: Formed,
        draft: Fidelity,
        exact: Fidelity | None,
        correction: Correction | None = None,
    ) -> tuple[Judged, Place]:
        """The misfit and its gradient of a place whose correction and nuisances are renewed before.

        exact: the careful fidelity to which the images are corrected; None corrects nothing. correction: where it is
        known already.
        """
        known = place
        if exact is not None:
            place = replace(place, correction=correction or self.corrected(place, formed, exact))
        changed = False
        if self.nuisances and place.accepted > 0:
            place, changed = self.refined(place, formed.images.detach(), draft)
        if changed:
            formed = self.formed(place, draft)
        elif place is not known:
            formed = self.seen(place, formed.delta, formed.images)
        return self.judged(formed), place

    def refined(self, place: Place, formed: Tensor, draft: Fidelity) -> tuple[Place, bool]:
        """The place with its nuisances refined, and whether other images must be formed for them."""
        setup = self.index.put(place.delta, self.problem.setup)
        images = place.correction.to(formed, place.delta, self.missed)
        found = refined(self.nuisances, place.parameters, setup, self.problem.misfit, draft, images)
        changed = any(u.forms and not torch.equal(found[u.name], place.parameters[u.name]) for u in self.nuisances)
        return replace(place, parameters=found), changed

    def size(self, change: Float[Tensor, "prism focus row column"]) -> float:
        """The mean square of a change of images, relative to what noise leaves of it, or to a thousandth of all."""
        noise = self.problem.weight.noise_misfit if self.problem.weight is not None else None
        return self.share(change) / max(noise or 0.0, 1e-3)

    def share(self, change: Float[Tensor, "prism focus row column"]) -> float:
        """The mean square of a change of images over the variance of the data."""
        return float((change.square().mean((1, 2, 3)) / self.problem.misfit.variance.flatten()).mean())

    def lowest(self, delta: Float[Tensor, "z y x"]) -> float:
        """The least index of a volume."""
        return number_of(self.problem.setup.volume.background) + float(delta.min())

    def responses(self, parameters: dict[str, Tensor], draft: Fidelity, exact: Fidelity | None) -> WeakHessian:
        """The weak specimen's Hessian for few directions; sets what a draft misses of the careful images.

        parameters: of the nuisances, by name. exact: the careful fidelity; None corrects nothing.
        The misfit's curvature is that at images without noise, nearly: each pixel is the mean of its neighbours.
        """
        values = {u.name: u.value(parameters[u.name]) for u in self.nuisances}
        setup, misfit = with_values(self.nuisances, values, self.problem.setup), self.problem.misfit
        level, _ = neighbours(misfit.data, misfit.mask)
        curvature = misfit.curvature(level).expand(misfit.data.shape).mean((2, 3))
        memory = self.problem.fidelity.matrices or draft.memory // 2
        pixels, seen = math.prod(misfit.data.shape[2:]), math.prod(setup.field.shape[1:])
        weights = self.voxels * pixels / seen * curvature  # a camera's pixel stands for the voxels that it sees
        self.missed = None
        room = MissedResponse.bytes_for(setup, weights.element_size()) <= memory
        if exact is not None and draft.sources < exact.sources and room:
            self.missed = MissedResponse(setup, draft, exact)
        few = min(draft.sources, self.problem.fidelity.draft_sources or draft.sources)
        return WeakHessian(setup, weights, replace(draft, sources=few), memory)

    def priors(self, place: Place, number: int) -> list[tuple[float, Any]]:
        """The priors with their weights at a step, for the contrast that is known."""
        priors = [prior.at_contrast(place.scale * place.width if place.known else 0.0) for prior in self.problem.priors]
        factor = 1.0 if self.problem.weight is None else place.weight
        return weighted(priors, factor, number, self.problem.steps)

    def penalty(self, place: Place, delta: Tensor, number: int) -> float:
        """The weighted priors of a Δn."""
        volume = self.index.put(delta, self.problem.setup).volume
        return sum(weight * float(prior(volume)) for weight, prior in self.priors(place, number))

    def majorant(self, place: Place, number: int) -> Majorant:
        """The sum of the priors' majorants at a place."""
        volume = self.index.put(place.delta, self.problem.setup).volume
        return sum((weight * prior.majorant(volume) for weight, prior in self.priors(place, number)), Majorant())

    # --- steps --------------------------------------------------------------------------------------------------------

    def start(self, draft: Fidelity, exact: Fidelity | None) -> tuple[Place, WeakHessian, Judged]:
        """The first place: the given volume; else the empty one, whose contrast a first linear estimate suggests."""
        problem, given = self.problem, self.index.given
        nothing = problem.misfit.data.new_zeros(problem.setup.volume.grid.shape)
        delta = self.bounds.clamped(nothing if given is None else given.to(nothing))
        parameters = {u.name: u.start(problem.setup, problem.misfit).detach() for u in self.nuisances}
        place = Place(delta, parameters, parameters, Split.at(delta), Correction(), weight=1.0, scale=1.0)
        place, hessian, now = self.turned(place, draft, exact)
        if given is not None and (scale := problem.contrast or contrast(delta)) > 0:
            place = replace(place, scale=scale, weight=self.first_weight(scale), known=True, width=1.0)
            return place, hessian, now
        linear = self.linear(place, hessian, now, TIKHONOV)
        scale = contrast(self.bounds.clamped(linear))
        scale = max(scale, contrast(linear) * 1e-3, 1e-9)
        return replace(place, scale=scale, weight=self.first_weight(scale)), hessian, now

    def linear(self, place: Place, hessian: WeakHessian, now: Judged, weight: float) -> Float[Tensor, "z y x"]:
        """The volume that fits best if the specimen is weak. weight: Tikhonov's, over the Hessian's mean."""
        inverse = hessian.inverse(0.0, weight * hessian.mean)
        return place.delta + hessian.solved(inverse, -now.gradient * self.voxels)

    def expected_misled(self) -> bool:
        """See the function of this name."""
        setup, fidelity = self.problem.setup, self.problem.fidelity
        careful = fidelity.last(())
        first, fine = drafts(careful, fidelity.draft_sources)
        if self.index.given is not None or fine.sources >= careful.sources:
            return False
        place, hessian, now = self.start(first, None)
        delta = self.bounds.clamped(self.linear(place, hessian, now, SMOOTH)).detach()
        if 2 * math.pi * path_of(delta, setup.volume.grid, setup.microscope.wavelength) < WEAK:
            return False
        self.responses(place.responding, fine, careful)
        place = replace(place, delta=delta)
        try:
            with torch.no_grad():
                return self.leads_astray(self.corrected(place, self.formed(place, fine), careful))
        except NO_IMAGES:  # so strong is the estimate
            return True

    def first_weight(self, scale: float) -> float:
        """The priors' weight at first, for a specimen of a contrast."""
        first = None if self.problem.weight is None else self.problem.weight.first
        return first if first is not None else BEGUN * self.problem.setup.dilution / scale

    def turned(self, place: Place, draft: Fidelity, exact: Fidelity | None) -> tuple[Place, WeakHessian, Judged]:
        """A place whose images are computed otherwise from now on: what belongs to the earlier ones is forgotten."""
        place = replace(place, pairs=(), correction=Correction(), before=None, responding=place.parameters)
        hessian = self.responses(place.responding, draft, exact)
        formed, known = self.formed(place, draft), None
        if exact is not None:
            known = self.corrected(place, formed, exact)
            if draft.sources < exact.sources and self.leads_astray(known):
                careful = known.to(formed.images.detach(), place.delta, self.missed)
                # the misfit is that of wrong images: until it falls no more, it says nothing of the priors
                place, self.missed = replace(place, misled=True, before=math.inf), None
                _, draft = drafts(exact, None)
                formed = self.formed(place, draft)
                exact, known = (None, None) if exact == draft else (exact, Correction(careful - formed.images.detach()))
        now, place = self.renewed(place, formed, draft, exact, known)
        return place, hessian, now

    def leads_astray(self, correction: Correction) -> bool:
        """Whether a first correction says that few directions mislead."""
        added = correction.added
        assert added is not None
        return self.share(added) > ASTRAY and self.size(added) > ABOVE_NOISE

    def weighted(self, place: Place, now: Judged, number: int) -> Place:
        """The place with the priors' contrast and weight for the next step."""
        if place.moved and place.accepted >= UNTIL_CONTRAST:
            width = max(1.0, NARROWER * place.width) if place.known else WIDE
            found = self.problem.contrast or contrast(place.delta)
            if found > 0 and (not place.known or place.width > 1.0):
                place = replace(place, known=True, width=width, scale=found)
        rule = self.problem.weight
        if rule is None or place.accepted < UNTIL_WEIGHT or not place.moved:
            return place
        white = rule.white(now.images, self.problem.misfit)
        past = place.records or (record(0, place.weight, "by the contrast"),)
        weight, reason = rule.next(
            past, now.heeded, place.before, white, EDGE * place.scale / self.problem.setup.dilution
        )
        made = record(number + 1, weight, reason, now.heeded, white)
        return replace(place, weight=weight, records=(*place.records, made))

    def advanced(
        self, place: Place, now: Judged, hessian: WeakHessian, drafted: tuple[Fidelity, Fidelity | None], number: int
    ) -> tuple[Place, Judged]:
        """One step: the model's minimum, and whether it is taken.

        drafted: the fidelity of the images, and the careful one to which they are corrected, if they are.
        """
        damping, majorant = place.damping * hessian.mean, self.majorant(place, number)
        secants = Secants(hessian, place.pairs)
        total = sum(weight for weight, _ in self.priors(place, number)) or 1.0
        tie = Penalties(total / (PENALTY * place.edge), hessian.mean)
        inverse = hessian.inverse(tie.edges + majorant.rough, tie.copy + damping)
        solve = secants.solved(lambda right: hessian.solved(inverse, right))
        curved = hessian(place.delta) + secants(place.delta)
        right = curved + damping * place.delta - self.voxels * now.gradient
        trial, split = minimised(solve, right, majorant, self.bounds, place.split, tie, self.ratio)

        if not 0 < self.lowest(trial) < math.inf:  # a volume has no other index
            return self.taken_back(place), now

        step = trial - place.delta
        held = self.penalty(place, place.delta, number)
        penalties = self.penalty(place, trial, number) - held
        bent = float((step * (hessian(step) + secants(step))).sum()) / self.voxels
        predicted = float((now.gradient * step).sum()) + bent / 2 + penalties
        onward = replace(place, delta=trial, split=split)
        formed = self.tried(onward, drafted[0])
        if formed is None:
            return self.taken_back(place), now
        actual = formed.value - now.misfit + penalties
        share = actual / predicted if predicted < 0 else (0.5 if actual < 0 else -1.0)
        objective = now.misfit + held
        still = place.still + 1 if -actual < STILL * objective and self.steady(place, number) else 0
        if share < BAD and -predicted < STILL * objective:
            # the place is the minimum with these weights: it counts as reached, so that the weights go on
            onward = replace(place, split=split, moved=True, accepted=place.accepted + 1, before=now.heeded)
            return replace(onward, still=still), now
        if share < BAD:
            there = self.judged(formed)
            return self.taken_back(replace(place, pairs=self.remembered(place, now, there, step))), now
        onward = replace(onward, accepted=place.accepted + 1, before=now.heeded, moved=True, still=still)
        there, onward = self.renewed(onward, formed, *drafted)
        pairs, rise = self.remembered(place, now, there, step), there.misfit - now.misfit + penalties
        if rise > CREEP * objective:
            return self.taken_back(place), now
        factor = LONGER if share > GOOD else SHORTER if share < POOR else 1.0
        return replace(onward, damping=max(factor * place.damping, LEAST), pairs=pairs), there

    def remembered(self, place: Place, now: Judged, there: Judged, step: Tensor) -> tuple[Pair, ...]:
        """The pairs with that of a step added."""
        return (*place.pairs, (step, self.voxels * (there.gradient - now.gradient)))[-MEMORY:]

    def tried(self, place: Place, draft: Fidelity) -> Formed | None:
        """The images of a trial, with the nuisances and the correction as they are; None where they aren't finite."""
        formed = self.formed(place, draft)
        return formed if math.isfinite(formed.value) else None

    def taken_back(self, place: Place) -> Place:
        """The place before a step that failed, with more damping."""
        return replace(place, damping=BACK * place.damping, split=Split.at(place.delta), moved=False, still=0)

    def ended(self, place: Place, number: int) -> bool:
        """Whether further steps would change nothing; the first careful one is always taken."""
        return number > self.coarse and (place.still >= 2 or place.damping > MOST)

    def steady(self, place: Place, number: int) -> bool:
        """Whether the priors' weights have all but stopped moving."""
        if self.problem.weight is None or self.problem.weight.held:
            now, last = (self.priors(place, step) for step in (number, self.problem.steps - 1))
            return [weight for weight, _ in now] == [weight for weight, _ in last]
        if len(place.records) < 2:
            return False
        last, previous = place.records[-1]["tv"], place.records[-2]["tv"]
        return abs(math.log(last / previous)) < STEADY
