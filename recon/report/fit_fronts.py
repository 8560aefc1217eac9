"""Trials of fits as CSV, as a table, and their Pareto fronts as a figure."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from recon.report.fit_trial import FitCandidate, FitTrial
from recon.report.fronts import FURTHER_MARKS, LEAST_ERROR, MARKS, Mark, Point, draw_points, laid_out, two_digits
from torchdic.files.whole import written_whole

# What is drawn against seconds and bytes, the first that is known: its name in FitTrial, and its words.
ERRORS = {
    "volume_error": "error of Δn (relative L2)",
    "whole_over_noise": "misfit of all planes over noise",
    "whole_misfit": "misfit of all planes",
    "misfit": "misfit of the fitted planes",
}
NUMBERS = [field.name for field in fields(FitTrial) if field.name not in ("candidate", "failure")]


def write_fits(path: Path, trials: Sequence[FitTrial]) -> None:
    """Write a row for each trial; a number that isn't known leaves a gap."""
    how = [field.name for field in fields(FitCandidate)]
    names = ["over_noise", "whole_over_noise", *NUMBERS, "failure"]
    with written_whole(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*how, *names])
        writer.writeheader()
        for trial in trials:
            given = {name: getattr(trial.candidate, name) for name in how}
            writer.writerow({**given, **{name: getattr(trial, name) for name in names}})


def fits_table(trials: Sequence[FitTrial]) -> str:
    """The trials as a Markdown table. A misfit in brackets is not over the noise, which isn't known or isn't there."""
    lines = [
        "| method | images | directions | planes | error | mass | misfit/noise | all planes | tv | steps | s | MiB |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for t in trials:
        c = t.candidate
        how = (c.method, c.propagation or "–", "–" if c.directions is None else str(c.directions), str(c.planes))
        if t.failure is not None:
            lines.append(f"| {' | '.join(how)} | {t.failure} |" + " |" * 7)
            continue
        numbers = (
            _fixed(t.volume_error, 3),
            _fixed(t.mass, 2),
            _misfit(t.over_noise, t.misfit),
            _misfit(t.whole_over_noise, t.whole_misfit),
            "" if t.weight is None else f"{t.weight:.3g}",
            "" if t.steps is None else str(t.steps),
            two_digits(t.seconds),
            two_digits(None if t.peak_bytes is None else t.peak_bytes / 2**20),
        )
        lines.append(f"| {' | '.join((*how, *numbers))} |")
    return "\n".join(lines)


def _fixed(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _misfit(over_noise: float | None, misfit: float | None) -> str:
    if over_noise is not None:
        return f"{over_noise:.3f}"
    return "" if misfit is None else f"({misfit:.3g})"


def draw_fits(scenes: Mapping[str, Sequence[FitTrial]]) -> Figure:
    """Draw the error against seconds and against bytes, a row of panels for each scene, with their Pareto fronts.

    scenes: the trials of each scene, by its name. The error is the first of ERRORS that all of a scene's fits have.
    """
    figure = Figure(figsize=(10, 0.4 + 3.6 * len(scenes)), layout="constrained")
    FigureCanvasAgg(figure)  # the size of a text is known only on a canvas
    grid = figure.subplots(len(scenes), 2, squeeze=False, sharey="row")
    marks = fit_marks([t for trials in scenes.values() for t in trials])
    for (scene, trials), axes in zip(scenes.items(), grid, strict=True):
        done = [t for t in trials if t.failure is None]
        known = (name for name in ERRORS if all(getattr(t, name) is not None for t in done))
        error = next(known)
        for ax, cost, words in zip(axes, ("seconds", "peak_bytes"), ("seconds", "MiB"), strict=True):
            unit = 2**20 if cost == "peak_bytes" else 1
            points = [
                Point(getattr(t, cost) / unit, max(LEAST_ERROR, getattr(t, error)), t.candidate.label, _of(t, marks))
                for t in done
            ]
            draw_points(ax, points)
            ax.set_title(scene, fontsize=9)
            ax.set_xlabel(words, fontsize=8)
        axes[0].set_ylabel(ERRORS[error], fontsize=8)
    handles = [grid[0, 0].plot([], [], m.marker, color=m.colour, label=name)[0] for name, m in marks.items()]
    handles += grid[0, 0].plot([], [], color="0.6", linewidth=1, label="Pareto front")
    return laid_out(figure, handles)


def fit_marks(trials: Sequence[FitTrial]) -> dict[str, Mark]:
    """The mark of each method, and of each of its propagations, that occurs."""
    names = dict.fromkeys(_kind(t.candidate) for t in trials)
    return dict(zip(names, (*MARKS.values(), *FURTHER_MARKS), strict=False))


def _kind(candidate: FitCandidate) -> str:
    return " ".join(part for part in (candidate.method, candidate.propagation) if part)


def _of(trial: FitTrial, marks: Mapping[str, Mark]) -> Mark:
    return marks[_kind(trial.candidate)]
