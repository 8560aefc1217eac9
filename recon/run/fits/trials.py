"""Fits of one stack by many candidates: how near each comes, and what it costs."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.config.schema import Config
from recon.earlier.direct import solved_directly
from recon.fit.descent import minimise
from recon.fit.nuisances.refinement import best_brightness
from recon.fit.planned import GivenFidelity
from recon.fit.problem import DIRECT, Problem
from recon.fit.step import Step
from recon.fit.unknowns import with_values
from recon.misfit.base import Misfit
from recon.recording.preparation import Measured
from recon.report.fit_trial import FitCandidate, FitTrial
from recon.report.metrics import volume_error
from recon.run.data import check_feasible
from recon.run.fits.ladder import configured, planes_of
from recon.run.misfits import misfit_for
from recon.run.reconstruct import RECOMMENDED, margin_of, problem_of, spelled_out
from recon.run.results import model_images
from recon.run.room import STEPS
from torchdic import ShortOfMemoryError
from torchdic.memory.held import course_of, most
from torchdic.planning.comparisons import CANNOT_CROSS

# What a candidate may fail by without an end to the others.
FAILURES = (*CANNOT_CROSS, FloatingPointError, ShortOfMemoryError, ValueError)

# What is learned of each plane by itself: it isn't known of planes that aren't fitted.
OF_PLANES = {"drift", "focus"}


@dataclass(frozen=True, eq=False)
class Recorded:
    """A stack that is to be fitted.

    config: of the stack. measured: its images, relative to the empty bright field. truth: Δn (z, y, x) on the
    configuration's grid; None where it isn't known. device: where to compute. noisy: whether there is noise; what is
    measured in clean images is their rounding.
    """

    config: Config
    measured: Measured
    truth: Float[Tensor, "z y x"] | None
    device: torch.device
    noisy: bool = True

    def planes(self, indices: Sequence[int]) -> Measured:
        """The stack of some of its planes."""
        focus = tuple(self.measured.focus[i] for i in indices)
        return replace(self.measured, data=self.measured.data[:, list(indices)], focus=focus)


def fit_trials(
    recorded: Recorded, candidates: Sequence[FitCandidate], seen: Callable[[FitCandidate, Step], None] | None = None
) -> Iterator[FitTrial]:
    """A trial of each candidate, one by one as they are done.

    seen: is called after each step of a descent. A candidate that can't fit this stack has its reason in `failure`.
    """
    section = recorded.config.reconstruction
    margin = margin_of(replace(recorded.config, reconstruction=replace(section, method="newton")), recorded.measured)
    for candidate in candidates:
        try:
            yield _Fit(recorded, candidate, margin).trial(seen)
        except FAILURES as error:
            yield FitTrial(candidate, failure=str(error))


class _Fit:
    """One candidate's fit. margin: voxels beyond the field that a descent has."""

    def __init__(self, recorded: Recorded, candidate: FitCandidate, margin: int) -> None:
        self.recorded, self.candidate = recorded, candidate
        config = configured(recorded.config, candidate)
        if candidate.method not in DIRECT:
            config = replace(config, reconstruction=replace(config.reconstruction, margin=margin))
        self.config = spelled_out(config)
        self.measured = recorded.planes(planes_of(candidate.planes, len(recorded.measured.focus)))
        check_feasible(self.config)

    def trial(self, seen: Callable[[FitCandidate, Step], None] | None) -> FitTrial:
        """Fit, judge, and fit the first steps once more to count bytes."""
        problem = self.problem()
        began = time.perf_counter()
        step = self.last(problem, seen)
        seconds = time.perf_counter() - began
        delta, truth = problem.setup.within_field(step.delta).cpu(), self.recorded.truth
        own = float(problem.misfit(model_images(problem, step)))
        whole, whole_noise = self.judged(problem, step)
        return FitTrial(
            self.candidate,
            None if truth is None else volume_error(delta, truth),
            None if truth is None else float(delta.sum() / truth.sum()),
            own,
            problem.misfit.of_noise(self.measured.noise) if self.recorded.noisy else 0.0,
            whole,
            whole_noise,
            step.number,
            _finite(step.weights[-1]["tv"]) if step.weights else None,
            seconds,
            self.peak_bytes(),
        )

    def problem(self) -> Problem:
        """What the candidate is to fit."""
        data = torch.from_numpy(self.measured.data).to(self.recorded.device)
        return problem_of(self.config, data, misfit_for(self.config, self.measured), self.measured)

    def last(self, problem: Problem, seen: Callable[[FitCandidate, Step], None] | None) -> Step:
        """The last step of the fit."""
        if self.candidate.method in DIRECT:
            return solved_directly(self.config.reconstruction, problem, self.measured.noise)[0]
        step = None
        for step in minimise(problem):
            if seen is not None:
                seen(self.candidate, step)
        assert step is not None
        return step

    @torch.no_grad()
    def judged(self, problem: Problem, step: Step) -> tuple[float | None, float | None]:
        """The misfit of all planes by the most careful wave, and what noise leaves of it; None where it isn't known."""
        everything = self.recorded.measured
        if self.candidate.planes < len(everything.focus) and OF_PLANES & set(self.config.reconstruction.learn):
            return None, None
        misfit = self.whole_misfit()
        values = {name: value.to(misfit.data.device) for name, value in step.values.items()}
        unknowns = [unknown for unknown in problem.unknowns if unknown.name != "brightness"]
        setup = replace(problem.setup, acquisition=self.recorded.config.acquisition, brightness=None)
        try:
            images = with_values(unknowns, values, setup).images(RECOMMENDED)
        except CANNOT_CROSS:
            return None, None
        lit = images * best_brightness(images, misfit)[..., None, None]
        return float(misfit(lit)), misfit.of_noise(everything.noise) if self.recorded.noisy else 0.0

    def whole_misfit(self) -> Misfit:
        """The configuration's misfit of the whole stack."""
        whole = self.recorded.measured
        config = replace(self.config, acquisition=self.recorded.config.acquisition)
        return misfit_for(config, whole)(torch.from_numpy(whole.data).to(self.recorded.device))

    def peak_bytes(self) -> int:
        """The most bytes in use at once during the first steps, which do all that later ones do."""
        problem = self.problem()
        if problem.method == "adam" and isinstance(problem.fidelity, GivenFidelity):
            # its first steps have fewer directions than its last ones
            problem = replace(problem, fidelity=replace(problem.fidelity, draft_sources=None))
        problem = replace(problem, steps=min(problem.steps, STEPS[problem.method]))
        return most(course_of(lambda: self.last(problem, None)))


def _finite(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value
