"""How carefully the images of each step are computed: with a given fidelity, or with one planned for a tolerance."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from torch import Tensor

from recon.fit.setup import Setup
from torchdic import Fidelity, Grid, Plan, plan
from torchdic.planning.plan import describe

# A volume that has grown by this factor since the last plan is planned for again.
GROWTH = 2.0

# Least |Δn|, and least OPD in wavelengths, whose growth counts: a weaker volume is all but empty.
LEAST_DELTA, LEAST_PATH = 1e-3, 0.02

# Share of the steps that are computed with the draft's condenser directions.
DRAFT = 0.6

# A plan as plain values, for checkpoints and metrics: number of the step before which it was made, the volume's
# strength, the plan's error and whether it meets the tolerance, and its fidelity.
PlanRecord = dict[str, Any]


@dataclass(frozen=True)
class GivenFidelity:
    """One fidelity for all steps, at first with fewer condenser directions.

    fidelity: of the images. draft_sources: condenser directions of the first 60 % of Adam's steps, and of Newton's,
    where the fidelity asks for more; None is the fidelity's from the first step on. matrices: bytes that those of a
    weak specimen's Hessian may take; None is half of the fidelity's memory.
    """

    fidelity: Fidelity
    draft_sources: int | None = None
    matrices: int | None = None

    def at(
        self, step: int, steps: int, setup: Setup, plans: tuple[PlanRecord, ...]
    ) -> tuple[Fidelity, tuple[PlanRecord, ...]]:
        """The fidelity of a step of Adam's, counted from 0, and the plans so far, which stay as they are."""
        draft = self.draft_sources is not None and self.draft_sources < self.fidelity.sources
        if draft and step < DRAFT * steps:
            return replace(self.fidelity, sources=self.draft_sources), plans
        return self.careful(step, setup, plans)

    @property
    def coarse(self) -> Fidelity:
        """The fidelity that Newton's first, coarse steps are drafts of."""
        return self.fidelity

    def careful(
        self, step: int, setup: Setup, plans: tuple[PlanRecord, ...]
    ) -> tuple[Fidelity, tuple[PlanRecord, ...]]:
        """The fidelity without drafts at a step, counted from 0, and the plans so far, which stay as they are."""
        return self.fidelity, plans

    def last(self, plans: tuple[PlanRecord, ...]) -> Fidelity:
        """The fidelity that the finished volume is judged by."""
        return self.fidelity


@dataclass(frozen=True)
class PlannedFidelity:
    """A fidelity that is planned for a tolerance, and again each time the volume's strength has doubled.

    tolerance: rms error of the images over their standard deviation, see `torchdic.plan`. draft_sources: condenser
    directions of Newton's steps, where the plan asks for more; Adam's have all. matrices: as in `GivenFidelity`.
    """

    tolerance: float
    draft_sources: int | None = None
    matrices: int | None = None

    def at(
        self, step: int, steps: int, setup: Setup, plans: tuple[PlanRecord, ...]
    ) -> tuple[Fidelity, tuple[PlanRecord, ...]]:
        """The fidelity of a step of Adam's, counted from 0, and the plans so far with the one made for it."""
        return self.careful(step, setup, plans)

    @property
    def coarse(self) -> Fidelity:
        """The fidelity that Newton's first, coarse steps are drafts of: the wave, whatever is planned after them.

        A plan for a volume that is all but empty costs as much as several steps, and is soon made again.
        """
        return Fidelity()

    def careful(
        self, step: int, setup: Setup, plans: tuple[PlanRecord, ...]
    ) -> tuple[Fidelity, tuple[PlanRecord, ...]]:
        """The fidelity without drafts at a step, counted from 0, and the plans so far with the one made for it."""
        plans = follow(plans, step, setup, self.tolerance)
        return current(plans), plans

    def last(self, plans: tuple[PlanRecord, ...]) -> Fidelity:
        """The fidelity that the finished volume is judged by."""
        return current(plans)


def strength(delta: Tensor, grid: Grid, wavelength: float) -> float:
    """How strong a volume is: the larger of |Δn| and OPD, each over the least that counts, and at least 1.

    delta: Δn (z, y, x). wavelength: µm.
    """
    return max(float(delta.detach().abs().max()) / LEAST_DELTA, path_of(delta, grid, wavelength) / LEAST_PATH, 1.0)


def path_of(delta: Tensor, grid: Grid, wavelength: float) -> float:
    """The largest |OPD| of a volume along z, in wavelengths. delta: Δn (z, y, x). wavelength: µm."""
    return float(delta.detach().sum(0).abs().max()) * grid.spacing[0] / wavelength


def follow(plans: tuple[PlanRecord, ...], step: int, setup: Setup, tolerance: float) -> tuple[PlanRecord, ...]:
    """The plans so far, and one more where the volume has grown by GROWTH since the last of them.

    step: counted from 0. setup: with the current volume. tolerance: of the images.
    """
    volume, microscope = setup.volume, setup.microscope
    now = strength(volume.delta, volume.grid, microscope.wavelength)
    if plans and now < GROWTH * plans[-1]["strength"]:
        return plans
    made = plan(volume, microscope, setup.acquisition, tolerance, with_effects=False)
    record = {
        "step": step + 1,
        "strength": now,
        "error": made.error,
        "met": made.met,
        "fidelity": asdict(made.fidelity),
    }
    return (*plans, record)


def current(plans: tuple[PlanRecord, ...]) -> Fidelity:
    """The fidelity of the last plan."""
    return Fidelity(**plans[-1]["fidelity"])


def announce(planned: Plan) -> str:
    """A plan in one line."""
    return f"planned for {planned.tolerance:g}: {describe(planned.fidelity)}; predicted error {planned.error:.2g}"


def announce_record(record: PlanRecord) -> str:
    """A plan that a descent has made, in one line."""
    fidelity = describe(Fidelity(**record["fidelity"]))
    return f"planned at step {record['step']}: {fidelity}; predicted error {record['error']:.2g}"
