"""The commands, a row each, and what happens to their errors and warnings."""

import argparse
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

from tqdm import tqdm

from recon.cli import arguments, calibrate, demo, plan, reconstruct, simulate, work_precision
from recon.cli.evidence import coverage, error_bars
from recon.cli.own_stack import new, phase
from recon.cli.own_stack.options import SEVERAL
from recon.config.schema import AssumedWarning, ConfigError, UnlikelyWarning
from recon.report.terminal import write_plainly
from recon.run.checkpoint import CheckpointError
from recon.run.folder.lock import FolderInUseError, folders_released, hold
from recon.run.folder.results import FinishedError
from recon.run.interruption import InterruptedRunError
from recon.run.results import ResultsError
from torchdic import ApertureWarning, SamplingWarning, ShortOfMemoryError, ToleranceWarning
from torchdic.errors import BatchWarning, SidewaysError, StackError, TurnedRaysError, UnstableError
from torchdic.files.whole import WriteError

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130

# What the user can put right, in one line that says what.
WRONG = (ConfigError, StackError, CheckpointError, FinishedError, FolderInUseError, ResultsError, WriteError)


@dataclass(frozen=True)
class Command:
    """A command: its help in one line, the function that runs it, the arguments that it takes, and its other names.

    several: its options that take several numbers.
    """

    help: str
    run: Callable[[argparse.Namespace], None]
    arguments: tuple[Callable[[argparse.ArgumentParser], None], ...]
    aliases: tuple[str, ...] = ()
    several: tuple[str, ...] = ()


COMMANDS = {
    "demo": Command(
        "simulate a small bead, reconstruct it in three ways and compare each with the truth",
        demo.run,
        (arguments.out, arguments.restart),
    ),
    "simulate": Command(
        "simulate the DIC images of a known specimen",
        simulate.run,
        (arguments.config, arguments.out, arguments.device, arguments.restart),
    ),
    "new": Command(
        "write a configuration for a recorded stack, from its file and its images",
        new.run,
        (new.arguments,),
        ("init",),
        several=SEVERAL,
    ),
    "phase": Command(
        "find the phase, on an arbitrary scale, behind one image whose optics are unknown",
        phase.run,
        (phase.arguments, arguments.out, arguments.restart),
    ),
    "plan": Command(
        "find the fastest way to compute images within a tolerance, and which effects matter",
        plan.run,
        (arguments.config, arguments.out_if_wanted, arguments.device),
    ),
    "coverage": Command(
        "tell which frequencies of the index an acquisition sees, before it is recorded, and what would add to them",
        coverage.run,
        (arguments.config, arguments.out, coverage.arguments, arguments.restart),
    ),
    "calibrate": Command(
        "find signs, orders and values of the optics, as far as the images of a stack tell them",
        calibrate.run,
        (arguments.config, arguments.out, arguments.device, arguments.restart),
    ),
    "reconstruct": Command(
        "find the refractive-index volume behind a stack of DIC images",
        reconstruct.run,
        (arguments.config, arguments.out, arguments.device, arguments.earlier_run),
    ),
    "error-bars": Command(
        "tell how far each voxel of a reconstruction, and the numbers of its parts, can be trusted",
        error_bars.run,
        (error_bars.arguments, arguments.device, arguments.restart),
    ),
    "work-precision": Command(
        "measure what accuracy costs: the error of images, or of reconstructions, against seconds and memory",
        work_precision.run,
        (arguments.config, arguments.out, arguments.device, arguments.fit, arguments.earlier_run),
    ),
}


def main(typed: Sequence[str] | None = None) -> int:
    """Run a command.

    typed: the words after `torchdic`; None takes them from the command line.
    Returns the exit code: 0, 1 for a fit that diverges, 2 for bad input, 130 for an interruption.
    """
    write_plainly()
    words = list(sys.argv[1:] if typed is None else typed)
    rows = [row for name, row in COMMANDS.items() if words and words[0] in (name, *row.aliases)]
    several = rows[0].several if rows else ()
    options = _parser().parse_args(arguments.repeated(words, several))
    _show_each_warning_once()
    try:
        with folders_released():
            _hold_folder(options)
            options.run(options)
    except WRONG as error:
        return _fail(str(error), BAD_INPUT)
    except TurnedRaysError as error:
        return _fail(f"{options.config}: {error}; the wave may cross it", BAD_INPUT)
    except (UnstableError, SidewaysError, ShortOfMemoryError) as error:
        return _fail(f"{options.config}: {error}", BAD_INPUT)
    except FloatingPointError as error:
        return _fail(str(error), FAILED)
    except (InterruptedRunError, KeyboardInterrupt) as error:
        return _fail(str(error) or "interrupted", INTERRUPTED)
    return 0


def _hold_folder(options: argparse.Namespace) -> None:
    """Keep other runs out of the command's folder, where it is there already."""
    out = getattr(options, "out", None)
    if out is not None and out.is_dir():
        hold(out)


class _Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="torchdic",
        description="Simulate DIC images, and reconstruct the refractive-index volume behind measured ones.",
        epilog="torchdic COMMAND --help explains a command.",
    )
    arguments.version(parser)
    found = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        words = f"{command.help[0].upper()}{command.help[1:]}."
        below = found.add_parser(name, help=command.help, description=words, aliases=list(command.aliases))
        below.set_defaults(run=command.run)
        for add in command.arguments:
            add(below)
    return parser


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
    print(f"torchdic: error: {message}", file=sys.stderr)
    return code
