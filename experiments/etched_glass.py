"""Etched glass, the second manufactured specimen of Kagalwala & Kanade: a step and a grating in DIC.

    python experiments/etched_glass.py --out DIR

Each is shown for a shear across its walls and for one along them. Profiles at two biases stand beside the law of a thin
phase step without a lens. Where the phase differs by φ between the two beams, which is over the width of the shear at
each wall, I = sin²((bias ± φ)/2); elsewhere I = sin²(bias/2). The lens blurs this over about λ/(NA_o + NA_c). The
script prints the largest difference between the wave's image and the same law seen through the lens, and leaves
DIR/etched_glass.png.
"""

import argparse
import math
from pathlib import Path

import torch
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from data_synthetic import EtchedGlassGrating, EtchedGlassStep
from data_synthetic.etched import EtchedGlass
from recon.report import figures
from recon.report.terminal import write_plainly
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field

GRID = Grid((16, 128, 128), (0.025, 0.125, 0.125))
BACKGROUND = 1.333  # water
GLASS = 1.46
HEIGHT = 0.3  # µm
SHEAR = 0.25  # two pixels, so that half a shear is a whole pixel
BIASES = (math.pi / 2, math.pi / 6)
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.3))
ACQUISITION = Acquisition(
    [Prism(shear, bias) for shear in ((0.0, SHEAR), (SHEAR, 0.0)) for bias in BIASES],
)
# the array is periodic, so that the step has a second wall at the array's sides, at ±8 µm
SPECIMENS: dict[str, EtchedGlass] = {
    "step": EtchedGlassStep(HEIGHT, GLASS, BACKGROUND),
    "grating": EtchedGlassGrating(HEIGHT, GLASS, BACKGROUND, period=4.0, duty=0.375),
}


def main() -> int:
    """Compute the images of both and draw them; returns the exit code."""
    write_plainly()
    parser = argparse.ArgumentParser(description="DIC images of an etched step and grating against a thin step's law.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    out: Path = parser.parse_args().out
    images = {name: modelled(specimen) for name, specimen in SPECIMENS.items()}
    laws = {name: (law(specimen), thin(specimen)) for name, specimen in SPECIMENS.items()}
    for name, (_, lens) in laws.items():
        difference = (images[name] - lens)[:2, 0].abs().max()
        print(f"{name}: the wave's image differs from that of the thin phase by {float(difference):.4f} at most")
    return figures.leave(draw(images, laws), out / "etched_glass.png")


@torch.no_grad()
def modelled(specimen: EtchedGlass) -> Float[Tensor, "prism focus y x"]:
    """The images of the etched volume by the wave."""
    return image(Volume(GRID, specimen.delta(GRID), BACKGROUND), MICROSCOPE, ACQUISITION, Fidelity("wave"))


def phase(specimen: EtchedGlass) -> Float[Tensor, "y x"]:
    """The phase in rad that axial light gets if the object is thin: 2π/λ·OPD."""
    opd = specimen.delta(GRID).sum(0) * GRID.spacing[0]
    return 2 * math.pi / MICROSCOPE.wavelength * opd


@torch.no_grad()
def thin(specimen: EtchedGlass) -> Float[Tensor, "prism focus y x"]:
    """The images of the same phase as a thin transmission through the same lens, without depth and oblique paths."""
    transmission = torch.polar(torch.ones_like(phase(specimen)), phase(specimen))
    return image_field(transmission, GRID, MICROSCOPE, ACQUISITION, background=BACKGROUND)


def law(specimen: EtchedGlass) -> Float[Tensor, "prism y x"]:
    """sin²(bias/2 + ½[φ(x + s/2) − φ(x − s/2)]) of each prism, on whole pixels."""
    found, shape = [], phase(specimen)
    for prism in ACQUISITION.prisms:
        assert prism is not None
        half = [round(float(s) / 2 / d) for s, d in zip(prism.shear, GRID.spacing[1:], strict=True)]
        difference = shape.roll([-h for h in half], (0, 1)) - shape.roll(half, (0, 1))
        found.append(torch.sin(float(prism.bias) / 2 + difference / 2) ** 2)
    return torch.stack(found)


def draw(images: dict[str, Tensor], laws: dict[str, tuple[Tensor, Tensor]]) -> Figure:
    """Draw a row for each specimen: images for both shears at the first bias, and profiles across the walls."""
    width = GRID.extent[2]
    figure = Figure(figsize=(11, 6.2), layout="constrained")
    axes = figure.subplots(len(images), 3, width_ratios=(1, 1, 1.7), squeeze=False)
    for row, (name, stack) in zip(axes, images.items(), strict=True):
        for ax, prism, across in ((row[0], 0, "across the walls (x)"), (row[1], 2, "along the walls (y)")):
            _show(ax, stack[prism, 0])
            ax.set_title(f"{name}: shear {across}", fontsize=10)
        row[0].set_ylabel("y (µm)")
        _profiles(row[2], stack[:2, 0], *laws[name])
        row[2].set_title(f"{name}: profile along x, shear along x", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("x (µm)")
    for ax in axes[:, 2]:
        ax.set(xlim=(-width / 2 + 2, width / 2 - 2), ylim=(0, 1.1), yticks=(0, 0.2, 0.4, 0.6, 0.8))
        ax.set_ylabel("intensity")
    axes[0, 2].legend(fontsize=8, loc="upper left", ncols=2)
    label = "intensity over the empty bright field's (bias π/2)"
    figure.colorbar(axes[0, 0].images[0], ax=axes[:, :2], label=label, location="bottom", shrink=0.7, aspect=40)
    return figure


def _show(ax: Axes, values: Tensor) -> None:
    _, height, width = GRID.extent
    box = (-width / 2, width / 2, height / 2, -height / 2)
    ax.imshow(values.numpy(), cmap="gray", clim=(0.25, 0.75), extent=box)
    inner = (-width / 2 + 2, width / 2 - 2)
    ax.set(xlim=inner, ylim=inner[::-1], xticks=range(-4, 5, 4), yticks=range(-4, 5, 4))


def _profiles(ax: Axes, images: Tensor, steps: Tensor, lens: Tensor) -> None:
    x = GRID.coordinates(2, dtype=torch.float64).numpy()
    middle = GRID.shape[1] // 2
    for bias, colour, mine, step, thin_ in zip(BIASES, ("C0", "C1"), images, steps, lens[:, 0], strict=False):
        ax.plot(x, step[middle], color=colour, lw=0.8, ls=":", drawstyle="steps-mid", label="thin step's law, no lens")
        ax.plot(x, thin_[middle], color="0.6", lw=3.0, label="thin step through the lens")
        ax.plot(x, mine[middle], color=colour, lw=1.2, label=f"wave, bias {math.degrees(bias):.0f}°")
    ax.grid(alpha=0.3)


if __name__ == "__main__":
    raise SystemExit(main())
