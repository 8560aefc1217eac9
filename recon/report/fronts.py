"""Trials of work and precision as CSV, for JSON, as a table, and their Pareto fronts as a figure."""

import csv
import itertools
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Bbox

from torchdic import Fidelity, Trial
from torchdic.files.whole import written_whole
from torchdic.planning.work_precision import pareto_front


class Mark(NamedTuple):
    """How the points of a propagation look."""

    colour: str
    marker: str


class Point(NamedTuple):
    """A cost and an error, both above 0, with their name and how they look."""

    cost: float
    error: float
    name: str
    mark: Mark


# The marks of the docs' figures.
MARKS = {"projection": Mark("tab:blue", "s"), "rays": Mark("tab:orange", "^"), "wave": Mark("tab:green", "o")}

# The marks of any other propagation, in the order in which they appear.
FURTHER_MARKS = (
    Mark("tab:red", "D"),
    Mark("tab:purple", "v"),
    Mark("tab:brown", "P"),
    Mark("tab:pink", "<"),
    Mark("tab:olive", ">"),
    Mark("tab:cyan", "h"),
)

# Opacity of a candidate that another one beats.
PALE = 0.45

# Smaller errors are drawn as this one, because a logarithmic axis has no 0: the converged answer's own error is 0.
LEAST_ERROR = 1e-7

# Where a label may stand: its distance from its point in points of print, the nearest places first.
LABEL_HEIGHTS = (4, -9, 12, -17, 20, -25, 28, -33, 36, -41)
LABEL_SIDES: list[tuple[float, Literal["left", "right", "center"]]] = [(5, "left"), (-5, "right"), (0, "center")]
LABEL_PLACES: list[tuple[float, float, Literal["left", "right", "center"]]] = [
    (dx, dy, align) for dy in LABEL_HEIGHTS for dx, align in LABEL_SIDES
]

# The fields of a trial that are measured numbers.
NUMBERS = [field.name for field in fields(Trial) if field.name not in ("name", "candidate", "failure")]


def write_csv(path: Path, trials: Sequence[Trial]) -> None:
    """Write a row for each trial: its name, its options, what was measured; a number that is missing leaves a gap."""
    options = [field.name for field in fields(Fidelity)]
    with written_whole(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["name", *options, "dtype", *NUMBERS, "failure"])
        writer.writeheader()
        for trial in trials:
            how = {name: getattr(trial.candidate.fidelity, name) for name in options}
            found = {name: getattr(trial, name) for name in (*NUMBERS, "failure")}
            writer.writerow({"name": trial.name, **how, "dtype": trial.candidate.dtype, **found})


def as_dict(trials: Sequence[Trial], reference: Mapping[str, Fidelity]) -> dict[str, Any]:
    """The trials as values that JSON can hold, with the machine on which they ran.

    trials: written with all their options.
    reference: for each propagation, by name, the fidelity whose result counts as converged.
    """
    return {
        "torch": torch.__version__,
        "threads": torch.get_num_threads(),
        "machine": platform.machine(),
        "reference": {propagation: asdict(fidelity) for propagation, fidelity in reference.items()},
        "trials": [asdict(trial) for trial in trials],
    }


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
        seconds = [two_digits(s) for s in (t.seconds, t.gradient_seconds)]
        mebibytes = [two_digits(None if b is None else b / 2**20) for b in (t.peak_bytes, t.gradient_peak_bytes)]
        errors = (t.numerical_error, t.model_error, t.numerical_gradient_error, t.model_gradient_error)
        lines.append(f"| {' | '.join((t.name, *seconds, *mebibytes, *map(two_digits, errors)))} |")
    return "\n".join(lines)


def two_digits(value: float | None) -> str:
    """A number of a table in two digits; a gap where it isn't known."""
    return "" if value is None else f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def draw_fronts(scenes: Mapping[str, Sequence[Trial]], quantities: Sequence[str] = ("image", "gradient")) -> Figure:
    """Draw error against seconds, both logarithmic, with the Pareto front of each panel as a line.

    scenes: the trials of each scene, by its name.
    quantities: whose errors to draw, "image" or "gradient"; each scene has a row of panels for each of them.
    The left column has the numerical error and the right one the model's. The points on a front carry their names.
    Candidates that another one beats are pale, and those in float64 are crosses.
    """
    rows = [(scene, quantity) for scene in scenes for quantity in quantities]
    figure = Figure(figsize=(10, 0.4 + 3.1 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)  # the size of a text is known only on a canvas
    grid = figure.subplots(len(rows), 2, squeeze=False, sharex="row", sharey="row")
    marks = marks_of(t.candidate.fidelity.propagation for trials in scenes.values() for t in trials)
    for (scene, quantity), axes in zip(rows, grid, strict=True):
        _draw_row(list(axes), scene, scenes[scene], quantity, marks)
    return laid_out(figure, _legend_handles(grid[0, 0], marks))


def laid_out(figure: Figure, handles: Sequence[Artist]) -> Figure:
    """A figure of fronts with its legend above and its labels apart. handles: of the legend."""
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), fontsize=8, frameon=False)
    figure.draw_without_rendering()  # lays the axes out
    figure.set_layout_engine("none")
    for axes in figure.axes:
        _keep_labels_apart(axes)
    return figure


def marks_of(propagations: Iterable[str]) -> dict[str, Mark]:
    """The mark of each propagation that occurs: those of MARKS first, then the others in order of appearance."""
    seen = dict.fromkeys(propagations)
    known = {name: mark for name, mark in MARKS.items() if name in seen}
    others = (name for name in seen if name not in MARKS)
    return known | dict(zip(others, itertools.cycle(FURTHER_MARKS), strict=False))


def _draw_row(axes: Sequence[Axes], scene: str, trials: Sequence[Trial], quantity: str, marks: dict[str, Mark]) -> None:
    """Draw a scene's numerical and model errors of one quantity, side by side."""
    of_gradient = quantity == "gradient"
    for ax, kind in zip(axes, ("numerical", "model"), strict=True):
        error = f"{kind}_gradient_error" if of_gradient else f"{kind}_error"
        _draw_panel(ax, trials, "gradient_seconds" if of_gradient else "seconds", error, marks)
        ax.set_title(f"{scene}: {kind} error of the {quantity}", fontsize=9)
        ax.set_xlabel("seconds, images and gradient" if of_gradient else "seconds, images", fontsize=8)
    axes[0].set_ylabel("error (relative L2)" if of_gradient else "error (rms / contrast)", fontsize=8)


def _draw_panel(ax: Axes, trials: Sequence[Trial], cost: str, error: str, marks: dict[str, Mark]) -> None:
    """Draw one error of the trials against one cost, both named by the fields of Trial."""
    points = []
    for trial in trials:
        x, y = getattr(trial, cost), getattr(trial, error)
        if x is None or y is None:
            continue
        mark = marks[trial.candidate.fidelity.propagation]
        if trial.candidate.dtype == "float64":
            mark = mark._replace(marker="x")
        points.append(Point(x, max(LEAST_ERROR, y), trial.name, mark))
    draw_points(ax, points)


def draw_points(ax: Axes, points: Sequence[Point]) -> None:
    """Draw errors against costs, both logarithmic: those on the Pareto front with their names, the others pale."""
    front = pareto_front([p.cost for p in points], [p.error for p in points])
    ax.plot([points[i].cost for i in front], [points[i].error for i in front], color="0.6", linewidth=1, zorder=1)
    for i, point in enumerate(points):
        ax.plot(
            point.cost,
            point.error,
            point.mark.marker,
            color=point.mark.colour,
            markersize=6 if i in front else 4,
            alpha=1 if i in front else PALE,
        )
        if i in front:
            _label(ax, point.name, (point.cost, point.error))
    _scale_logarithmically(ax)


def _label(ax: Axes, name: str, point: tuple[float, float]) -> None:
    ax.annotate(
        name,
        point,
        (5, 4),
        textcoords="offset points",
        fontsize=6.5,
        arrowprops={"arrowstyle": "-", "color": "0.5", "linewidth": 0.5, "shrinkA": 0, "shrinkB": 3},
    )


def _scale_logarithmically(ax: Axes) -> None:
    ax.set_xscale("log")
    ax.set_yscale("log")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_locator(LogLocator(subs=(2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
    ax.margins(x=0.22, y=0.12)
    ax.tick_params(which="both", labelsize=7)
    ax.grid(alpha=0.25)


def _legend_handles(ax: Axes, marks: dict[str, Mark]) -> list[Artist]:
    """Empty curves that show in the legend what each mark means."""
    handles: list[Artist] = []
    for name, mark in marks.items():
        handles += ax.plot([], [], mark.marker, color=mark.colour, label=name)
    handles += ax.plot([], [], "x", color="0.3", label="float64")
    handles += ax.plot([], [], "o", color="0.3", alpha=PALE, markersize=4, label="beaten by another")
    handles += ax.plot([], [], color="0.6", linewidth=1, label="Pareto front")
    return handles


def _keep_labels_apart(ax: Axes) -> None:
    """Move each label to the first of LABEL_PLACES where it hides no other label, no point and no edge."""
    renderer = ax.figure.canvas.get_renderer()  # pyright: ignore[reportAttributeAccessIssue]
    frame = ax.get_window_extent(renderer)
    lines = [np.asarray(line.get_xydata()) for line in ax.lines]
    points = [ax.transData.transform(line[0]) for line in lines if len(line) == 1]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in points]
    for label in sorted(ax.texts, key=lambda text: text.xy[0]):  # pyright: ignore[reportAttributeAccessIssue]
        for dx, dy, align in LABEL_PLACES:
            label.set_horizontalalignment(align)
            label.set_position((dx, dy))
            box = Text.get_window_extent(label, renderer)  # without the line from the label to its point
            inside = frame.x0 < box.x0 and box.x1 < frame.x1 and frame.y0 < box.y0 and box.y1 < frame.y1
            if inside and not any(box.overlaps(other) for other in taken):
                break
        taken.append(Text.get_window_extent(label, renderer))
