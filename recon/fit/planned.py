"""A fidelity that follows a growing volume: planned for a tolerance, and again each time the volume has doubled."""

from dataclasses import asdict
from typing import Any

from torch import Tensor

from torchdic import Acquisition, Fidelity, Grid, Microscope, Plan, Volume, plan
from torchdic.planning.plan import describe

# Growth since the last plan that asks for another.
GROWTH = 2.0

# Least |Δn|, and OPD in wavelengths, whose growth counts: a weaker volume is all but empty.
LEAST_DELTA, LEAST_PATH = 1e-3, 0.02

# A plan as plain values, for checkpoints and metrics: number of the step before which it was made, the volume's
# strength, the plan's error and whether it meets the tolerance, and its fidelity.
PlanRecord = dict[str, Any]


def strength(delta: Tensor, grid: Grid, wavelength: float) -> float:
    """How strong a volume is: the larger of |Δn| and OPD, each relative to what is all but empty, and at least 1."""
    delta = delta.detach()
    path = float(delta.sum(0).abs().max()) * grid.spacing[0] / wavelength
    return max(float(delta.abs().max()) / LEAST_DELTA, path / LEAST_PATH, 1.0)


def follow(
    plans: tuple[PlanRecord, ...],
    number: int,
    delta: Tensor,
    grid: Grid,
    background: float,
    microscope: Microscope,
    acquisition: Acquisition,
    tolerance: float,
) -> tuple[PlanRecord, ...]:
    """The plans so far, and one more where the volume has grown GROWTH-fold since the last of them."""
    now = strength(delta, grid, microscope.wavelength)
    if plans and now < GROWTH * plans[-1]["strength"]:
        return plans
    made = plan(Volume(grid, delta.detach(), background), microscope, acquisition, tolerance)
    record = {
        "step": number + 1,
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
    """A plan in a line."""
    return f"planned for {planned.tolerance:g}: {describe(planned.fidelity)}; predicted error {planned.error:.2g}"


def announce_record(record: PlanRecord) -> str:
    """A plan of a reconstruction in a line."""
    fidelity = describe(Fidelity(**record["fidelity"]))
    return f"planned at step {record['step']}: {fidelity}; predicted error {record['error']:.2g}"
