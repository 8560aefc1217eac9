"""torchdic simulate: the DIC images of a known specimen."""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from recon.cli.specimens import check_exact_field, specimen_of, voxels
from recon.config.reading import load
from recon.config.schema import Config, ConfigError
from recon.fit.planned import announce
from recon.report import figures
from recon.run.data import camera_pixels
from recon.run.exact_images import check_room_for_exact, exact_images
from recon.run.folder.prepared import prepare_folder
from recon.run.folder.record import recorded_in
from recon.run.folder.results import check_no_results
from recon.run.results import leave_configuration
from recon.run.room import check_room_for_report
from torchdic import STANDARD, Fidelity, Volume, image, plan
from torchdic.files.stack import equal_step, write_stack
from torchdic.files.whole import write_json
from torchdic.forward.foresee import check_fits

STACK = "stack.ome.tif"


def run(options: argparse.Namespace) -> None:
    """Simulate the configuration's specimen and leave stack.ome.tif and stack.png in the folder.

    In a folder of a simulation alone that is replaced: it can be made again in seconds. A stack that came from
    elsewhere can't, and beside other results it is what they are of.
    """
    simulated = recorded_in(options.out) == {"simulate"}
    check_no_results(options.out, (STACK,), restart=options.restart or simulated)
    config = load(options.config)
    specimen = specimen_of(config, str(options.config))
    if config.simulation.exact and config.tolerance is not None:
        raise ConfigError(f"{options.config}: tolerance: simulation.exact leaves nothing to plan")
    check_exact_field(config, specimen, str(options.config))
    if config.simulation.exact or config.tolerance is None:
        config = replace(config, fidelity=config.fidelity or STANDARD)
    if config.simulation.exact:
        images = _from_the_exact_field(config, specimen, options.out)
    else:
        images = _by_a_propagation(config, specimen, options.out, options.device)
    _write(config, images, options.out)


def _from_the_exact_field(config: Config, specimen: Any, out: Path) -> Tensor:
    assert config.fidelity is not None
    check_room_for_exact(config.volume.grid, config.acquisition, config.fidelity)  # before the folder is made
    _prepare(config, out)
    return exact_images(specimen, config.volume.grid, config.microscope, config.acquisition, config.fidelity)


@torch.no_grad()
def _by_a_propagation(config: Config, specimen: Any, out: Path, device: torch.device) -> Tensor:
    volume = voxels(specimen, config.volume.grid, device)
    if config.tolerance is None:
        assert config.fidelity is not None
        fidelity = config.fidelity
        check_fits(volume, config.microscope, config.acquisition, fidelity)  # before the folder is made
        _prepare(config, out)
    else:
        _prepare(config, out)
        fidelity = _planned(config, volume, config.tolerance, out)
    return image(volume, config.microscope, config.acquisition, fidelity).cpu()


def _prepare(config: Config, out: Path) -> None:
    """Make the folder, where there is room for what will be written into it."""
    prisms, planes = len(config.acquisition.prisms), len(config.acquisition.focus)
    check_room_for_report(prisms * planes * math.prod(camera_pixels(config).shape[1:]))
    prepare_folder(out)


def _planned(config: Config, volume: Volume, tolerance: float, out: Path) -> Fidelity:
    """The fidelity that meets the tolerance; leaves the plan and the configuration that it amounts to in the folder."""
    planned = plan(volume, config.microscope, config.acquisition, tolerance)
    print(f"{announce(planned)}, predicted {planned.seconds:.2g} s", flush=True)
    write_json(out / "plan.json", planned.as_dict())
    resolved = replace(config, fidelity=planned.fidelity, tolerance=None)
    leave_configuration(resolved, out, "simulate", announce(planned))
    return planned.fidelity


def _write(config: Config, images: Tensor, out: Path) -> None:
    """Record the images with the camera, if there is one, and write them as a stack and as a picture."""
    camera, acquisition = config.microscope.camera, config.acquisition
    pixel = config.volume.grid.spacing[1:]
    if camera is not None:
        pixel = camera.pixel_spacing(pixel)
        images = camera.record(images, torch.Generator().manual_seed(config.simulation.seed))
    focus = [float(f) for f in acquisition.focus]
    # a camera's counts stay integers, which is how a reader of the file recognises them
    data = images.float() if images.is_floating_point() else images
    write_stack(out / STACK, data, pixel, equal_step(focus))
    figures.save(figures.draw_stack(images.float(), acquisition.prisms, focus, pixel), out / "stack.png")
    if config.tolerance is None:  # otherwise the plan has left it
        leave_configuration(config, out, "simulate")
    prisms, planes, ny, nx = images.shape
    counted = " × ".join(
        f"{number} {noun}{'' if number == 1 else 's'}"
        for number, noun in ((prisms, "prism setting"), (planes, "focus plane"))
    )
    print(f"{out / STACK}: {counted} × {ny} × {nx} pixels")
