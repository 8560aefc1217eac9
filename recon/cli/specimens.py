"""The known specimens that a configuration can name, and their voxels."""

from typing import Any

import torch

from data_synthetic import (
    Bead,
    CellPhantom,
    EtchedGlassGrating,
    EtchedGlassStep,
    GaussianBall,
    GradedIndexRod,
    LayeredMedium,
)
from recon.config.reading import structure
from recon.config.schema import Config, ConfigError
from torchdic import Grid, Volume
from torchdic.memory.free import check_volume

# What [specimen] kind = "…" may be.
SPECIMENS: dict[str, type] = {
    "bead": Bead,
    "cell": CellPhantom,
    "etched_glass": EtchedGlassStep,
    "etched_grating": EtchedGlassGrating,
    "gaussian_ball": GaussianBall,
    "graded_index_rod": GradedIndexRod,
    "layered_medium": LayeredMedium,
}


def specimen_of(config: Config, source: str) -> Any:
    """The specimen that a configuration names.

    source: the configuration's file, for messages.
    Raises ConfigError where there is no specimen, its kind isn't known, a value breaks its law, its background isn't
    the volume's, or its exact field is asked for and isn't known.
    """
    if config.specimen is None:
        raise ConfigError(f"{source}: missing key specimen: a simulation needs one")
    values = dict(config.specimen)
    if "kind" not in values:
        raise ConfigError(f"{source}: missing key specimen.kind, which is one of {', '.join(map(repr, SPECIMENS))}")
    kind = values.pop("kind")
    if not isinstance(kind, str) or kind not in SPECIMENS:
        raise ConfigError(f"{source}: specimen.kind: {kind!r} must be one of {', '.join(map(repr, SPECIMENS))}")
    values.setdefault("background", config.volume.background)
    specimen = structure(values, SPECIMENS[kind], source, "specimen")
    if specimen.background != config.volume.background:
        raise ConfigError(
            f"{source}: specimen.background {specimen.background} differs from volume.background "
            f"{config.volume.background}"
        )
    return specimen


def check_exact_field(config: Config, specimen: Any, source: str) -> None:
    """Raise ConfigError where a configuration asks for the exact field of a specimen that has none."""
    if config.simulation.exact and not hasattr(specimen, "field"):
        raise ConfigError(f"{source}: simulation.exact: the exact field of this specimen isn't known")


def voxels(specimen: Any, grid: Grid, device: torch.device) -> Volume:
    """A specimen's index on a grid, float32. Raises ShortOfMemoryError where the device has no room for it."""
    check_volume(grid, 2, device)  # the index, and an array from which it is made
    return Volume(grid, specimen.delta(grid, dtype=torch.float32, device=device), specimen.background)
