"""torchdic new: a configuration from a recorded stack, in which every value says where it comes from."""

import argparse
from pathlib import Path
from shlex import quote

from recon.cli.beside import beside
from recon.cli.own_stack.options import SEVERAL, Given, add_options, given_of, in_radians
from recon.cli.own_stack.paths import check_not_there, check_out, joined_beside
from recon.cli.own_stack.settled import BACKGROUND, NA, WAVELENGTH, Settled, settle
from recon.cli.own_stack.table import summary, warnings_of
from recon.cli.own_stack.template import template
from recon.cli.own_stack.unusable import check_background, check_recorded, put_back
from recon.config.including import seen_from
from recon.config.plausible.unlikely import unlikely
from recon.config.reading import parse
from recon.config.schema import Config, ConfigError
from recon.recording.stuck_pixels import sharpest
from recon.recording.survey.survey import Survey, survey
from torchdic import Microscope, Objective
from torchdic.files.gathered import Gathered, gather
from torchdic.files.stack import write_stack
from torchdic.files.whole import write_text

__all__ = ["SEVERAL", "arguments", "run"]

# A pixel in µm, of which no spot of light fills one alone.
SMALL = 0.05


def arguments(parser: argparse.ArgumentParser) -> None:
    """The stack's files, the configuration to write, and what they lack."""
    parser.add_argument(
        "stack", type=Path, nargs="+", metavar="STACK", help="a file, several (a plane or a setting each), or a folder"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="RUN.toml",
        help="configuration file to write (default: beside the stack, named after it)",
    )
    parser.add_argument("--series", type=int, metavar="N", help="which of several stacks in the file, counted from 0")
    add_options(parser)
    parser.add_argument("--lower", action="store_true", help="the specimen's index is below its medium's")


def run(options: argparse.Namespace) -> None:
    """Write a configuration for a stack and print what is in it, and what is assumed."""
    out = options.out or beside(options.stack[0], ".toml")
    try:
        check_out(out, options.stack)
    except ConfigError as error:
        raise error if options.out else ConfigError(f"{error}; name another file by --out") from error
    given = given_of(options)
    gathered = gather(options.stack, options.series)
    found, settled = look(gathered, {**given, "lower": options.lower})
    joined = None if gathered.one_file else joined_beside(out)
    if joined is not None:
        check_not_there([joined])
    data = options.stack[0] if gathered.one_file and not options.stack[0].is_dir() else gathered.files[0]
    path = _seen_from(out.parent, data if joined is None else joined)
    text = template(gathered, found, settled, path, options.series if joined is None else None)
    config = _parsed(text, out)
    out.parent.mkdir(parents=True, exist_ok=True)
    if joined is not None:
        _join(gathered, settled, joined)
    write_text(out, text)
    print(summary(out, gathered, found, settled))
    likely_wrong = [*in_radians(given), *(f"warning: {line}" for line in unlikely(config))]
    for line in (*warnings_of(gathered, found, settled), *likely_wrong):
        print(f"  {line}")
    named = quote(str(out))
    print(
        f"\nCorrect what is assumed in {out}. Then torchdic calibrate {named} finds what the images can tell, and "
        f"torchdic reconstruct {named} the volume."
    )


def _seen_from(folder: Path, stack: Path) -> str:
    try:
        return seen_from(folder, stack)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _parsed(text: str, out: Path) -> Config:
    """The configuration, before it is written: what the user gave, or what follows from it, may break a law."""
    try:
        return parse(text.encode(), "")
    except ConfigError as error:
        raise ConfigError(f"{out} isn't written, because it would say{error}") from error


def look(gathered: Gathered, given: Given) -> tuple[Survey, Settled]:
    """What the images tell, and the values of a configuration.

    Raises StackError or ConfigError where the images can't be compared with a model's, see `unusable`.
    """
    said, pixel = gathered.setup, gathered.stack.pixel_size
    microscope = Microscope(
        given.get("wavelength") or said.wavelength or WAVELENGTH, Objective(given.get("na") or said.na or NA)
    )
    check_recorded(gathered.stack)
    stack = put_back(gathered.stack, given.get("offset"))
    background, side = given.get("background") or BACKGROUND, given.get("pixel_size")
    # without a pixel size the smallest ratio that `sharpest` knows finds the most stuck pixels
    size = (side, side) if side else pixel or (SMALL, SMALL)
    found = survey(stack, sharpest(microscope, size, background))
    check_background(stack, found, given.get("offset"))
    return found, settle(gathered, found, given)


def _join(gathered: Gathered, settled: Settled, path: Path) -> None:
    """Write the planes of several files as one stack beside the configuration."""
    stack, pixel = gathered.stack, (settled.pixel_height, settled.pixel_size.value)
    known = settled.step.origin != "assumed" and stack.data.shape[1] > 1
    write_stack(
        path,
        stack.data,
        None if settled.pixel_size.origin == "assumed" else pixel,
        settled.step.value if known else None,
        bits=stack.bits,
        names=stack.names,
    )
