"""The picture that `torchdic phase` leaves."""

import numpy as np
from jaxtyping import Float, Real
from matplotlib.figure import Figure

from recon.recording.survey.direction import ShearDirection
from recon.report.figures import scale_bar


def draw_phase(
    image: Real[np.ndarray, "y x"],
    flattened: Float[np.ndarray, "y x"],
    phase: Float[np.ndarray, "y x"],
    direction: ShearDirection,
    pixel_size: tuple[float, float] | None,
) -> Figure:
    """Draw an image as recorded, with a flat background and the shear's axis, and its phase.

    pixel_size: (y, x) in µm; None draws no scale bar, since nobody knows the scale.
    """
    figure = Figure(figsize=(13, 3.9), layout="constrained")
    axes, (ny, nx) = figure.subplots(1, 3), image.shape
    dy, dx = pixel_size or (1.0, 1.0)
    for ax, values, title, colours in (
        (axes[0], image, "as recorded", "gray"),
        (axes[1], flattened, "background flattened", "gray"),
        (axes[2], phase, "phase, arbitrary scale and sign", "viridis"),
    ):
        shown = ax.imshow(values, cmap=colours, extent=(0, nx * dx, ny * dy, 0), interpolation="nearest")
        ax.set(xticks=[], yticks=[])
        ax.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=axes[2], label="arbitrary unit", ticks=[])
    if pixel_size is not None:
        scale_bar(axes[0], nx * dx, "white")
    y, x = (0.06 * nx * dx * part for part in direction.vector)
    place = (0.12 * nx * dx, 0.15 * ny * dy)
    arrow = {"arrowstyle": "<->", "color": "tab:orange", "lw": 2}
    axes[1].annotate("", (place[0] + x, place[1] + y), (place[0] - x, place[1] - y), arrowprops=arrow)
    axes[1].text(0.22 * nx * dx, 0.12 * ny * dy, "shear axis", color="tab:orange", fontsize=9)
    return figure
