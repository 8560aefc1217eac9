"""Trials of the model against images with a known answer, as the rows of a Markdown table."""

import time
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdic import Acquisition, Fidelity, Microscope, Volume, image


def contrast_errors(images: Tensor, exact: Tensor) -> list[float]:
    """The rms difference over the exact image's standard deviation, at each focus plane, for the worst prism."""
    return ((images - exact).square().mean((2, 3)).sqrt() / exact.std((2, 3), correction=0)).amax(0).tolist()


def trial(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, exact: Tensor
) -> tuple[list[float], float]:
    """Errors at each focus plane, and the seconds that the images took."""
    start = time.perf_counter()
    with torch.no_grad():
        images = image(volume, microscope, acquisition, fidelity)
    return contrast_errors(images, exact), time.perf_counter() - start


def header(names: Sequence[str], focus: Sequence[float | Tensor]) -> str:
    """The head of a table: named columns, a column for each focus plane, seconds."""
    columns = [*names, *(f"{float(f):+.3g} µm" if f else "0" for f in focus), "seconds"]
    return _line(columns) + "\n" + "|---" * len(columns) + "|"


def row(cells: Sequence[str], errors: Sequence[float], seconds: float, digits: str = ".4f") -> str:
    """A row under such a head."""
    return _line([*cells, *(f"{e:{digits}}" for e in errors), f"{seconds:.1f}"])


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"
