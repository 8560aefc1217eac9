"""The phase behind one measured DIC image whose optics are unknown.

    python experiments/measured.py IMAGE.tif --out DIR

The script finds the shear axis, flattens the background and fits a phase. Without IMAGE it takes the one that
measured.toml names, from the folder in the environment variable TORCHDIC_DATA. The optics in measured.toml are guesses.
So the scale of the phase is arbitrary. Its sign is arbitrary too, because the image stays the same if shear and bias
are both reversed. Place and shape of the phase are what the image shows.
"""

import argparse
import dataclasses
import math
import os
import sys
from pathlib import Path

import torch
from matplotlib.figure import Figure

from recon.config.reading import load
from recon.config.schema import Config, ConfigError, DataSection
from recon.recording.background import background_surface
from recon.recording.shear_axis import ShearAxis, estimate_shear_axis
from recon.report import figures
from recon.report.terminal import write_plainly
from recon.run.checkpoint import CheckpointError
from recon.run.reconstruct import reconstruct
from torchdic import Acquisition, Prism
from torchdic.errors import StackError
from torchdic.files.stack import read_stack

CONFIG = Path(__file__).with_name("measured.toml")


def main() -> int:
    """Run the experiment; returns the exit code, 2 for bad input."""
    write_plainly()
    parser = argparse.ArgumentParser(description="Phase, on an arbitrary scale, from one measured DIC image.")
    parser.add_argument("image", type=Path, nargs="?", metavar="IMAGE.tif")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    options = parser.parse_args()
    try:
        config = load(CONFIG)
        assert config.data is not None
        path = options.image or _in_data_folder(Path(config.data.files[0]).name)
        image = read_stack(path).data[0, 0].astype(float)
        try:
            axis = estimate_shear_axis(image)
        except ValueError as error:
            raise StackError(f"{path}: {error}") from error
        print(f"shear axis {math.degrees(axis.angle):.1f}° ± {math.degrees(axis.uncertainty):.1f}° (x right, y down)")
        config = adapt(config, path, (image.shape[0], image.shape[1]), axis)
        result = reconstruct(config, options.out, torch.device("cpu"), restart=True)
    except (ConfigError, StackError, CheckpointError) as error:
        print(f"measured.py: error: {error}", file=sys.stderr)
        return 2
    thickness, wavelength = config.volume.spacing[0], config.microscope.wavelength
    phase = 2 * math.pi / wavelength * thickness * result.delta[0]
    background = background_surface(image)
    figures.save(draw(image, image / background * background.mean(), phase.numpy(), axis), options.out / "phase.png")
    print(f"{options.out / 'phase.png'}: the phase, on an arbitrary scale: the optics are not known")
    return 0


def adapt(config: Config, path: Path, pixels: tuple[int, int], axis: ShearAxis) -> Config:
    """The configuration changed to an image's path and size, its shear turned to the axis that was found.

    pixels: of the image, (y, x).
    axis: the image's shear axis.
    """
    (prism,) = config.acquisition.prisms
    assert prism is not None
    length = math.hypot(*(float(s) for s in prism.shear))
    turned = Prism((length * axis.direction[0], length * axis.direction[1]), prism.bias)
    return dataclasses.replace(
        config,
        volume=dataclasses.replace(config.volume, shape=(1, *pixels)),
        acquisition=Acquisition([turned], config.acquisition.focus),
        data=DataSection(str(path), flatten=True, scale="background"),
    )


def draw(image, flattened, phase, axis: ShearAxis) -> Figure:
    """Draw the image as recorded, the image with a flat background, and the phase."""
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for ax, values, title, cmap in (
        (axes[0], image, "as recorded", "gray"),
        (axes[1], flattened, "background flattened", "gray"),
        (axes[2], phase, "phase, arbitrary scale and sign", "viridis"),
    ):
        shown = ax.imshow(values, cmap=cmap)
        ax.set(xticks=[], yticks=[])
        ax.set_title(title, fontsize=10)
    figure.colorbar(shown, ax=axes[2], label="arbitrary unit", ticks=[])
    ny, nx = image.shape
    dy, dx = (0.06 * nx * d for d in axis.direction)
    axes[1].annotate(
        "",
        (0.12 * nx + dx, 0.15 * ny + dy),
        (0.12 * nx - dx, 0.15 * ny - dy),
        arrowprops={"arrowstyle": "<->", "color": "tab:orange", "lw": 2},
    )
    axes[1].text(0.22 * nx, 0.12 * ny, "shear axis", color="tab:orange", fontsize=9)
    return figure


def _in_data_folder(name: str) -> Path:
    folder = os.environ.get("TORCHDIC_DATA")
    if folder is None:
        raise ConfigError(f"no image given, and TORCHDIC_DATA does not name the folder that holds {name}")
    return Path(folder) / name


if __name__ == "__main__":
    raise SystemExit(main())
