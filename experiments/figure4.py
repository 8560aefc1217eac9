"""How a specimen distorts its own planes of focus: Figure 4 of Kagalwala & Kanade.

    python experiments/figure4.py --out DIR

Two objects, 10 µm × 3 µm and uniform along y, are lit along z. One has a depression on the side of the lens. Light
travels up the page, to the lens. Every object point sends a cone of rays, as wide as the condenser's aperture, through
the part of the object above it. The mean curvature of its wave at the lens gives the point's effective defocus δ
(torchdic.object_aberration). For a focus z_f the points along the line z + δ = z_f are sharp, not those of the plane
z = z_f. The script leaves DIR/figure4.png.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from torch import Tensor

from recon.report import figures
from recon.report.terminal import write_plainly
from torchdic import Grid, Volume
from torchdic.object_aberration.wavefront import effective_defocus

BACKGROUND = 1.33
CONTRAST = 0.08
SEMI_AXES = (1.5, 5.0)  # (z, x) in µm
EDGE = 0.25  # µm, half of the width over which the index rises
DENT = ((1.9, 1.2), (1.3, 2.0))  # centre and semi-axes (z, x) in µm
CONDENSER_NA = 0.5
GRID = Grid((46, 1, 130), (0.1, 0.1, 0.1))
PLANES = (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0)  # nominal planes of focus in µm
LIMIT = 0.4  # µm, where the colours of δ end


def main() -> int:
    """Compute both maps and draw them; returns the exit code."""
    write_plainly()
    parser = argparse.ArgumentParser(description="Index, aberration and distorted planes of focus of two objects.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    out: Path = parser.parse_args().out
    objects = {"convex": dented(None), "with a depression": dented(DENT)}
    maps = {name: aberration_map(delta) for name, delta in objects.items()}
    for name, defocus in maps.items():
        print(f"{name}: δ from {float(defocus.min()):+.2f} to {float(defocus.max()):+.2f} µm")
    return figures.leave(draw(objects, maps), out / "figure4.png")


def dented(dent: tuple[tuple[float, float], tuple[float, float]] | None) -> Float[Tensor, "z x"]:
    """Δn of the object: nearly rectangular, with smooth edges, without an ellipse on the side of the lens."""
    delta = CONTRAST * _covered((0.0, 0.0), SEMI_AXES, exponent=3.0)
    return delta if dent is None else delta * (1 - _covered(*dent, exponent=2.0))


def _covered(centre: tuple[float, float], semi_axes: tuple[float, float], exponent: float) -> Float[Tensor, "z x"]:
    """½(1 + tanh(depth/EDGE)), the depth being that below |z/a_z|^e + |x/a_x|^e = 1 to first order, f/|∇f|."""
    z, x = (GRID.coordinates(axis, dtype=torch.float64) for axis in (0, 2))
    ratio = torch.stack(
        torch.meshgrid((z - centre[0]).abs() / semi_axes[0], (x - centre[1]).abs() / semi_axes[1], indexing="ij")
    )
    level = ratio.pow(exponent).sum(0).pow(1 / exponent).clamp_min(1e-6)
    lengths = torch.tensor(semi_axes, dtype=torch.float64)[:, None, None]
    slope = ((ratio / level).pow(exponent - 1) / lengths).square().sum(0).sqrt()
    return (1 + ((1 - level) / slope / EDGE).tanh()) / 2


def aberration_map(delta: Float[Tensor, "z x"]) -> Float[Tensor, "z x"]:
    """The effective defocus in µm of the object point at each voxel's centre."""
    volume = Volume(GRID, delta[:, None], BACKGROUND)
    half_angle = math.asin(CONDENSER_NA / BACKGROUND)
    depths = GRID.coordinates(0, dtype=torch.float64).tolist()
    rows = [effective_defocus(volume, z, method="cone", half_angle=half_angle)[0] for z in depths]
    return torch.stack(rows)


def draw(objects: dict[str, Tensor], maps: dict[str, Tensor]) -> Figure:
    """Draw a row for each object: its index, its aberration and its planes of focus."""
    height, _, width = GRID.extent
    box = (-width / 2, width / 2, -height / 2, height / 2)
    levels = ListedColormap(colormaps["plasma"](np.linspace(0, 0.85, len(PLANES))))
    figure = Figure(figsize=(14, 5), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    for row, (name, delta) in zip(axes, objects.items(), strict=True):
        for ax, values, cmap, limits in (
            (row[0], BACKGROUND + delta, "viridis", (BACKGROUND, BACKGROUND + CONTRAST)),
            (row[1], maps[name], "RdBu_r", (-LIMIT, LIMIT)),
        ):
            ax.imshow(values.numpy(), cmap=cmap, clim=limits, origin="lower", extent=box, interpolation="bilinear")
        _draw_planes(row[2], maps[name], levels)
        for ax in row:
            _outline(ax, delta, "white" if ax is row[0] else "0.3")
            ax.set(aspect="equal", xticks=range(-6, 7, 2), yticks=range(-2, 3), xlim=box[:2], ylim=box[2:])
        row[0].set_ylabel(f"{name}\nz (µm)")
    titles = ("refractive index", "effective defocus of object points", "planes of focus: solid sharp, dashed nominal")
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=11)
    for ax in axes[1]:
        ax.set_xlabel("x (µm)")
    arrow = {"arrowstyle": "->", "color": "white"}
    axes[0, 0].annotate("", (-6.1, 1.9), (-6.1, -1.9), arrowprops=arrow)
    axes[0, 0].text(-5.9, -1.9, "light, to the lens", color="white", rotation=90, ha="left", va="bottom", fontsize=8)
    place = {"location": "bottom", "shrink": 0.75, "aspect": 30}
    figure.colorbar(axes[0, 0].images[0], ax=axes[:, 0], label="n", **place)
    bar = figure.colorbar(axes[0, 1].images[0], ax=axes[:, 1], extend="both", **place)
    bar.set_label("δ (µm); above 0: seems nearer to the lens")
    edges = np.append(PLANES, 2 * PLANES[-1] - PLANES[-2]) - (PLANES[1] - PLANES[0]) / 2
    planes = ScalarMappable(BoundaryNorm(edges, levels.N), levels)
    figure.colorbar(planes, ax=axes[:, 2], ticks=PLANES, label="nominal plane z$_f$ (µm)", **place)
    return figure


def _draw_planes(ax: Axes, defocus: Tensor, levels: ListedColormap) -> None:
    z, x = (GRID.coordinates(axis, dtype=torch.float64).numpy() for axis in (0, 2))
    for i, plane in enumerate(PLANES):
        ax.axhline(plane, color=levels(i), lw=0.8, ls=(0, (4, 4)))
        ax.contour(
            x, z, z[:, None] + defocus.numpy(), levels=[plane], colors=[levels(i)], linestyles="solid", linewidths=1.8
        )


def _outline(ax: Axes, delta: Tensor, colour: str) -> None:
    z, x = (GRID.coordinates(axis, dtype=torch.float64).numpy() for axis in (0, 2))
    ax.contour(x, z, delta.numpy(), levels=[CONTRAST / 2], colors=colour, linewidths=0.9)


if __name__ == "__main__":
    raise SystemExit(main())
