"""Trials of work and precision as CSV, for JSON, as a table, and their fronts as a figure."""

import csv
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Bbox

from torchdic import Fidelity, Trial
from torchdic.files.whole import written_whole
from torchdic.planning.work_precision import pareto_front

COLOURS = {"projection": "tab:blue", "rays": "tab:orange", "wave": "tab:green"}

MARKERS = {"projection": "s", "rays": "^", "wave": "o"}

# Opacity of a candidate that another one beats.
PALE = 0.45

# Errors below this, those of the converged answer itself among them, are drawn here.
LEAST = 1e-7

# Places of a label in points from its point, near ones first.
HEIGHTS = (4, -9, 12, -17, 20, -25, 28, -33, 36, -41)

SIDES: list[tuple[float, Literal["left", "right", "center"]]] = [(5, "left"), (-5, "right"), (0, "center")]

PLACES: list[tuple[float, float, Literal["left", "right", "center"]]] = [
    (dx, dy, align) for dy in HEIGHTS for dx, align in SIDES
]

NUMBERS = [field.name for field in fields(Trial) if field.name not in ("name", "candidate", "failure")]


def write_csv(path: Path, trials: Sequence[Trial]) -> None:
    """A row for each trial: what it computed and how, costs and errors; empty where there is none."""
    options = [field.name for field in fields(Fidelity)]
    with written_whole(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["name", *options, "dtype", *NUMBERS, "failure"])
        writer.writeheader()
        for trial in trials:
            how = {name: getattr(trial.candidate.fidelity, name) for name in options}
            found = {name: getattr(trial, name) for name in (*NUMBERS, "failure")}
            writer.writerow({"name": trial.name, **how, "dtype": trial.candidate.dtype, **found})


def as_dict(trials: Sequence[Trial], reference: Mapping[str, Fidelity]) -> dict[str, Any]:
    """What JSON can hold: the trials with all options, each propagation's reference, and where they ran."""
    return {
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "machine": platform.machine(),
        "reference": {propagation: asdict(fidelity) for propagation, fidelity in reference.items()},
        "trials": [asdict(trial) for trial in trials],
    }


def draw_fronts(scenes: Mapping[str, Sequence[Trial]], quantities: Sequence[str] = ("image", "gradient")) -> Figure:
    """Error against seconds, log-log: a row for each scene and quantity, columns for numerical and model error.

    The Pareto front is a line, and its points carry their names; candidates that another one beats are pale, those in
    float64 crosses.
    """
    rows = [(scene, quantity) for scene in scenes for quantity in quantities]
    figure = Figure(figsize=(10, 0.4 + 3.1 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)  # text has no size before it has a canvas
    grid = figure.subplots(len(rows), 2, squeeze=False, sharex="row", sharey="row")
    for (scene, quantity), axes in zip(rows, grid, strict=True):
        of_gradient = quantity == "gradient"
        for ax, kind in zip(axes, ("numerical", "model"), strict=True):
            error = f"{kind}_gradient_error" if of_gradient else f"{kind}_error"
            _draw_panel(ax, scenes[scene], "gradient_seconds" if of_gradient else "seconds", error)
            ax.set_title(f"{scene}: {kind} error of the {quantity}", fontsize=9)
            ax.set_xlabel("seconds, images and gradient" if of_gradient else "seconds, images", fontsize=8)
        axes[0].set_ylabel("error (relative L2)" if of_gradient else "error (rms / contrast)", fontsize=8)
    shown = {trial.candidate.fidelity.propagation for trials in scenes.values() for trial in trials}
    plot = grid[0, 0].plot
    handles = [plot([], [], MARKERS[name], color=COLOURS[name], label=name)[0] for name in COLOURS if name in shown]
    handles += plot([], [], "x", color="0.3", label="float64")
    handles += plot([], [], "o", color="0.3", alpha=PALE, markersize=4, label="beaten by another")
    handles += plot([], [], color="0.6", linewidth=1, label="Pareto front")
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8, frameon=False)
    figure.draw_without_rendering()  # lays the axes out
    figure.set_layout_engine("none")
    for axes in grid.flat:
        _keep_apart(axes)
    return figure


def _draw_panel(ax: Axes, trials: Sequence[Trial], cost: str, error: str) -> None:
    known = [trial for trial in trials if getattr(trial, cost) is not None and getattr(trial, error) is not None]
    costs = [getattr(trial, cost) for trial in known]
    errors = [max(LEAST, getattr(trial, error)) for trial in known]
    front = pareto_front(costs, errors)
    ax.plot([costs[i] for i in front], [errors[i] for i in front], color="0.6", linewidth=1, zorder=1)
    for i, trial in enumerate(known):
        propagation = trial.candidate.fidelity.propagation
        double = trial.candidate.dtype == "float64"
        ax.plot(
            costs[i],
            errors[i],
            "x" if double else MARKERS[propagation],
            color=COLOURS[propagation],
            markersize=6 if i in front else 4,
            alpha=1 if i in front else PALE,
        )
        if i in front:
            ax.annotate(
                trial.name,
                (costs[i], errors[i]),
                (5, 4),
                textcoords="offset points",
                fontsize=6.5,
                arrowprops={"arrowstyle": "-", "color": "0.5", "linewidth": 0.5, "shrinkA": 0, "shrinkB": 3},
            )
    ax.set_xscale("log")
    ax.set_yscale("log")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    ax.margins(x=0.22, y=0.12)
    ax.tick_params(which="both", labelsize=7)
    ax.grid(alpha=0.25)


def _keep_apart(ax: Axes) -> None:
    """Move each label to the first place beside its point where it hides no other label, no point and no edge."""
    renderer = ax.figure.canvas.get_renderer()  # pyright: ignore[reportAttributeAccessIssue]
    frame = ax.get_window_extent(renderer)
    lines = [np.asarray(line.get_xydata()) for line in ax.lines]
    points = [ax.transData.transform(line[0]) for line in lines if len(line) == 1]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in points]
    for label in sorted(ax.texts, key=lambda text: text.xy[0]):  # pyright: ignore[reportAttributeAccessIssue]
        for dx, dy, align in PLACES:
            label.set_horizontalalignment(align)
            label.set_position((dx, dy))
            box = Text.get_window_extent(label, renderer)  # without its line to the point
            inside = frame.x0 < box.x0 and box.x1 < frame.x1 and frame.y0 < box.y0 and box.y1 < frame.y1
            if inside and not any(box.overlaps(other) for other in taken):
                break
        taken.append(Text.get_window_extent(label, renderer))


def as_table(trials: Sequence[Trial]) -> str:
    """The trials as a Markdown table."""
    lines = [
        "| candidate | s | s, gradient | MiB | MiB, gradient | numerical | model | gradient: numerical | model |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for t in trials:
        if t.failure is not None:
            lines.append(f"| {t.name} | {t.failure} |" + " |" * 7)
            continue
        seconds = [_digits(s) for s in (t.seconds, t.gradient_seconds)]
        mebibytes = [_digits(None if b is None else b / 2**20) for b in (t.peak_bytes, t.gradient_peak_bytes)]
        errors = (t.numerical_error, t.model_error, t.numerical_gradient_error, t.model_gradient_error)
        lines.append(f"| {' | '.join((t.name, *seconds, *mebibytes, *map(_digits, errors)))} |")
    return "\n".join(lines)


def _digits(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}" if value < 99.5 else f"{value:.0f}"
