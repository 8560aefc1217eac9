"""A command that the user has chosen is run here: what happens to its errors and warnings."""

import argparse
import errno
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import Any

from tqdm import tqdm

from recon.cli.doctor.selftest import SelfTestError
from recon.cli.exit_codes import BAD_INPUT, FAILED, INTERRUPTED
from recon.cli.processes.torchrun import fail
from recon.config.schema import AssumedWarning, ConfigError, UnlikelyWarning
from recon.report.html.page import ForeignReportError, leave_report
from recon.run.checkpoint import CheckpointError, UnsavedWarning
from recon.run.folder.index import leave_index
from recon.run.folder.lock import FolderInUseError, folders_released, hold
from recon.run.folder.record import Record
from recon.run.folder.results import FinishedError
from recon.run.interruption import InterruptedRunError
from recon.run.results import ResultsError
from torchdic import ApertureWarning, LostRankError, SamplingWarning, ToleranceWarning
from torchdic.errors import BatchWarning, SidewaysError, StackError, TurnedRaysError, UnstableError
from torchdic.files.whole import WriteError
from torchdic.memory.shortage import as_shortage, is_shortage
from torchdic.ranks.signals import ignore_signals

# What the user can put right, in one line that says what.
WRONG = (
    ConfigError,
    StackError,
    CheckpointError,
    FinishedError,
    FolderInUseError,
    ForeignReportError,
    ResultsError,
    WriteError,
)


# What the system says of a name that the user gives: it is too long, or lies where the user may not look.
OF_NAMES = (errno.ENAMETOOLONG, errno.EACCES, errno.EPERM)


class NoReportError(ResultsError):
    """Results are there, but the page that shows them can't be written: one line with the reason."""


def run(command: Callable[[argparse.Namespace], None], options: argparse.Namespace) -> int:
    """Run a command with the user's options; returns the exit code, see `recon.cli.commands.main`."""
    _show_each_warning_once()
    record = Record()
    try:
        with folders_released():
            _hold_folder(options)
            try:
                command(options)
                _leave_report(options, record)
            except (InterruptedRunError, NoReportError):
                _leave_index(options)
                raise
            _leave_index(options)
    except WRONG as error:
        return _fail(str(error), BAD_INPUT)
    except TurnedRaysError as error:
        return _fail(f"{_input(options)}{error}; the wave may cross it", BAD_INPUT)
    except (UnstableError, SidewaysError) as error:
        return _fail(f"{_input(options)}{error}", BAD_INPUT)
    except LostRankError as error:
        ignore_signals()  # torchrun's, which ends the others
        return _fail(str(error), FAILED)
    except (FloatingPointError, SelfTestError) as error:
        return _fail(str(error), FAILED)
    except (InterruptedRunError, KeyboardInterrupt) as error:
        return _fail(str(error) or "interrupted", INTERRUPTED)
    except (OSError, MemoryError, RuntimeError, ImportError, SystemError) as error:
        if is_shortage(error):
            return _fail(f"{_input(options)}{as_shortage(error)}", BAD_INPUT)
        if isinstance(error, OSError) and error.errno in OF_NAMES and error.filename is not None:
            return _fail(f"{error.filename}: {error.strerror}", BAD_INPUT)
        raise
    return 0


def _input(options: argparse.Namespace) -> str:
    """What the command works on, to stand before an error."""
    found = (getattr(options, name, None) for name in ("config", "folder"))
    return "".join(f"{path}: " for path in found if path is not None)


def _hold_folder(options: argparse.Namespace) -> None:
    """Keep other runs out of the command's folder, where it is there already."""
    out = getattr(options, "out", None)
    if out is not None and out.is_dir():
        hold(out)


def _folder(options: argparse.Namespace) -> Path | None:
    """The folder of the results, where there is one."""
    out = getattr(options, "out", None) or getattr(options, "folder", None)
    return out if out is not None and out.is_dir() else None


def _leave_report(options: argparse.Namespace, record: Record) -> None:
    """Leave beside the results how they were made and the page that shows them. Raises NoReportError."""
    out = _folder(options)
    if out is None or not options.reported:
        return
    try:
        record.leave(out, options.command, options.typed, getattr(options, "device", None))
    except WriteError as error:  # the results are there
        warnings.warn(str(error), UnsavedWarning, stacklevel=2)
    try:
        leave_report(out)
    except ForeignReportError as error:
        warnings.warn(str(error), UnsavedWarning, stacklevel=2)
    except WriteError as error:
        raise NoReportError(f"{error}; make room, and torchdic report {quote(str(out))} makes it") from error


def _leave_index(options: argparse.Namespace) -> None:
    """Say in the folder of the results what each file is."""
    out = _folder(options)
    if out is None:
        return
    try:
        leave_index(out)
    except WriteError as error:  # the results are there
        warnings.warn(str(error), UnsavedWarning, stacklevel=2)


def _show_each_warning_once() -> None:
    """Show each warning once, as one line above the progress bar; of each kind about images, the first.

    Python's own rule "once" would show a warning again for each module that it comes from. A descent's images change
    from step to step, and with them the digits of a warning about them.
    """
    shown: set[object] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        kind = type(message) if isinstance(message, BatchWarning) else str(message)
        if kind not in shown:
            shown.add(kind)
            tqdm.write(f"torchdic: warning: {message}", file=sys.stderr)

    warnings.showwarning = show
    for kind in (ApertureWarning, AssumedWarning, SamplingWarning, ToleranceWarning, UnlikelyWarning):
        warnings.simplefilter("always", kind)


def _fail(message: str, code: int) -> int:
    fail(message)
    return code
