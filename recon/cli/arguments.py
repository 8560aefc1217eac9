"""The arguments that commands share: each function here adds one to a command's parser.

What takes seconds to import is imported where it is needed, so that help is there at once.
"""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from recon.cli.beside import beside

# A word that is meant as a number.
_NUMBER = re.compile(r"[+-]?[\d.,]+(e[+-]?\d+)?", re.IGNORECASE)
_BELOW_0 = re.compile(r"-(\d[\d.,]*e[+-]?\d+|inf|nan)", re.IGNORECASE)


def config(parser: argparse.ArgumentParser) -> None:
    """The configuration file."""
    parser.add_argument(
        "config",
        type=Path,
        metavar="CONFIG.toml",
        help="configuration file: volume, microscope, acquisition, and the data or the specimen",
    )


def out(parser: argparse.ArgumentParser, what: str = "") -> None:
    """The folder for the results.

    what: the results are. Without --out they go beside the input, into a folder that is named after it and them; or,
    where there is no input, after the command.
    """
    name = parser.prog.rpartition(" ")[2]
    usual = f"beside the input, named after it: NAME_{what}" if what else name
    parser.set_defaults(usual_out=lambda options: beside(_input(options), f"_{what}") if what else Path(name))
    parser.add_argument("--out", type=_folder, metavar="DIR", help=f"folder for the results (default: {usual})")


def choose_out(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Put in the usual folder where the user has named none; an error of the parser's where it can't be written to."""
    if "usual_out" not in options or options.out is not None:
        return
    try:
        options.out = _folder(str(options.usual_out(options)))
    except argparse.ArgumentTypeError as error:
        parser.error(f"{error}; name another folder by --out")


def _input(options: argparse.Namespace) -> Path:
    return options.config if "config" in options else options.image[0]


def out_if_wanted(parser: argparse.ArgumentParser) -> None:
    """A folder for a command that prints its results, and may save them too."""
    parser.add_argument("--out", type=_folder, metavar="DIR", help="folder to save the plan in, as plan.json")


def device(parser: argparse.ArgumentParser) -> None:
    """Where to compute."""
    parser.add_argument(
        "--device",
        type=_device,
        default="auto",
        help="where to compute: cpu, cuda, … (default: a GPU if PyTorch finds one)",
    )


def processes(parser: argparse.ArgumentParser) -> None:
    """How many processes compute together."""
    parser.add_argument(
        "--processes",
        type=_processes,
        default=1,
        metavar="N",
        help="compute with N processes, as many as there are cores to spare; each needs memory (default: 1)",
    )


def earlier_run(parser: argparse.ArgumentParser) -> None:
    """What to do with an earlier run that is found in the folder."""
    choice = parser.add_mutually_exclusive_group()
    choice.add_argument("--resume", action="store_true", help="go on with the run in DIR, if there is one")
    choice.add_argument("--restart", action="store_true", help="start again and replace the run in DIR")


def restart(parser: argparse.ArgumentParser) -> None:
    """Whether to replace the results that are found in the folder."""
    parser.add_argument("--restart", action="store_true", help="replace the results in DIR, if there are any")


def fit(parser: argparse.ArgumentParser) -> None:
    """Whether reconstructions are measured instead of images."""
    parser.add_argument(
        "--fit",
        action="store_true",
        help="measure reconstructions instead of images: error of the volume, or misfit over noise of a measured stack",
    )


def decimal(text: str) -> float:
    """A number as a word of the command line. Raises ArgumentTypeError, which offers a decimal point for a comma."""
    try:
        return float(text)
    except ValueError:
        if re.fullmatch(r"[+-]?\d*,\d+", text):
            point = text.replace(",", ".")
            raise argparse.ArgumentTypeError(f"{text} has a decimal comma: write {point}") from None
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None


def repeated(words: Sequence[str], several: Sequence[str]) -> list[str]:
    """The words of a command, where an option of several numbers stands before each of them.

    several: such options. argparse by itself would take the name of a stack that follows them for one more number.
    """
    told: list[str] = []
    option, numbers = "", 0
    for word in _joined(words):
        name, _, value = word.partition("=")
        if name in several:
            option, numbers = name, int(bool(value))
        elif option and _NUMBER.fullmatch(word) and not Path(word).exists():
            told += [option] if numbers else []
            numbers += 1
        else:
            option = ""
        told.append(word)
    return told


def _joined(words: Sequence[str]) -> list[str]:
    """The words, in which an option and a number such as -1e9 are one: argparse takes that for another option.

    A minus sign that was copied from a text is a hyphen.
    """
    joined: list[str] = []
    for word in (f"-{word[1:]}" if re.match(r"−\d", word) else word for word in words):
        if joined and joined[-1].startswith("--") and "=" not in joined[-1] and _BELOW_0.fullmatch(word):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def version(parser: argparse.ArgumentParser) -> None:
    """The version of torchdic."""
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")


class _Version(argparse.Action):
    """Prints the version and ends the program."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> NoReturn:
        from torchdic import __version__

        print(f"{parser.prog} {__version__}")
        parser.exit()


def _folder(name: str) -> Path:
    """A folder that can be written to, as far as can be seen before it is made: first of all, not after the work."""
    from recon.config.schema import ConfigError
    from recon.run.folder.prepared import check_folder

    try:
        check_folder(Path(name))
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(name)


def _processes(text: str) -> int:
    """A number of processes."""
    from recon.cli.processes.torchrun import place

    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} must be a number of processes, 1 or more")
    if int(text) > 1 and (found := place()) is not None:
        raise argparse.ArgumentTypeError(f"{text}: torchrun has started {found.ranks} processes already")
    return int(text)


def _device(name: str) -> Any:
    """A device of torch."""
    import torch

    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        tensor = torch.zeros(1, device=name)
        tensor.item()  # fails on the device "meta", which holds no values
    except (RuntimeError, AssertionError) as error:
        why = re.split(r"[.:,] ", str(error).splitlines()[0])[0]  # torch goes on to list all that it knows
        raise argparse.ArgumentTypeError(f"{name!r} is no device here: {why}") from error
    return tensor.device
