"""The picture of a coverage: what is seen of the frequencies, along and across the shear, and how wide a point gets."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from numpy.typing import NDArray

from recon.coverage.expected import lateral_frequencies
from recon.coverage.seen import Coverage


def draw_coverage(coverage: Coverage, axis: float) -> Figure:
    """Draw what is seen of the frequencies along an axis across z and across it, and the estimate of a point.

    axis: of the first shear, from right towards down, in rad.
    """
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    along, across, point = figure.subplots(1, 3)
    for ax, angle, words in ((along, axis, "along the shear"), (across, axis + math.pi / 2, "across the shear")):
        shown = _draw_seen(ax, coverage, angle)
        ax.set_title(f"{words}, {math.degrees(angle) % 180:.3g}°", fontsize=9)
    _bar(figure.colorbar(shown, ax=[along, across]), "seen (1) or guessed (0)")
    _draw_point(figure, point, coverage)
    return figure


def _draw_seen(ax: Axes, coverage: Coverage, angle: float):
    """The diagonal of R over frequencies across z, along an angle, and along z."""
    grid = coverage.grid
    highest = min(0.5 / d for d in grid.spacing[1:])
    steps = np.linspace(-highest, highest, max(grid.shape[1:]) + 1)
    columns = np.stack([_at(coverage, f * math.sin(angle), f * math.cos(angle)) for f in steps], 1)
    both = np.concatenate([columns[:0:-1], columns])
    axial = (len(columns) - 0.5) / (2 * grid.extent[0])
    shown = ax.imshow(
        both, extent=(-highest, highest, -axial, axial), origin="lower", vmin=0, vmax=1, cmap="magma", aspect="auto"
    )
    passed = np.array(
        [coverage.passed[_index(coverage, f * math.sin(angle), f * math.cos(angle))].any() for f in steps]
    )
    reach = float(np.abs(steps[passed]).max()) if passed.any() else highest
    ax.set_xlim(-min(1.15 * reach, highest), min(1.15 * reach, highest))
    ax.set_xlabel("frequency across z, 1/µm", fontsize=8)
    ax.set_ylabel("frequency along z, 1/µm", fontsize=8)
    ax.tick_params(labelsize=7)
    return shown


def _index(coverage: Coverage, y: float, x: float) -> tuple[int, int]:
    """The wave that is nearest to a frequency (y, x) in 1/µm, or its opposite."""
    if x < 0:
        y, x = -y, -x
    along_y, along_x = lateral_frequencies(coverage.grid)
    return int((along_y - y).abs().argmin()), int((along_x - x).abs().argmin())


def _at(coverage: Coverage, y: float, x: float) -> NDArray[np.floating]:
    return coverage.seen[_index(coverage, y, x)].numpy()


def _draw_point(figure: Figure, ax: Axes, coverage: Coverage) -> None:
    """A section along z through the estimate of a point."""
    grid, (response, place) = coverage.grid, coverage.estimate_of_point()
    section = response[:, place[1]]
    largest = float(section.abs().max()) or 1.0
    half = 0.5 * min(grid.extent[2], grid.extent[0])
    size = 0.5 * grid.extent[2], 0.5 * grid.extent[0]
    shown = ax.imshow(
        (section / largest).numpy(), extent=(-size[0], size[0], size[1], -size[1]), cmap="RdBu_r", vmin=-1, vmax=1
    )
    ax.set_xlim(-half, half)
    ax.set_title("what becomes of a point", fontsize=9)
    ax.set_xlabel("x, µm", fontsize=8)
    ax.set_ylabel("z, µm", fontsize=8)
    ax.tick_params(labelsize=7)
    _bar(figure.colorbar(shown, ax=ax), "Δn, over its largest")


def _bar(bar: Colorbar, words: str) -> None:
    bar.set_label(words, fontsize=8)
    bar.ax.tick_params(labelsize=7)
