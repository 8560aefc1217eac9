"""The error bars of a finished reconstruction, from its folder back into it."""

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool
from torch import Tensor

from recon.coverage.seen import Coverage
from recon.earlier.direct import solved_directly
from recon.evidence.bars import ErrorBars, bars_of
from recon.evidence.ends import ends
from recon.evidence.estimate import Estimate
from recon.evidence.refits import COPIES, NOISY, Kind, Refit, copy, planned_refits, refits
from recon.evidence.regions import INCREMENT, as_json
from recon.fit.descent import solved
from recon.fit.problem import DIRECT, Problem
from recon.fit.step import Step
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.noise import NoiseModel, noise_of_level
from recon.report import figures
from recon.run.evidence.figure import draw_error_bars
from recon.run.evidence.kept_refits import ERROR_BARS, FOLDER, KeptRefits
from recon.run.evidence.seen import coverage_of
from recon.run.folder.prepared import prepare_folder
from recon.run.interruption import InterruptedRunError
from recon.run.misfits import noise_model
from recon.run.reconstruct import Reconstructed
from recon.run.results import METRICS
from recon.run.room import check_room_for_descent
from torchdic import ShortOfMemoryError
from torchdic.errors import StackError
from torchdic.files.stack import write_volume
from torchdic.files.whole import write_json
from torchdic.ranks.group import ranks, ranks_here

DEVIATION, TOTAL = "sd.ome.tif", "error.ome.tif"


@dataclass(frozen=True)
class Wanted:
    """What error bars are asked for.

    noise, copies: numbers of refits to other noise, and of turned copies. increment: of the index, ml/g.
    outlines: drawn around parts of the volume, (z, y, x), by name.
    """

    noise: int = NOISY
    copies: int = COPIES
    increment: float = INCREMENT
    outlines: Mapping[str, Bool[Tensor, "z y x"]] | None = None


def error_bars(done: Reconstructed, wanted: Wanted, *, restart: bool = False) -> tuple[ErrorBars, Coverage | None]:
    """Find the error bars of a reconstruction, and leave them in its folder.

    Returns them, and what the images tell of a specimen of its contrast; None where they don't respond to a weak one.

    Its refits are kept there, and serve again. restart: do them anew.
    Raises CheckpointError where the folder has the refits of another volume, StackError where the noise isn't known,
    and InterruptedRunError on Ctrl-C, with the refits so far kept.
    """
    estimate, out = estimate_of(done), done.out
    prepare_folder(out)
    kept = KeptRefits(out / FOLDER, _identity(done))
    kept.begin(restart=restart)
    planned = planned_refits(wanted.noise, wanted.copies)
    missing = kept.missing(planned)
    began = time.perf_counter()
    try:
        for refit in refits(estimate, missing, at_once=_at_once(done)):
            kept.keep(refit)
    except KeyboardInterrupt:
        left = len(kept.missing(planned))
        raise InterruptedRunError(
            f"interrupted; {left} of {len(planned)} refits are left to do: go on likewise"
        ) from None
    seconds = time.perf_counter() - began
    found = bars_of(estimate, [_kept(kept, estimate, *one) for one in planned], wanted.increment, wanted.outlines)
    seen = coverage_of(done.config, done.measured.noise, found.delta)
    _leave(found, seen, done, wanted, seconds)
    return found, seen


def estimate_of(done: Reconstructed) -> Estimate:
    """A finished reconstruction as an estimate. Raises StackError where the noise of its stack isn't known."""
    return Estimate.of_fit(done.problem, done.step, _noise_of(done), _solver(done))


def poor_fit(out: Path) -> str | None:
    """What a reconstruction's verdict says where its volume doesn't explain the stack; None where it does."""
    verdict = json.loads((out / METRICS).read_text(encoding="utf-8"))["verdict"]
    return str(verdict["words"]) if verdict["poor"] else None


def _at_once(done: Reconstructed) -> bool:
    """Whether each of several processes fits by itself: where there is room for all of these fits."""
    if ranks() == 1 or done.config.reconstruction.method in DIRECT:
        return False
    try:
        check_room_for_descent(done.problem, GaussianMisfit, at_once=ranks_here())
    except ShortOfMemoryError:
        return False
    return True


def _solver(done: Reconstructed) -> Callable[[Problem], Step]:
    """How the reconstruction's method solves a problem."""

    def directly(problem: Problem) -> Step:
        return solved_directly(done.config.reconstruction, problem, done.measured.noise)[0]

    return directly if done.config.reconstruction.method in DIRECT else solved


def _noise_of(done: Reconstructed) -> NoiseModel | Sequence[float]:
    """The noise of the stack: by the camera's gain where it is known, else each prism's."""
    measured = done.measured
    told = noise_model(done.config, measured) or noise_of_level(measured.data, measured.left_out.counted)
    told = told or measured.noise
    if told is None:
        raise StackError(f"{done.out}: the noise of images so small can't be measured: there are no error bars without")
    return told


def _identity(done: Reconstructed) -> str:
    """A digest of the volume and of all that its refits depend on."""
    digest = hashlib.sha256(done.identity.encode())
    digest.update(done.step.delta.cpu().numpy().tobytes())
    return digest.hexdigest()


def _kept(kept: KeptRefits, estimate: Estimate, kind: Kind, number: int) -> Refit:
    truth = estimate.problem.setup.within_field(copy(estimate, number)).cpu() if kind == "turned" else None
    return Refit(kind, number, kept.delta(kind, number), truth)


def _leave(found: ErrorBars, seen: Coverage | None, done: Reconstructed, wanted: Wanted, seconds: float) -> None:
    """Write the volumes, the figure and the numbers into the reconstruction's folder."""
    out = done.out
    write_volume(out / DEVIATION, found.deviation, found.grid, name="standard deviation of delta n, by noise")
    write_volume(out / TOTAL, found.total, found.grid, name="standard deviation of delta n, in all")
    figures.save(draw_error_bars(found.delta, found.deviation, found.total, found.grid), out / "error_bars.png")
    numbers = {
        "refits": {"noise": wanted.noise, "turned": wanted.copies, "seconds": round(seconds, 3)},
        "increment_ml_per_g": wanted.increment,
        "inside_and_near": {
            "noise": found.typical(found.deviation),
            "lost": found.lost,
            "whole": found.typical(found.total),
        },
        "noise_interval": found.interval,
        "ends": list(ends(found.delta)),
        "seen_share": None if seen is None else seen.share,
        "regions": as_json(found.regions, done.config.volume.background),
    }
    write_json(out / ERROR_BARS, numbers)
