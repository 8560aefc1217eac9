"""A descent that leaves a log and checkpoints in a folder, so that it may be interrupted and resumed."""

from collections.abc import Callable
from pathlib import Path

from tqdm import tqdm

from recon.fit.descent import minimise
from recon.fit.planned import announce_record
from recon.fit.problem import Problem
from recon.fit.step import Step
from recon.misfit.gaussian import GaussianMisfit
from recon.report.forecast import USUAL_STEPS, Bar, Forecast, spoken
from recon.run.checkpoint import Checkpoint, save, save_if_possible
from recon.run.folder.lock import FolderInUseError
from recon.run.folder.prepared import keep_folder
from recon.run.interruption import InterruptedRunError, signals_kept
from recon.run.log import open_log
from recon.run.results import VOLUME, leave_interrupted
from recon.run.room import bytes_held
from torchdic.errors import StackError
from torchdic.files.whole import WriteError
from torchdic.memory.free import GIB
from torchdic.memory.shortage import as_shortage, is_shortage

LOG, CHECKPOINT = "log.csv", "checkpoint.pt"

# What a step may fail by: the fit diverges, its light can't be followed, there is no room for it (the last three, see
# `torchdic.memory.shortage`).
STOPPING = (FloatingPointError, ValueError, MemoryError, RuntimeError, ImportError)

# Seconds from which on it is worth some more to foresee the memory, too.
LONG = 60.0


def tell_foreseen(problem: Problem, forecast: Forecast, number: int = 0, descents: float = 1.0, of: str = "") -> None:
    """Print what a descent will take, after a trial; nothing where its fidelity has yet to be planned.

    number: steps so far. descents: such as this one. of: what is done by them, in words. Raises as the images of a
    step do.
    """
    seconds = forecast.whole(number)
    if seconds is None:
        return
    seconds *= descents
    words = f"foreseen: {spoken(seconds)}{of}"
    if seconds > LONG:
        words += f" and {bytes_held(problem, GaussianMisfit) / GIB:.2g} GiB"
    if problem.method == "newton" and problem.steps > USUAL_STEPS:
        words += f", if descents end after {USUAL_STEPS} of {problem.steps} steps, as is usual"
    print(words)


# Leaves the volume of a step at which a descent was stopped, and says in words where. Raises StackError.
Leave = Callable[[Step], str]


def descend_recorded(
    problem: Problem,
    out: Path,
    checkpoint_every: int,
    identity: str,
    start: Checkpoint | None = None,
    leave: Leave | None = None,
    forecast: Forecast | None = None,
) -> Checkpoint:
    """Take the steps of a problem, with a progress bar; returns the last one, with all rows of the log.

    out: folder of the log and the checkpoint. checkpoint_every: steps between checkpoints. identity: what the descent
    depends on, for the checkpoint. start: to go on from. leave: leaves the volume where the descent is stopped; None
    leaves it in the folder. forecast: of the time left; None is one that knows nothing.
    A folder that is removed on the way is made anew.
    Raises InterruptedRunError on Ctrl-C or SIGTERM, and what a step raises, FloatingPointError where the fit diverges;
    with a checkpoint and the volume of the last good step saved. Warns UnsavedWarning where the log or a checkpoint
    cannot be written.
    """
    step: Step | None = None if start is None else start.step
    good = None  # the step before: its volume has been judged, by the next one
    rows = [] if start is None else start.rows
    announced = 0 if step is None else len(step.plans)
    steps, before = minimise(problem, step), 0.0 if step is None else step.seconds
    with (
        open_log(out / LOG, rows) as log,
        Bar(forecast or Forecast(problem), problem.steps, len(rows)) as bar,
        signals_kept() as check_signals,
    ):
        try:
            for latest in steps:
                good, step = step, latest
                log.add(step.row)
                for record in step.plans[announced:]:
                    tqdm.write(announce_record(record))
                announced = len(step.plans)
                bar.step(step.number, step.seconds - before, step.misfit)
                before = step.seconds
                if step.number % checkpoint_every == 0:
                    _save(out, Checkpoint(step, log.rows, identity))
                check_signals()
        except KeyboardInterrupt:
            if step is None:
                raise InterruptedRunError("interrupted before the first step") from None
            log.add(step.row)  # the signal may have come between the step and its row
            left = leave_stopped(out, problem, Checkpoint(step, log.rows, identity), leave)
            raise InterruptedRunError(f"interrupted after step {step.number} of {problem.steps}; {left}") from None
        except STOPPING as error:
            kept = _last_good(error, good, step)
            known = as_shortage(error)
            if kept is not None:
                done = [row for row in log.rows if row[0] <= kept.number]
                left = leave_stopped(out, problem, Checkpoint(kept, done, identity), leave)
                known.args = (f"{known}; stopped after step {kept.number} of {problem.steps}; {left}",)
            raise known from known.__cause__
        assert step is not None
        keep_folder(out)
        return Checkpoint(step, log.rows, identity)


def _last_good(error: Exception, before: Step | None, step: Step | None) -> Step | None:
    """The step to keep after an error: none where the folder is another run's by now."""
    if isinstance(error, FolderInUseError):
        return None
    return before if isinstance(error, FloatingPointError) else step


def _save(out: Path, checkpoint: Checkpoint) -> None:
    keep_folder(out)
    save_if_possible(out / CHECKPOINT, checkpoint)


def leave_stopped(out: Path, problem: Problem, stopped: Checkpoint, leave: Leave | None = None) -> str:
    """Leave a checkpoint and the volume of a descent that came to no end; returns a line about them for the user."""
    keep_folder(out)
    try:
        save(out / CHECKPOINT, stopped)
        line = "go on with --resume"
    except (WriteError, MemoryError, RuntimeError) as error:
        line = _unsaved(out / CHECKPOINT, error)
    try:
        return f"{line}; {(leave or _leaving(out, problem))(stopped.step)}"
    except (StackError, MemoryError, RuntimeError) as error:
        return f"{line}; {_unsaved(out / VOLUME, error)}"


def _unsaved(path: Path, error: Exception) -> str:
    """Why a file isn't there. Raises an error that tells of a fault of the program's."""
    if is_shortage(error):
        return f"{path}: cannot be written: no memory is left for it"
    if isinstance(error, RuntimeError):
        raise error
    return str(error)


def _leaving(out: Path, problem: Problem) -> Leave:
    """What leaves the volume of a problem's step in a folder, see `Leave`."""

    def leave(step: Step) -> str:
        delta = problem.setup.within_field(step.delta).detach().cpu()
        path = leave_interrupted(out, delta, problem.setup.field, f"delta n, interrupted after step {step.number}")
        return f"{path.name} holds Δn so far"

    return leave
