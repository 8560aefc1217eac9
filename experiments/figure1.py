"""The bead of Kagalwala & Kanade's Figure 1 at three focus planes, by the wave model and by its exact field.

    python experiments/figure1.py --out DIR

A polystyrene bead, 10 µm across, of index 1.59 in optical cement of 1.56, in DIC at 546 nm: in focus, and at two planes
out of focus. The exact field is a sum of partial waves, in which none of torchdic's propagations takes part. Its images
use the same condenser directions and the same array as the model's. The script prints the rms difference over the exact
image's standard deviation for each plane, and leaves DIR/figure1.png.
"""

import argparse
import math
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from data_synthetic import Bead
from recon.report import figures
from recon.report.terminal import write_plainly
from recon.run.exact_images import WIDENING, exact_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BEAD = Bead(radius=5.0, contrast=0.03, background=1.56)
GRID = Grid((160, 128, 128), (0.0625, 0.15, 0.15))
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7))
ACQUISITION = Acquisition([Prism((0.0, 0.24), math.pi / 2)], (0.0, 4.0, 8.0))
SOURCES = 80  # with fewer, images out of focus are speckled


def main() -> int:
    """Compute both stacks and draw them; returns the exit code."""
    write_plainly()
    parser = argparse.ArgumentParser(description="DIC images of a bead in optical cement, modelled and exact.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    out: Path = parser.parse_args().out
    modelled, exact = stacks()
    errors = (modelled - exact).square().mean((1, 2)).sqrt() / exact.std((1, 2), correction=0)
    for focus, error in zip(ACQUISITION.focus, errors.tolist(), strict=True):
        print(f"focus {focus:g} µm: the wave differs from the exact image by {error:.4f} of its standard deviation")
    return figures.leave(draw(modelled, exact, errors.tolist()), out / "figure1.png")


@torch.no_grad()
def stacks() -> tuple[Float[Tensor, "focus y x"], Float[Tensor, "focus y x"]]:
    """The images by the wave, and those from the exact field."""
    # padded as widely as the array of the exact field
    fidelity = Fidelity("wave", sources=SOURCES, padding=round(WIDENING * GRID.shape[1]))
    volume = Volume(GRID, BEAD.delta(GRID, dtype=torch.float32), BEAD.background)
    modelled = image(volume, MICROSCOPE, ACQUISITION, fidelity)
    exact = exact_images(BEAD, GRID, MICROSCOPE, ACQUISITION, fidelity)
    return modelled[0].double(), exact[0]


def draw(modelled: Float[Tensor, "focus y x"], exact: Float[Tensor, "focus y x"], errors: list[float]) -> Figure:
    """Draw a row for each focus plane: the model's image, the exact one, and their difference."""
    _, height, width = GRID.extent
    box = (-width / 2, width / 2, height / 2, -height / 2)  # row numbers grow downward
    low, high = float(exact.min()), float(exact.max())
    difference = modelled - exact
    largest = float(difference.abs().max())
    figure = Figure(figsize=(5.7, 6.0), layout="constrained")
    axes = figure.subplots(len(exact), 3, sharex=True, sharey=True)
    for row, focus, mine, true, rest, error in zip(
        axes, ACQUISITION.focus, modelled, exact, difference, errors, strict=True
    ):
        for ax, values, cmap, limits in (
            (row[0], mine, "gray", (low, high)),
            (row[1], true, "gray", (low, high)),
            (row[2], rest, "RdBu_r", (-largest, largest)),
        ):
            ax.imshow(values.numpy(), cmap=cmap, clim=limits, extent=box)
            ax.set(xticks=range(-5, 6, 5), yticks=range(-5, 6, 5))
        where = "in focus" if focus == 0 else f"{focus:g} µm behind it"
        row[0].set_ylabel(f"{where}\ny (µm)")
        row[2].text(0.03, 0.03, f"rms {error:.3f} of the\nexact image's std", transform=row[2].transAxes, fontsize=7)
    for ax, title in zip(axes[0], ("torchdic, wave", "exact field", "difference"), strict=True):
        ax.set_title(title, fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("x (µm)")
    place = {"location": "bottom", "shrink": 0.8}
    figure.colorbar(axes[0, 0].images[0], ax=axes[:, :2], label="intensity over the empty bright field's", **place)
    ticks = (-largest, 0.0, largest)
    figure.colorbar(axes[0, 2].images[0], ax=axes[:, 2], label="difference", ticks=ticks, format="%.4f", **place)
    return figure


if __name__ == "__main__":
    raise SystemExit(main())
