"""torchdic error-bars: how far each voxel of a reconstruction, and the numbers of its parts, can be trusted."""

import argparse
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from recon.cli.arguments import decimal
from recon.config.schema import ConfigError
from recon.evidence.bars import ErrorBars
from recon.evidence.ends import MORE_SLICES, ends, open_ends
from recon.evidence.regions import INCREMENT, Known
from recon.report.verdict import PoorFitWarning
from recon.run.evidence.error_bars import DEVIATION, TOTAL, Wanted, error_bars, poor_fit
from recon.run.evidence.kept_refits import ERROR_BARS
from recon.run.evidence.seen import what_lacks
from recon.run.folder.results import check_inputs_stay
from recon.run.reconstruct import Reconstructed, reconstructed
from torchdic.files.stack import read_stack


def arguments(parser: argparse.ArgumentParser) -> None:
    """The folder of the reconstruction, and what is asked for."""
    usual = Wanted()
    parser.add_argument(
        "folder", type=Path, metavar="DIR", help="folder of a finished reconstruction; results go there too"
    )
    parser.add_argument(
        "--regions",
        type=Path,
        metavar="FILE",
        help="labels of parts, as large as the volume: 0 is none, 1, 2, … are outlines drawn around parts",
    )
    parser.add_argument(
        "--increment",
        type=_positive,
        default=INCREMENT,
        metavar="ML_PER_G",
        help=f"of the index with concentration, for dry mass (default: {INCREMENT:g} ml/g)",
    )
    for option, number, of in (("--refits", usual.noise, "other noise"), ("--copies", usual.copies, "turned copies")):
        parser.add_argument(option, type=_number, default=number, metavar="N", help=f"fits of {of} (default: {number})")


def run(options: argparse.Namespace) -> None:
    """Find the error bars of a reconstruction, print them, and leave them in its folder."""
    check_inputs_stay(options.folder, [options.regions], (DEVIATION, TOTAL))
    done = reconstructed(options.folder, options.device)
    outlines = dict(_outlines(options.regions, done)) if options.regions is not None else {}
    wanted = Wanted(options.refits, options.copies, options.increment, outlines)
    found, seen = error_bars(done, wanted, restart=options.restart)
    if (words := poor_fit(done.out)) is not None:
        warnings.warn(f"{words}. What is wrong with the model is in no bar", PoorFitWarning, stacklevel=1)
    print("\n".join(_words(found, done.config.volume.background)))
    if (lacks := what_lacks(done.config, seen)) is not None:
        print(lacks)
    print(f"\n{options.folder / ERROR_BARS}, {DEVIATION}, {TOTAL} and error_bars.png")


def _outlines(file: Path, done: Reconstructed) -> Iterator[tuple[str, Bool[Tensor, "z y x"]]]:
    """The outlines of a file of labels, by name.

    Raises ConfigError where it isn't of the volume's shape, is empty, or holds what is no whole number.
    """
    labels, shape = read_stack(file).data, done.config.volume.shape
    if labels.shape != (1, *shape):
        given, ours = (
            "×".join(map(str, sides)) for sides in (labels.shape[1:] if len(labels) == 1 else labels.shape, shape)
        )
        raise ConfigError(f"{file}: holds {given} labels, the volume {ours} voxels (z, y, x)")
    numbers = [number for number in np.unique(labels) if number != 0]
    if not numbers:
        raise ConfigError(f"{file}: holds no label other than 0: there is no region to measure")
    broken = next((number for number in numbers if number != int(number)), None)
    if broken is not None:
        raise ConfigError(f"{file}: holds {broken:g} where a label is wanted, which is a whole number; 0 is none")
    for number in numbers:
        yield f"region {int(number)}", torch.from_numpy(labels[0] == number)


def _words(found: ErrorBars, background: float) -> Iterator[str]:
    """What was found, a line each."""
    noise, whole = map(found.typical, (found.deviation, found.total))
    if not bool(found.delta.any()):
        yield "the volume is empty: the images show nothing of a specimen, and there are no error bars of nothing"
        return
    parts = f"± {noise:.2g} by noise, ± {found.lost:.2g} by what is lost"
    yield f"Δn inside and near the specimen: ± {whole:.2g}, of which {parts}"
    yield f"68 % of what noise does there lies within {found.interval:.2g} of its standard deviations"
    for name, (region, numbers) in found.regions.items():
        volume, mean, mass = (numbers[quantity] for quantity in ("volume", "mean", "mass"))
        above = "" if region.threshold is None else f", {_beyond(region.threshold)}"
        yield f"{name}{above}:"
        yield f"  volume      {_told(volume)} µm³ ({volume.found:.4g} in the volume)"
        yield f"  mean index  {background + mean.value:.5f} ± {mean.error:.2g} ({background + mean.found:.5f})"
        yield f"  dry mass    {_told(mass)} pg more than its medium ({mass.found:.4g})".replace("-", "−")
    yield "numbers are corrected for what turned copies lose of theirs; in brackets, as they are in the volume"
    beyond = open_ends(*ends(found.delta))
    if beyond is None:
        yield "the bars hold two of three voxels of turned copies of it; what the images don't show at all is in no bar"
        return
    yield (
        f"the volume doesn't end within its depth: {beyond}, and turned copies fill it likewise. How far the specimen "
        f"really goes on is in no bar, and volume and mean index hang on it: {MORE_SLICES}"
    )


def _beyond(threshold: float) -> str:
    return f"Δn {'above' if threshold >= 0 else 'below'} {threshold:.3g}".replace("-", "−")


def _told(known: Known) -> str:
    return f"{known.value:.4g} ± {known.error:.2g}".replace("-", "−")


def _positive(text: str) -> float:
    value = decimal(text)
    if not (0 < value < float("inf")):
        raise argparse.ArgumentTypeError(f"{text} must be above 0")
    return value


def _number(text: str) -> int:
    if not text.isdecimal() or int(text) < 2:
        raise argparse.ArgumentTypeError(f"{text} must be a number of at least 2")
    return int(text)
