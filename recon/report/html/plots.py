"""Curves of a report as SVG that takes the page's colours and letters, light or dark."""

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

# What stands for the page's own colour of letters and lines until the drawing is on the page.
_INK = "#010203"

# Okabe and Ito's colours, which the colour-blind tell apart, and dashes that tell them without colour.
LINES = (("#0072b2", "-"), ("#d55e00", "--"), ("#009e73", "-."), ("#cc79a7", ":"), ("#e69f00", "-"), ("#56b4e9", "--"))

# Frequencies in 1/µm, and the power at each.
Spectrum = tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]

# Rings of frequencies over which a spectrum is averaged.
RINGS = 32


def draw_course(rows: Sequence[Sequence[float]], noise: float | None) -> str:
    """The misfit over the steps. rows: of log.csv: step, misfit, … noise: the misfit that noise leaves."""
    figure, ax = _axes("step", "misfit (an empty volume has 1)")
    ax.plot([row[0] for row in rows], [row[1] for row in rows], color=LINES[0][0], label="misfit")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if noise:
        ax.axhline(noise, color=_INK, linewidth=1, linestyle="--", label="what noise leaves")
        _legend(ax)
    return as_svg(figure, "course")


def draw_spectrum(spectra: Sequence[tuple[str, np.ndarray, np.ndarray]], limit: float | None, unit: str) -> str:
    """The residual's power over spatial frequency, a line for each prism setting: name, frequencies, power.

    limit: the highest frequency that passes the apertures, 1/µm. unit: of the power.
    """
    figure, ax = _axes("spatial frequency (1/µm)", unit)
    for number, (name, frequency, power) in enumerate(spectra):
        colour, dash = LINES[number % len(LINES)]
        ax.plot(frequency, power, color=colour, linestyle=dash, linewidth=1.5, label=name)
    ax.axhline(1, color=_INK, linewidth=0.8)
    if limit is not None and limit < ax.get_xlim()[1]:
        ax.axvline(limit, color=_INK, linewidth=0.8, linestyle=":", label="highest that passes the apertures")
    _legend(ax)
    return as_svg(figure, "spectrum")


def spectrum(images: Float[np.ndarray, "focus y x"], pixel: tuple[float, float]) -> Spectrum:
    """The mean power of images, each less its mean, over rings of frequency (1/µm); white noise of variance v has v.

    pixel: its size (y, x) in µm.
    """
    height, width = images.shape[1:]
    power = np.zeros((height, width))
    for image in images:
        power += np.abs(np.fft.fft2(image - image.mean())) ** 2
    power /= len(images) * height * width
    y, x = np.fft.fftfreq(height, pixel[0]), np.fft.fftfreq(width, pixel[1])
    radius = np.hypot(y[:, None], x)
    highest = min(np.abs(y).max(), np.abs(x).max())
    ring = np.minimum((radius / highest * RINGS).astype(int), RINGS)
    ring[0, 0] = RINGS  # the mean has been taken out
    counts, sums, places = (
        np.bincount(ring.ravel(), w, RINGS + 1)[:RINGS] for w in (None, power.ravel(), radius.ravel())
    )
    some = counts > 0
    return places[some] / counts[some], sums[some] / counts[some]


def as_svg(figure: Figure, name: str) -> str:
    """A figure as an element of the page. name: which its ids begin with, so that no two on the page are alike."""
    drawn = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(drawn, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = drawn.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\b(id="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    return svg.replace(_INK, "currentColor").replace("<svg ", '<svg aria-hidden="true" ', 1)


def _axes(across: str, up: str) -> tuple[Figure, Any]:
    """A small figure whose frame has the page's ink."""
    figure = Figure(figsize=(5.2, 3.0), layout="constrained")
    ax = figure.subplots()
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(across, color=_INK)
    ax.set_ylabel(up, color=_INK)
    ax.tick_params(which="both", colors=_INK)
    for side, spine in ax.spines.items():
        spine.set_color(_INK)
        spine.set_visible(side in ("left", "bottom"))
    return figure, ax


def _legend(ax: Axes) -> None:
    ax.legend(frameon=False, fontsize=8, labelcolor=_INK)
