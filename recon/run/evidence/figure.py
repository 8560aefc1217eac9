"""The picture of error bars: sections of Δn and of its errors, and lines through it with their bars."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from recon.report.figures import centre, scale_bar, show
from torchdic import Grid

PLANES = ("xy", "xz")


def draw_error_bars(
    delta: Float[Tensor, "z y x"], deviation: Float[Tensor, "z y x"], total: Float[Tensor, "z y x"], grid: Grid
) -> Figure:
    """Draw an estimate, its standard deviation by noise and in all, and lines along x and z with both."""
    through = centre(delta)
    size = dict(zip("zyx", grid.extent, strict=True))
    heights = [size[plane[1]] for plane in PLANES]
    figure = Figure(figsize=(12.5, 2.3 * sum(heights) / size["x"] + 1.2), layout="constrained")
    axes = figure.subplots(2, 4, height_ratios=heights, width_ratios=(1, 1, 1, 1.25))
    largest = max(float(deviation.max()), float(total.max()), 1e-9)
    top, bottom = max(float(delta.max()), 1e-9), min(float(delta.min()), 0.0)
    columns = (
        ("Δn", delta, "viridis", (bottom, top)),
        ("± by noise", deviation, "magma", (0.0, largest)),
        ("± in all", total, "magma", (0.0, largest)),
    )
    for column, (title, volume, colours, limits) in zip(axes.T, columns, strict=False):
        shown = None
        for ax, plane in zip(column, PLANES, strict=True):
            section = volume[through[0]] if plane == "xy" else volume[:, through[1]]
            spacing = [grid.spacing["zyx".index(letter)] for letter in (plane[1], plane[0])]
            shown = show(ax, section, spacing, colours, limits)
            ax.set_xlabel(plane[0], fontsize=8, labelpad=1)
            ax.set_ylabel(plane[1], fontsize=8, labelpad=1)
            scale_bar(ax, size[plane[0]], "white")
        column[0].set_title(title, fontsize=9)
        if shown is not None and (volume is delta or volume is total):
            bar = figure.colorbar(shown, ax=column, fraction=0.05, pad=0.02)
            bar.ax.tick_params(labelsize=7)
    along_x, along_z = (through[0], through[1], slice(None)), (slice(None), through[1], through[2])
    _draw_line(axes[0, 3], "x", [v[along_x] for v in (delta, deviation, total)], grid.spacing[2])
    _draw_line(axes[1, 3], "z", [v[along_z] for v in (delta, deviation, total)], grid.spacing[0])
    return figure


def _draw_line(ax: Axes, axis: str, values: Sequence[Tensor], spacing: float) -> None:
    """Δn along an axis, with bars by noise and of the whole error."""
    delta, deviation, total = (value.numpy() for value in values)
    places = (np.arange(len(delta)) - (len(delta) - 1) / 2) * spacing
    ax.fill_between(places, delta - total, delta + total, color="tab:blue", alpha=0.2, linewidth=0, label="whole error")
    ax.fill_between(
        places, delta - deviation, delta + deviation, color="tab:blue", alpha=0.45, linewidth=0, label="noise"
    )
    ax.plot(places, delta, color="tab:blue", linewidth=1)
    ax.set_xlabel(f"{axis}, µm", fontsize=8)
    ax.set_ylabel("Δn", fontsize=8)
    ax.tick_params(labelsize=7)
    ax.grid(alpha=0.3)
    if axis == "x":
        ax.legend(fontsize=7, title="± 1 standard deviation", title_fontsize=7)
