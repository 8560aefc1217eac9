"""The commands, a row each, and what the user has typed of them.

Nothing here imports torch, which takes seconds: help is there at once, and a command's module is imported with it.
"""

import argparse
import difflib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import NoReturn

from recon.cli import arguments
from recon.cli.exit_codes import BAD_INPUT, INTERRUPTED
from recon.cli.processes.torchrun import place, report
from recon.report.terminal import all_said, write_plainly


@dataclass(frozen=True)
class Command:
    """A command.

    module: has its function `run`. help: in one line. example: how it is typed, without `torchdic`. shared: arguments
    that other commands have too. own: whether its module has further `arguments`, which stand before the shared ones.
    aliases: its other names. reported: whether a folder of its results tells of the command and gets a report.html.
    """

    module: str
    help: str
    example: str
    shared: tuple[Callable[[argparse.ArgumentParser], None], ...]
    own: bool = False
    aliases: tuple[str, ...] = ()
    reported: bool = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add all of its arguments to its parser."""
        if self.own:
            import_module(self.module).arguments(parser)
        for add in self.shared:
            add(parser)

    @property
    def several(self) -> tuple[str, ...]:
        """Its options that take several numbers."""
        return getattr(import_module(self.module), "SEVERAL", ()) if self.own else ()


_COMPUTING = (arguments.device, arguments.processes)

COMMANDS = {
    "demo": Command(
        "recon.cli.demo",
        "simulate a small bead, reconstruct it in three ways and compare each with the truth",
        "demo",
        (arguments.out, arguments.restart),
    ),
    "doctor": Command(
        "recon.cli.doctor.command",
        "tell what this installation holds, and test in seconds whether it computes what it should",
        "doctor --device cpu",
        (arguments.device,),
    ),
    "simulate": Command(
        "recon.cli.simulate",
        "simulate the DIC images of a known specimen",
        "simulate cell.toml --out cell_simulated",
        (arguments.config, partial(arguments.out, what="simulated"), arguments.device, arguments.restart),
    ),
    "new": Command(
        "recon.cli.own_stack.new",
        "write a configuration for a recorded stack, from its file and its images",
        "new cell.ome.tif --condenser-na 0.7 --bias 85 --out run.toml",
        (),
        own=True,
        aliases=("init",),
    ),
    "phase": Command(
        "recon.cli.own_stack.phase",
        "find the phase, on an arbitrary scale, behind one image whose optics are unknown",
        "phase image.tif --out image_phase",
        (partial(arguments.out, what="phase"), arguments.restart),
        own=True,
    ),
    "plan": Command(
        "recon.cli.accuracy.plan",
        "find the fastest way to compute images within a tolerance, and which effects matter",
        "plan run.toml",
        (arguments.config, arguments.out_if_wanted, arguments.device),
    ),
    "coverage": Command(
        "recon.cli.evidence.coverage",
        "tell which frequencies of the index an acquisition sees, before it is recorded, and what would add to them",
        "coverage run.toml --suggest",
        (arguments.config, partial(arguments.out, what="coverage"), arguments.restart),
        own=True,
    ),
    "calibrate": Command(
        "recon.cli.calibrate",
        "find signs, orders and values of the optics, as far as the images of a stack tell them",
        "calibrate run.toml --out run_calibration",
        (arguments.config, partial(arguments.out, what="calibration"), *_COMPUTING, arguments.restart),
    ),
    "reconstruct": Command(
        "recon.cli.reconstruct",
        "find the refractive-index volume behind a stack of DIC images",
        "reconstruct run.toml --out run_volume",
        (arguments.config, partial(arguments.out, what="volume"), *_COMPUTING, arguments.earlier_run),
    ),
    "error-bars": Command(
        "recon.cli.evidence.error_bars",
        "tell how far each voxel of a reconstruction, and the numbers of its parts, can be trusted",
        "error-bars run_volume --regions labels.tif",
        (*_COMPUTING, arguments.restart),
        own=True,
    ),
    "view": Command(
        "recon.cli.view.command",
        "show volumes, error bars and images of a folder of results in napari",
        "view run_volume",
        (),
        own=True,
        reported=False,
    ),
    "report": Command(
        "recon.cli.evidence.report",
        "make the page that shows a folder's results, report.html, again",
        "report run_volume",
        (),
        own=True,
        reported=False,
    ),
    "completion": Command(
        "recon.cli.shell.completion",
        "print a script by which a shell completes commands, options and files",
        "completion bash",
        (),
        own=True,
        reported=False,
    ),
    "work-precision": Command(
        "recon.cli.accuracy.work_precision",
        "measure what accuracy costs: the error of images, or of reconstructions, against seconds and memory",
        "work-precision cell.toml --fit",
        (
            arguments.config,
            partial(arguments.out, what="work_precision"),
            arguments.device,
            arguments.fit,
            arguments.earlier_run,
        ),
    ),
}


def main(typed: Sequence[str] | None = None) -> int:
    """Run a command.

    typed: the words after `torchdic`; None takes them from the command line.
    Returns the exit code: 0, 1 for a fit that diverges or an installation that errs, 2 for bad input and where what is
    printed can't be written, 130 for an interruption. Of several processes that torchrun has started, the first one's
    counts.
    """
    write_plainly()
    found = place()
    if found is None:
        return _run(typed) or (0 if all_said() else BAD_INPUT)
    with interrupted_at_once():
        from recon.cli.processes.together import take_part
    return take_part(found, partial(_run, typed))


def _run(typed: Sequence[str] | None) -> int:
    words = list(sys.argv[1:] if typed is None else typed)
    name, chosen = next(
        ((name, row) for name, row in COMMANDS.items() if words and words[0] in (name, *row.aliases)), ("", None)
    )
    with interrupted_at_once():
        parser = _parser(chosen)
        if chosen is None:
            _check_command(words, parser)
        options = parser.parse_args(arguments.repeated(words, chosen.several if chosen else ()))
        assert chosen is not None  # the parser has shown the help or the version else, and ended the program
        arguments.choose_out(options, parser)
        options.command, options.typed, options.reported = name, shlex.join(["torchdic", *words]), chosen.reported
        from recon.cli.running import run

        command = import_module(chosen.module).run
    if getattr(options, "processes", 1) > 1:
        from recon.cli.processes.started import by_several

        return by_several(options.processes, partial(run, command, options))
    return run(command, options)


@contextmanager
def interrupted_at_once() -> Iterator[None]:
    """Within this block Ctrl-C ends the program in one line.

    While packages are imported, KeyboardInterrupt may come out of them as any other error.
    """

    def stop(*_: object) -> NoReturn:
        os.write(2, b"torchdic: error: interrupted\n")
        os._exit(INTERRUPTED)

    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # as behind nohup
    if ignored or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _check_command(words: Sequence[str], parser: argparse.ArgumentParser) -> None:
    """An error of the parser's unless the words, of which none is a command, ask for what needs no command."""
    if not words:
        parser.error("a command is wanted; torchdic --help lists them")
    word = words[0]
    if word in ("-h", "--help", "--version"):
        return
    if word.startswith("-"):
        parser.error(f"{word}: options come after the command, as in torchdic reconstruct run.toml --device cpu")
    names = [name for key, row in COMMANDS.items() for name in (key, *row.aliases)]
    close = difflib.get_close_matches(word, names, n=1)
    meant = f"did you mean {close[0]}?" if close else f"there are {', '.join(COMMANDS)}"
    parser.error(f"{word}: no such command; {meant}")


class _Parser(argparse.ArgumentParser):
    """A parser that reports an error in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        line = f"{self.prog}: error: {message}"
        report(line)
        self.exit(BAD_INPUT, f"{line}\n")


def whole_parser() -> argparse.ArgumentParser:
    """The parser of all commands with all of their arguments, for which all their modules are imported."""
    return _parser(*COMMANDS.values())


def _parser(*chosen: Command | None) -> argparse.ArgumentParser:
    """The parser of all commands, with the arguments of those that were chosen."""
    parser = _Parser(
        prog="torchdic",
        description="Simulate DIC images, and reconstruct the refractive-index volume behind measured ones.",
        epilog="torchdic COMMAND --help explains a command.",
    )
    arguments.version(parser)
    found = parser.add_subparsers(metavar="COMMAND")
    for name, command in COMMANDS.items():
        below = found.add_parser(
            name,
            help=command.help,
            description=f"{command.help[0].upper()}{command.help[1:]}.",
            epilog=f"example: torchdic {command.example}",
            aliases=list(command.aliases),
        )
        if command in chosen:
            command.add_arguments(below)
    return parser
