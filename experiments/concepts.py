"""The five pictures of docs/concepts.md: shear, bias, partial coherence, the missing cone, and why rays or the wave.

    python experiments/concepts.py --out DIR

Each function draws one picture from images that the model computes; the script leaves DIR/concepts_NAME.png, one each.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from data_synthetic import Bead, CellPhantom, GaussianBall
from recon import exact_images
from recon.report.terminal import write_plainly
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.linear import transfer_function

MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.7))
CELL, CELL_GRID = CellPhantom(), Grid((20, 72, 72), (0.4, 0.17, 0.17))


def main() -> int:
    """Draw all pictures; returns the exit code."""
    write_plainly()
    parser = argparse.ArgumentParser(description="The pictures of docs/concepts.md.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        path = out / f"concepts_{name}.png"
        draw().savefig(path, dpi=110)
        print(path)
    return 0


def shear() -> Figure:
    """The cell's optical path, and its images with two directions and with a long shear."""
    shears = {"shear 0.2 µm along x": (0.0, 0.2), "0.2 µm along y": (0.2, 0.0), "1.5 µm along x": (0.0, 1.5)}
    stack = cell_images([Prism(length, math.pi / 2) for length in shears.values()])
    figure, axes = panels(1, 4)
    path = CELL.delta(CELL_GRID).sum(0) * CELL_GRID.spacing[0]
    show(axes[0][0], path, CELL_GRID, f"optical path, up to {float(path.max()):.2f} µm", (0.0, float(path.max())))
    for axis, shown, title in zip(axes[0][1:], stack, shears, strict=True):
        show(axis, shown, CELL_GRID, title)
    return figure


def bias() -> Figure:
    """The cell at four biases, each with its background's level."""
    degrees = (0, 30, 90, -90)
    stack = cell_images([Prism((0.0, 0.2), math.radians(angle)) for angle in degrees])
    figure, axes = panels(1, 4)
    for axis, shown, angle in zip(axes[0], stack, degrees, strict=True):
        level = math.sin(math.radians(angle) / 2) ** 2
        show(axis, shown, CELL_GRID, f"bias {angle}°: background {level:.2f}", (0.0, max(0.1, 2 * level)))
    return figure


def coherence() -> Figure:
    """A bead 2 µm out of focus, as the condenser opens."""
    bead, grid = Bead(1.5, 0.03, 1.335), Grid((32, 96, 96), (0.15, 0.15, 0.15))
    acquisition = Acquisition([Prism((0.0, 0.2), math.pi / 2)], [2.0])
    figure, axes = panels(1, 4)
    for axis, na in zip(axes[0], (0.0, 0.2, 0.4, 0.7), strict=True):
        microscope = Microscope(0.546, Objective(0.9), Condenser(na))
        shown = modelled(bead, grid, microscope, acquisition, Fidelity(sources=128))[0, 0]
        show(axis, shown, grid, f"condenser NA {na:g}")
    return figure


def missing_cone() -> Figure:
    """How strongly each frequency of Δn shows, across and along z, through two condensers."""
    grid = Grid((128, 2, 128), (0.25, 0.15, 0.15))  # of the frequencies along y 0 is shown
    window = torch.hann_window(grid.shape[0], dtype=torch.float64)[:, None]  # else the volume's end would show as lines
    figure, axes = panels(1, 2, width=4.6)
    for axis, na in zip(axes[0], (0.3, 0.8), strict=True):
        microscope = Microscope(0.546, Objective(0.9), Condenser(na))
        prism, fidelity = Prism((0.0, 0.2), math.pi / 2), Fidelity(sources=1800)
        transfer = transfer_function(grid, microscope, prism, 1.335, fidelity, dtype=torch.float64)
        along = torch.fft.fftshift(torch.fft.ifft(window * transfer[:, 0], dim=0).abs())
        half_z, half_x = 1 / (2 * grid.spacing[0]), 1 / (2 * grid.spacing[2])
        logarithm = (along / along.max()).clamp_min(1e-3).log10()
        axis.imshow(logarithm, cmap="magma", aspect="auto", extent=(-half_x, half_x, half_z, -half_z))
        axis.set(title=f"condenser NA {na:g}", xlabel="frequency along x, 1/µm", xlim=(-3.3, 3.3), ylim=(-1.6, 1.6))
    axes[0][0].set_ylabel("frequency along z, 1/µm")
    figure.colorbar(axes[0][0].images[0], ax=list(axes[0]), label="transfer, log10 of its share")
    return figure


def waves() -> Figure:
    """A smooth ball and a sharp bead through three propagations, beside their exact images."""
    grid, acquisition = Grid((64, 64, 64), (0.15, 0.15, 0.15)), Acquisition([Prism((0.0, 0.2), math.pi / 2)], [2.0])
    specimens = {"smooth ball": GaussianBall(1.2, 0.05, 1.36), "sharp bead": Bead(2.0, 0.05, 1.36)}
    figure, axes = panels(2, 4)
    for row, (name, specimen) in zip(axes, specimens.items(), strict=True):
        exact = exact_images(specimen, grid, MICROSCOPE, acquisition, Fidelity(sources=32))[0, 0]
        show(row[0], exact, grid, f"{name}, exact")
        for axis, propagation in zip(row[1:], ("projection", "rays", "wave"), strict=True):
            found = modelled(specimen, grid, MICROSCOPE, acquisition, Fidelity(propagation, sources=32))[0, 0]
            error = float((found - exact).square().mean().sqrt() / exact.std(correction=0))
            show(axis, found, grid, f"{propagation}: error {error:.2g}")
    return figure


PICTURES = {"shear": shear, "bias": bias, "coherence": coherence, "cone": missing_cone, "waves": waves}


def cell_images(prisms: Sequence[Prism]) -> Float[Tensor, "prism y x"]:
    """The cell in focus."""
    return modelled(CELL, CELL_GRID, MICROSCOPE, Acquisition(prisms), Fidelity(sources=72))[:, 0]


def modelled(
    specimen: Bead | CellPhantom | GaussianBall,
    grid: Grid,
    microscope: Microscope,
    acquisition: Acquisition,
    fidelity: Fidelity,
) -> Float[Tensor, "prism focus y x"]:
    """The images of a specimen."""
    volume = Volume(grid, specimen.delta(grid, dtype=torch.float32), specimen.background)
    return image(volume, microscope, acquisition, fidelity)


def panels(rows: int, columns: int, width: float = 2.8) -> tuple[Figure, Sequence[Sequence[Axes]]]:
    """A figure of square panels."""
    figure = Figure(figsize=(width * columns, (width + 0.2) * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False).tolist()


def show(axis: Axes, shown: Tensor, grid: Grid, title: str, limits: tuple[float, float] = (0.2, 0.8)) -> None:
    """An image with its size in µm."""
    _, height, width = (length / 2 for length in grid.extent)
    axis.imshow(shown, cmap="gray", vmin=limits[0], vmax=limits[1], extent=(-width, width, height, -height))
    axis.set_title(title, fontsize=9)
    axis.tick_params(labelsize=7)


if __name__ == "__main__":
    raise SystemExit(main())
