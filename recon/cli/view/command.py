"""torchdic view: the results of a folder in napari, at their scale in µm."""

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from recon.cli.view.layers import Shown, layers_of
from recon.config.schema import ConfigError

INSTALL = "pip install 'torchdic[view]'"


def arguments(parser: argparse.ArgumentParser) -> None:
    """The folder of results."""
    parser.add_argument("viewed", type=Path, metavar="DIR", help="folder of results, of reconstruct, simulate or demo")


def run(options: argparse.Namespace) -> None:
    """Show the folder's volumes, error bars and images until the window is closed. Nothing is written."""
    napari = _napari()
    layers = layers_of(options.viewed)
    print("\n".join(map(str, reversed(layers))), flush=True)
    fill(napari.Viewer(title=str(options.viewed)), layers)
    napari.run()


def fill(viewer: Any, layers: Sequence[Shown]) -> None:
    """Put layers into a viewer of napari's, the last on top, and show its scale bar."""
    for layer in layers:
        viewer.add_image(
            layer.data,
            name=layer.name,
            scale=layer.spacing,
            translate=layer.first,
            units=(layer.unit,) * 3,
            axis_labels=("z", "y", "x"),
            contrast_limits=layer.limits,
            colormap=layer.colours,
            visible=layer.visible,
        )
    viewer.canvas.overlays.scale_bar.visible = True


def _napari() -> ModuleType:
    """The package. Raises ConfigError where it, or a screen for its window, is missing."""
    try:
        napari = importlib.import_module("napari")
        importlib.import_module("qtpy.QtWidgets")  # raises where napari has no Qt
    except ImportError as error:
        raise ConfigError(f"view: napari is missing or incomplete ({error}): {INSTALL}") from error
    screens = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in screens):
        raise ConfigError("view: there is no screen (DISPLAY is not set), as over ssh without -X")
    return napari
