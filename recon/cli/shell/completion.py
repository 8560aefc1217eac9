"""torchdic completion: the script by which a shell completes what is typed."""

import argparse
from pathlib import Path

import shtab

from recon.cli.commands import whole_parser


def arguments(parser: argparse.ArgumentParser) -> None:
    """The shell."""
    parser.add_argument(
        "shell", choices=shtab.SUPPORTED_SHELLS, metavar="SHELL", help=f"{', '.join(shtab.SUPPORTED_SHELLS)}"
    )


def run(options: argparse.Namespace) -> None:
    """Print the script."""
    parser = whole_parser()
    for below in _below(parser):
        for action in below._actions:
            if action.type is Path:
                action.complete = shtab.FILE  # pyright: ignore[reportAttributeAccessIssue]
    print(shtab.complete(parser, options.shell))


def _below(parser: argparse.ArgumentParser) -> list[argparse.ArgumentParser]:
    """The parsers of all commands."""
    found = next(action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    return list(found.choices.values())
