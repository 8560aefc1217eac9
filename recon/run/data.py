"""The measured stack that a configuration names, in the model's unit."""

import os
import warnings
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from recon.config.schema import Config, ConfigError, DataSection
from recon.fit.newton.weak_hessian import lacks_of_linear_response
from recon.fit.problem import DIRECT
from recon.fit.setup import on_voxels, pixels_of
from recon.misfit.base import spatial_variance
from recon.recording.empty_field import EmptyField, empty_field
from recon.recording.masks import LeftOut, counted_pixels, left_out
from recon.recording.preparation import ExpectedStack, Measured, Normalisation, check_counts, prepare
from recon.recording.stuck_pixels import sharpest, stuck_pixels
from recon.recording.support import edges_support
from recon.recording.survey.odd_images import odd_images
from torchdic import Acquisition, Fidelity, Grid, Volume, image
from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack, shape_text
from torchdic.files.joined import read_joined
from torchdic.files.stack import read_stack
from torchdic.memory.free import check_room, free_bytes

# Condenser directions of the empty field where the fidelity has yet to be planned.
MANY_SOURCES = 200
# Bytes that preparing a stack takes at most beside it, for each of its pixels.
PREPARED = 24


def load_data(config: Config) -> Measured:
    """Read and prepare a configuration's stack: relative to the empty bright field, in the order of its acquisition.

    Raises ConfigError where the configuration has no stack or asks for what can't be reconstructed, and StackError
    where the file is no stack of its acquisition or shows nothing.
    """
    section = config.data
    if section is None or not section.files:
        raise ConfigError("missing key data.path: a reconstruction needs a stack")
    check_feasible(config)
    return prepared(config, read_joined(section.files, section.channels, section.series))


def looks(config: Config) -> dict[str, tuple[int, int] | None]:
    """Size and time of the last change of each of the stack's files; None where a file can't be looked at."""

    def look(name: str) -> tuple[int, int] | None:
        try:
            found = os.stat(name)
        except OSError:
            return None
        return found.st_size, found.st_mtime_ns

    return {name: look(name) for name in (config.data.files if config.data is not None else ())}


def warn_of_changes(config: Config, before: dict[str, tuple[int, int] | None]) -> None:
    """Warn StackWarning of each file of the stack that looks different by now. before: how they looked."""
    for name, now in looks(config).items():
        if now != before[name]:
            told = f"{name}: has changed since it was read; the volume is of what was read, and can't go on with this"
            warnings.warn(told, StackWarning, stacklevel=3)


def prepared(config: Config, stack: Stack) -> Measured:
    """A stack of a configuration's acquisition, relative to the empty bright field, as its [data] says how.

    Raises StackError where it is no stack of this acquisition or shows nothing.
    """
    section, pixels = config.data or DataSection(stack.source), camera_pixels(config)
    expected = ExpectedStack(
        biases=tuple(None if prism is None else float(prism.bias) for prism in config.acquisition.prisms),
        focus=tuple(float(focus) for focus in config.acquisition.focus),
        pixel_size=pixels.spacing[1:],
        pixels=pixels.shape[1:],
        field=config.volume.grid.extent[1:] if pixels != config.volume.grid else None,
        empty=tuple(empty_levels(config)),
    )
    normalisation = Normalisation(section.flatten, section.scale, section.offset, section.order)
    check_counts(stack, expected)
    shape = "×".join(map(str, stack.data.shape))
    check_room(PREPARED * stack.data.size, free_bytes(torch.device("cpu")), f"Images of {shape} pixels, prepared,")
    ratio = None
    if section.stuck is not None:
        ratio = sharpest(config.microscope, stack.pixel_size or pixels.spacing[1:], config.volume.background)
    empty = None
    if section.empty is not None:
        empty = empty_field(read_stack(section.empty), stack, section.offset, ratio)
    measured = prepare(stack, expected, normalisation, _left_out(section, stack, ratio, empty), empty)
    counted = measured.left_out.counted
    try:
        spatial_variance(torch.from_numpy(measured.data), None if counted is None else torch.from_numpy(counted))
    except ValueError as error:
        raise StackError(f"{stack.source}: {error}") from error
    return measured


def _left_out(section: DataSection, stack: Stack, ratio: float | None, empty: EmptyField | None) -> LeftOut:
    """The pixels of a stack that don't count; a line says how many.

    ratio: how far a pixel may stand out of its neighbours; None looks for no stuck pixels. empty: has bad pixels too.
    """
    mask = None if section.mask is None else _mask(section.mask, stack)
    stuck = None if empty is None else empty.bad
    if ratio is not None:
        own = stuck_pixels(stack.data, ratio, counted_pixels(stack, mask, stuck))
        stuck = own if stuck is None else own | stuck
    found = left_out(stack, mask, stuck)
    if str(found):
        print(found)
    for line in odd_images(stack, found.counted):
        warnings.warn(f"{stack.source}: {line}", StackWarning, stacklevel=4)
    return found


def _mask(path: str, stack: Stack) -> np.ndarray:
    """The user's mask of a stack, True where a pixel counts. Raises StackError where it doesn't fit the images."""
    mask = read_stack(path).data != 0
    try:
        np.broadcast_to(mask, stack.data.shape)
    except ValueError as error:
        raise StackError(
            f"data.mask: {path} has {shape_text(mask.shape)} (prism, focus, y, x), the images of {stack.source} "
            f"{shape_text(stack.data.shape)}; it may have 1 prism and 1 plane for all"
        ) from error
    return mask


def load_support(config: Config, measured: Measured) -> Tensor | None:
    """The voxels (z, y, x) of the field in which Δn is sought, and a line that says how many; None is all.

    Raises StackError where the file is none, and ConfigError where its shape isn't the volume's.
    """
    named, grid = config.reconstruction.support, config.volume.grid
    if named is None:
        return None
    if named == "edges":
        pixels, images = camera_pixels(config), torch.from_numpy(measured.data)
        data = measured.data if pixels == grid else on_voxels(images, pixels, grid).numpy()
        found = edges_support(data, measured.focus, grid, config.microscope, config.volume.background)
    else:
        mask = read_stack(named).data != 0
        if mask.shape not in ((1, *grid.shape), (1, 1, *grid.shape[1:])):
            shape = "×".join(map(str, mask.shape[1:] if len(mask) == 1 else mask.shape))
            raise ConfigError(
                f"reconstruction.support: {named} is a mask of {shape}, the volume has {'×'.join(map(str, grid.shape))}"
            )
        found = np.broadcast_to(mask[0], grid.shape).copy()
    print(f"Δn is sought in {found.mean():.1%} of the voxels (support = {named})")
    return torch.from_numpy(found)


def camera_pixels(config: Config) -> Grid:
    """The pixels of a configuration's images as a grid (z, y, x): the camera's, or the volume's voxels.

    Raises ConfigError where none of the camera's fits into the volume.
    """
    try:
        return pixels_of(config.volume.grid, config.microscope)
    except ValueError as error:
        raise ConfigError(f"microscope.camera.pixel_size: {error}") from error


def check_feasible(config: Config) -> None:
    """Raise ConfigError where the configuration asks for something that a reconstruction doesn't have."""
    camera, method = config.microscope.camera, config.reconstruction.method
    if method in DIRECT and camera is not None and camera.pixel_size is not None:
        raise ConfigError(
            f"reconstruction.method: {method!r} takes pixels that are voxels, microscope.camera.pixel_size is "
            f"{camera.pixel_size:g}; use 'newton' or 'adam', or leave it out and give voxels the size of the pixels"
        )
    if method == "opl" and config.reconstruction.support is not None:
        raise ConfigError("reconstruction.support: a path length by section has none; use method 'newton' or 'adam'")
    if method in ("newton", "linear"):
        asks, instead = f"reconstruction.method: {method!r} needs", "use method 'adam' with start 'zero'"
    elif method == "adam" and config.reconstruction.start == "linear":
        asks, instead = "reconstruction.start: 'linear' needs", "use 'zero'"
    else:
        return
    lacking = lacks_of_linear_response(config.microscope, config.acquisition, dark=method == "adam")
    if lacking is not None:
        raise ConfigError(f"{asks} {lacking}; {instead}")


def empty_levels(config: Config) -> list[float]:
    """Intensity that the model's empty volume has behind each prism, relative to the empty bright field.

    It is sin²(bias/2), and 1 in bright field, where the prisms' light does not leak and none is stopped. It is computed
    with the condenser directions of the fidelity, or with MANY_SOURCES where the fidelity has yet to be planned.
    """
    nothing = torch.zeros(1, 1, 1, dtype=torch.float64)
    point = Volume(Grid((1, 1, 1), config.volume.spacing), nothing, config.volume.background)
    fidelity = Fidelity("projection", sources=MANY_SOURCES if config.fidelity is None else config.fidelity.sources)
    with torch.no_grad():
        images = image(point, replace(config.microscope, camera=None), Acquisition(config.acquisition.prisms), fidelity)
    return images.flatten().tolist()
