"""The arguments that commands share: each function here adds one to a command's parser."""

import argparse
import re
from collections.abc import Sequence
from pathlib import Path

import torch

from recon.config.schema import ConfigError
from recon.run.folder.prepared import check_folder
from torchdic import __version__

# A word that is meant as a number.
_NUMBER = re.compile(r"[+-]?[\d.,]+(e[+-]?\d+)?")


def config(parser: argparse.ArgumentParser) -> None:
    """The configuration file."""
    parser.add_argument(
        "config",
        type=Path,
        metavar="CONFIG.toml",
        help="configuration file: volume, microscope, acquisition, and the data or the specimen",
    )


def out(parser: argparse.ArgumentParser) -> None:
    """The folder for the results."""
    parser.add_argument(
        "--out",
        type=_folder,
        required=True,
        metavar="DIR",
        help="folder for the results; it is made where it is missing",
    )


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
    for word in words:
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


def version(parser: argparse.ArgumentParser) -> None:
    """The version of torchdic."""
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}", help="print the version")


def _folder(name: str) -> Path:
    """A folder that can be written to, as far as can be seen before it is made: first of all, not after the work."""
    try:
        check_folder(Path(name))
    except ConfigError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return Path(name)


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        tensor = torch.zeros(1, device=name)
        tensor.item()  # fails on the device "meta", which holds no values
    except (RuntimeError, AssertionError) as error:
        raise argparse.ArgumentTypeError(f"{name!r} is no device here: {str(error).splitlines()[0]}") from error
    return tensor.device
