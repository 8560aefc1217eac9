"""Pictures of a reconstruction: images beside the model's, sections through the volume, and the fall of the misfit."""

import io
import math
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends import backend_agg as _loaded_before_memory_may_be_short  # noqa: F401
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import AbstractPathEffect, withStroke
from scipy.ndimage import center_of_mass, uniform_filter
from torch import Tensor

from torchdic import Grid, Prism
from torchdic.files.whole import written_whole

DPI = 150

# Focus planes that a picture of a whole stack shows at most.
MOST_PLANES = 7

# Parts of the pixels that are darker and brighter than the scale of grey: a few hot pixels don't decide it.
OUTSIDE = 0.002

# A specimen's centre with less than this share of its largest |Δn|, both means over so many voxels along each axis, is
# hollow: sections through it would show next to nothing.
HOLLOW, AROUND = 0.3, 3

# Mean width of a letter of 8 points.
INCHES_PER_LETTER = 0.062


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG. If that fails, an earlier file stays as it was. Raises WriteError."""
    drawn = io.BytesIO()  # the encoder of PNG wouldn't tell why a file cannot be written
    figure.savefig(drawn, dpi=DPI, format="png")
    with written_whole(path) as partial:
        partial.write_bytes(drawn.getbuffer())


def leave(figure: Figure, path: Path) -> int:
    """Save a script's figure, make its folder where it is missing, and print where it is; returns the exit code."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save(figure, path)
    except OSError as error:
        print(f"{Path(sys.argv[0]).name}: error: {error}", file=sys.stderr)
        return 2
    print(path)
    return 0


def draw_images(
    measured: Float[Tensor, "prism focus y x"],
    modelled: Float[Tensor, "prism focus y x"],
    prisms: Sequence[Prism | None],
    focus: Sequence[float | Tensor],
    grid: Grid,
) -> Figure:
    """Draw measured and modelled images and their difference: a row for each prism, three focus planes at most.

    A row has one scale of grey for what was measured and modelled, the figure one for all residuals.
    measured, modelled: stacks in units of the empty bright field.
    prisms, focus: the stacks' prism settings (None is bright field) and focus planes in µm.
    grid: the volume's, whose (y, x) spacing is the pixels'.
    """
    planes = sorted({len(focus) // 4, len(focus) // 2, (3 * len(focus)) // 4})
    aspect = grid.extent[1] / grid.extent[2]
    figure = Figure(figsize=(1.9 * 3 * len(planes) + 2.6, 1.9 * aspect * len(prisms) + 0.7), layout="constrained")
    axes = figure.subplots(len(prisms), 3 * len(planes), squeeze=False)
    residual = measured - modelled
    _, largest = _limits(residual[:, planes].abs())
    for p, prism in enumerate(prisms):
        grey = ("gray", _limits(measured[p]))
        kinds = {
            "measured": (measured, *grey),
            "modelled": (modelled, *grey),
            "residual": (residual, "RdBu_r", (-largest, largest)),
        }
        for k, f in enumerate(planes):
            trio = axes[p, 3 * k : 3 * k + 3]
            for ax, (name, (stack, cmap, limits)) in zip(trio, kinds.items(), strict=True):
                show(ax, stack[p, f], grid.spacing[1:], cmap, limits)
                if p == 0:
                    ax.set_title(f"{name}\nfocus {float(focus[f]):g} µm", fontsize=8)
            scale_bar(trio[0], grid.extent[2], "white")
        _name_row(axes[p, 0], prism)
        for ax, words in ((axes[p, -2], "intensity"), (axes[p, -1], "residual")):
            bar = figure.colorbar(ax.images[0], ax=ax, pad=0.02, aspect=15)
            bar.set_label(words, fontsize=8)
            bar.ax.tick_params(labelsize=7)
    return figure


def headed(figure: Figure, words: str) -> Figure:
    """The figure with words above it, in as many lines as its width asks for, and as much higher as they need."""
    width, height = figure.get_size_inches()
    lines = textwrap.wrap(words, max(20, int(width / INCHES_PER_LETTER)))
    figure.set_size_inches(width, height + 0.16 * len(lines))
    figure.suptitle("\n".join(lines), fontsize=8)
    return figure


def draw_sections(
    volumes: Mapping[str, Float[Tensor, "z y x"]],
    grid: Grid,
    planes: Sequence[str] = ("xy", "xz", "yz"),
    through: tuple[int, int, int] | None = None,
) -> Figure:
    """Draw sections through volumes on one scale: a column for each volume, a row for each plane, its place above it.

    volumes: Δn (z, y, x) by title.
    grid: of all volumes.
    planes: of "xy", "xz" and "yz", the horizontal axis first.
    through: the voxel (z, y, x) in all sections; None is the centre of |Δn| of the first volume, or where little is
        there, as between two beads, the middle of what is strongest.
    """
    through = through or centre(next(iter(volumes.values())))
    top = max(float(v.max()) for v in volumes.values())
    bottom = min(0.0, *(float(v.min()) for v in volumes.values()))
    size = dict(zip("zyx", grid.extent, strict=True))
    heights = [size[name[1]] for name in planes]
    widest = max(size[name[0]] for name in planes)
    figure = Figure(
        figsize=(2.4 * len(volumes) + 1.2, 2.4 * sum(heights) / widest + 0.42 * len(planes) + 0.2),
        layout="constrained",
    )
    axes = figure.subplots(len(planes), len(volumes), squeeze=False, height_ratios=heights)
    shown = None
    for column, (title, volume) in zip(axes.T, volumes.items(), strict=True):
        for ax, name in zip(column, planes, strict=True):
            section = {"xy": volume[through[0]], "xz": volume[:, through[1]], "yz": volume[:, :, through[2]]}[name]
            spacing = [grid.spacing["zyx".index(letter)] for letter in (name[1], name[0])]
            shown = show(ax, section, spacing, "viridis", (bottom, top))
            ax.set_xlabel(name[0], fontsize=8, labelpad=1)
            ax.set_ylabel(name[1], fontsize=8, labelpad=1)
            ax.set_title(_place(grid, name, through), fontsize=7, loc="right", pad=2)
            scale_bar(ax, size[name[0]], "white")
        column[0].set_title(title, fontsize=9)
    assert shown is not None
    figure.colorbar(shown, ax=axes, label="Δn")
    return figure


def draw_misfit(rows: Sequence[tuple[int, float, float, float]]) -> Figure:
    """Draw the misfit over the steps on a logarithmic scale; rows: (step, misfit, loss, seconds), as in log.csv."""
    figure = Figure(figsize=(5, 3), layout="constrained")
    ax = figure.subplots()
    ax.semilogy([row[0] for row in rows], [row[1] for row in rows])
    ax.set_xlabel("step")
    ax.set_ylabel("misfit (1 = empty volume's)")
    ax.grid(alpha=0.3, which="both")
    return figure


def draw_stack(
    stack: Float[Tensor, "prism focus y x"],
    prisms: Sequence[Prism | None],
    focus: Sequence[float | Tensor],
    spacing: tuple[float, float],
) -> Figure:
    """Draw a stack: a row for each prism, with its own scale of grey; MOST_PLANES focus planes at most, evenly chosen.

    stack: in any unit.
    prisms, focus: the stack's prism settings (None is bright field) and focus planes in µm.
    spacing: distance (y, x) between pixels in µm.
    """
    planes = np.unique(np.linspace(0, len(focus) - 1, min(len(focus), MOST_PLANES)).round().astype(int))
    aspect = stack.shape[2] * spacing[0] / (stack.shape[3] * spacing[1])
    figure = Figure(figsize=(1.9 * len(planes) + 2.2, 1.9 * aspect * len(prisms) + 0.6), layout="constrained")
    axes = figure.subplots(len(prisms), len(planes), squeeze=False)
    for p, prism in enumerate(prisms):
        limits = _limits(stack[p])
        for ax, f in zip(axes[p], planes, strict=True):
            show(ax, stack[p, f], spacing, "gray", limits)
            if p == 0:
                ax.set_title(f"focus {float(focus[f]):g} µm", fontsize=8)
        bar = figure.colorbar(axes[p, 0].images[0], ax=axes[p].tolist(), pad=0.01, aspect=12)
        bar.set_label("intensity", fontsize=8)
        bar.ax.tick_params(labelsize=7)
        _name_row(axes[p, 0], prism)
        scale_bar(axes[p, 0], stack.shape[-1] * spacing[1], "white")
    return figure


def _limits(images: Tensor) -> tuple[float, float]:
    """The values between which images are shown: all but the OUTSIDE part of their pixels at either end."""
    low, high = np.quantile(images.detach().cpu().numpy(), (OUTSIDE, 1 - OUTSIDE))
    return float(low), float(high)


def show(ax: Axes, image: Tensor, spacing: Sequence[float], cmap: str, limits: tuple[float, float]):
    """Show an image (row, column) whose pixels have a spacing in µm, without ticks."""
    ny, nx = image.shape
    shown = ax.imshow(
        image.detach().cpu().numpy(),
        cmap=cmap,
        vmin=limits[0],
        vmax=limits[1],
        extent=(0, nx * spacing[1], ny * spacing[0], 0),
        interpolation="nearest",
    )
    ax.set_xticks([])
    ax.set_yticks([])
    return shown


def scale_bar(ax: Axes, width: float, colour: str) -> None:
    """Add a bar of 1, 2 or 5 times a power of ten in µm, at most a quarter of the picture's width (µm) long."""
    power = 10.0 ** np.floor(np.log10(width / 4))
    length = max(m * power for m in (1, 2, 5) if m * power <= width / 4)
    bottom, top = ax.get_ylim()
    height = abs(bottom - top)
    # to be seen on any colour
    around: list[AbstractPathEffect] = [withStroke(linewidth=1, foreground="black" if colour == "white" else "white")]
    bar = Rectangle((0.05 * width, bottom - 0.07 * height), length, 0.02 * height, color=colour, linewidth=0)
    bar.set_path_effects(around)
    ax.add_patch(bar)
    ax.text(
        0.05 * width,
        bottom - 0.09 * height,
        f"{length:g} µm",
        color=colour,
        fontsize=7,
        ha="left",
        va="bottom",
        path_effects=around,
    )


def _place(grid: Grid, plane: str, through: tuple[int, int, int]) -> str:
    """Where a section lies along the axis across it, in µm from the volume's centre. plane: such as "xy"."""
    axis = next(i for i, letter in enumerate("zyx") if letter not in plane)
    place = (through[axis] - (grid.shape[axis] - 1) / 2) * grid.spacing[axis]
    return f"{'zyx'[axis]} = {place:.3g} µm".replace("-", "−")


def centre(volume: Tensor) -> tuple[int, int, int]:
    """The voxel (z, y, x) at the |Δn|-weighted mean place; the middle one of an empty volume.

    Where |Δn| there is below HOLLOW of the largest, it is the voxel whose surroundings have the largest mean.
    """
    weight = volume.detach().abs().cpu().numpy()
    if not weight.any():
        nz, ny, nx = volume.shape
        return nz // 2, ny // 2, nx // 2
    places = [round(float(place)) for place in np.array(center_of_mass(weight))]
    around = uniform_filter(weight, AROUND)
    if around[tuple(places)] < HOLLOW * around.max():
        places = [int(index) for index in np.unravel_index(int(around.argmax()), around.shape)]
    return places[0], places[1], places[2]


def _name_row(ax: Axes, prism: Prism | None) -> None:
    """Name a prism setting to the left of its images: the shear's length and its angle from right to down, the bias."""
    words = "bright field"
    if prism is not None:
        y, x = (float(part) for part in prism.shear)
        angle, bias = math.degrees(math.atan2(y, x)), math.degrees(float(prism.bias))
        words = f"shear {math.hypot(y, x):.3g} µm\nat {angle:.3g}°\nbias {bias:.3g}°".replace("-", "−")
    ax.set_ylabel(words, fontsize=8, rotation="horizontal", ha="right", va="center")
