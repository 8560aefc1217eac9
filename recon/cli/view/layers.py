"""What a folder of results holds, as layers for a viewer: arrays (z, y, x), their places, names and colour limits."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from recon.cli.specimens import specimen_of
from recon.config.reading import load
from recon.config.resolved import RESOLVED
from recon.config.schema import Config, ConfigError
from torchdic import Grid
from torchdic.files.format import Stack, shape_text
from torchdic.files.stack import read_stack, read_volume

# Volumes of Δn by their files, as they are called beside each other; then their error bars, and images of one kind.
TRUTH = "truth.ome.tif"
VOLUMES = {
    "volume.ome.tif": "Δn",
    "volume.interrupted.ome.tif": "Δn, interrupted",
    "projection.ome.tif": "Δn by straight rays",
    "rays.ome.tif": "Δn by bent rays",
    "wave.ome.tif": "Δn by the wave",
}
BARS = {"sd.ome.tif": "standard deviation of Δn, by noise", "error.ome.tif": "standard deviation of Δn, in all"}
SIMULATED, IMAGES = "stack.ome.tif", "images.ome.tif"
OTHERS = {"opl.ome.tif": "optical path length, µm", "phase.ome.tif": "phase, on an arbitrary scale"}

# Parts of the values below and above an image's colour limits: a few hot pixels don't decide them.
_OUTSIDE = 0.002


@dataclass(frozen=True, eq=False)
class Shown:
    """A layer of a viewer.

    name: as the list of layers calls it. data: (z, y, x). spacing: of its voxels. first: the centre of the first voxel.
    limits: the values that the ends of the colour map stand for, low before high. colours: the map's name.
    unit: of spacing and first, "µm", or "pixel" where the file has no sizes. visible: at first.
    """

    name: str
    data: Shaped[np.ndarray, "z y x"]
    spacing: tuple[float, float, float]
    first: tuple[float, float, float]
    limits: tuple[float, float]
    colours: str
    unit: str = "µm"
    visible: bool = False

    def __str__(self) -> str:
        size = " × ".join(f"{step:g}" for step in self.spacing)
        low, high = self.limits
        return f"{self.name}: {shape_text(self.data.shape)}, {size} {self.unit}, from {low:.4g} to {high:.4g}"


def layers_of(folder: Path) -> list[Shown]:
    """The layers of a folder of results, the lowest first; all lie about the volume's centre, which is the origin.

    All Δn have the same limits, and so have all error bars; a prism's measured and modelled images; and all residuals.
    Raises ConfigError where there is no such folder or nothing to show in it, and StackError for a damaged file.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: {'is a file, not a folder of results' if folder.exists() else 'no such folder'}")
    config = _config(folder)
    found = [
        *_others(folder, config),
        *_images(folder, config),
        *_alike(_bars(folder), "magma"),
        *_alike(_volumes(folder, config), "viridis"),
    ]
    if not found:
        known = ", ".join([*VOLUMES, *BARS, IMAGES, SIMULATED, TRUTH, *OTHERS])
        raise ConfigError(f"{folder}: holds nothing to view, which is one of {known}")
    first = next((layer for layer in reversed(found) if layer.name in VOLUMES.values()), found[-1])
    return [replace(layer, visible=layer is first) for layer in found]


def _config(folder: Path) -> Config | None:
    """The configuration of a folder's results; None where it has none."""
    if not (folder / RESOLVED).exists():
        return None
    with warnings.catch_warnings(action="ignore"):  # of values that are unlikely: the run has told of them
        return load(folder / RESOLVED)


def _volumes(folder: Path, config: Config | None) -> Iterator[Shown]:
    """The true Δn, where it is known, and those that were found, which lie above it."""
    if (folder / TRUTH).exists():
        yield _volume("Δn, true", *read_volume(folder / TRUTH))
    elif config is not None and config.specimen is not None:
        grid = config.volume.grid
        yield _volume("Δn, true", specimen_of(config, str(folder / RESOLVED)).delta(grid, dtype=torch.float32), grid)
    for file in reversed(VOLUMES):
        if (folder / file).exists():
            yield _volume(VOLUMES[file], *read_volume(folder / file))


def _bars(folder: Path) -> Iterator[Shown]:
    for file, name in BARS.items():
        if (folder / file).exists():
            yield _volume(name, *read_volume(folder / file))


def _images(folder: Path, config: Config | None) -> Iterator[Shown]:
    """Residual, modelled and measured images of each prism, the measured ones on top; or the simulated ones."""
    if (folder / SIMULATED).exists():
        stack = read_stack(folder / SIMULATED)
        for number, data in enumerate(stack.data, 1):
            yield _image(f"simulated, prism {number}", data, stack, config, _between(data))
    if not (folder / IMAGES).exists():
        return
    stack = read_stack(folder / IMAGES)
    if len(stack.data) % 2:
        raise ConfigError(f"{stack.source}: holds {len(stack.data)} channels, no measured and modelled ones in turn")
    measured, modelled = stack.data[0::2], stack.data[1::2]
    residuals = measured - modelled
    largest = _between(np.abs(residuals))[1]
    for number, trio in enumerate(zip(residuals, modelled, measured, strict=True), 1):
        grey = _between(trio[2])
        for kind, data in zip(("residual", "modelled", "measured"), trio, strict=True):
            limits, colours = ((-largest, largest), "RdBu_r") if kind == "residual" else (grey, "gray")
            yield replace(_image(f"{kind}, prism {number}", data, stack, config, limits), colours=colours)


def _others(folder: Path, config: Config | None) -> Iterator[Shown]:
    for file, name in OTHERS.items():
        if (folder / file).exists():
            stack = read_stack(folder / file)
            yield _image(name, stack.data[0], stack, config, _between(stack.data))


def _volume(name: str, values: Tensor, grid: Grid) -> Shown:
    """A volume, or what is one value for each of its voxels; the limits are its own."""
    limits = float(values.min()), float(values.max())
    return Shown(name, values.numpy(), grid.spacing, _first(grid), limits, "gray")


def _image(name: str, data: np.ndarray, stack: Stack, config: Config | None, limits: tuple[float, float]) -> Shown:
    """The planes (focus, y, x) of one prism, at their focus where the configuration tells it, else about 0.

    Planes that fall are turned over; unequal steps are shown as equal ones, which the name says.
    """
    focus = [] if config is None else [float(focus) for focus in config.acquisition.focus]
    step, low = stack.focus_step, None
    if len(focus) == len(data):
        low = min(focus)
        if len(focus) > 1:
            step = (max(focus) - low) / (len(focus) - 1)
            data = data[np.argsort(focus, kind="stable")]
            name += "" if stack.focus_step else " (planes at unequal steps)"
    spacing = (step or 1.0, *(stack.pixel_size or (1.0, 1.0)))
    z, y, x = _first(Grid(data.shape, spacing))
    first = (z if low is None else low, y, x)
    return Shown(name, data, spacing, first, limits, "gray", "µm" if stack.pixel_size else "pixel")


def _first(grid: Grid) -> tuple[float, float, float]:
    """The centre of a grid's first voxel."""
    z, y, x = (grid.centre(axis, 0) for axis in range(3))
    return z, y, x


def _between(values: np.ndarray) -> tuple[float, float]:
    """Limits for all but a few outlying values."""
    low, high = np.quantile(values, (_OUTSIDE, 1 - _OUTSIDE))
    return _apart(float(low), float(high))


def _alike(layers: Iterator[Shown], colours: str) -> list[Shown]:
    """The layers with limits that hold 0 and all their values."""
    found = list(layers)
    ends = [end for layer in found for end in layer.limits]
    limits = _apart(min([0.0, *ends]), max([0.0, *ends]))
    return [replace(layer, limits=limits, colours=colours) for layer in found]


def _apart(low: float, high: float) -> tuple[float, float]:
    """Limits that differ, as a viewer needs, also where all values are one."""
    return (low, high) if high > low else (low, low + 1.0)
