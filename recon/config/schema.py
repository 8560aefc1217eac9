"""A configuration's sections: frozen dataclasses, among them the domain's own."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from recon.fit.descent import Recipe
from torchdic import Acquisition, Candidate, Fidelity, Grid, Microscope
from torchdic.instrument.microscope import check_apertures


class ConfigError(ValueError):
    """A configuration that can't be used: one line with the file, the key, the value and the law."""


class UnitsWarning(UserWarning):
    """A value of a configuration that is so large that another unit was likely meant."""


@dataclass(frozen=True)
class VolumeSection:
    """The volume's grid: shape (z, y, x) in voxels, spacing (z, y, x) in µm, and the background's index."""

    shape: tuple[int, int, int]
    spacing: tuple[float, float, float]
    background: float

    def __post_init__(self) -> None:
        if not (1 <= self.background < math.inf):
            raise ValueError(f"background {self.background} must be a refractive index of at least 1")
        Grid(self.shape, self.spacing)

    @property
    def grid(self) -> Grid:
        """The grid of the volume."""
        return Grid(self.shape, self.spacing)


@dataclass(frozen=True)
class CompensatorSection:
    """A prism whose bias de Sénarmont's polariser sets, see `Prism.senarmont`: shear (y, x) in µm, angles in rad."""

    shear: tuple[float, float]
    polariser: float
    axis: float | None = None


@dataclass(frozen=True)
class WedgeSection:
    """A prism given by its wedge, see `Prism.from_wedge`, whose angle is `wedge`."""

    wedge: float
    focal_length: float
    wavelength: float
    material: Literal["quartz", "calcite"] | None = None
    indices: tuple[float, float] | None = None
    offset: float = 0.0
    direction: tuple[float, float] = (0.0, 1.0)
    axis: float | None = None


@dataclass(frozen=True)
class DataSection:
    """The measured stack, and how it is brought to the model's unit; see `recon.measured.prepare`."""

    path: str
    flatten: bool | None = None
    scale: float | Literal["background"] | None = None
    offset: float = 0.0
    order: int = 2

    def __post_init__(self) -> None:
        if not isinstance(self.scale, str | None) and not (0 < self.scale < math.inf):
            raise ValueError(f"scale {self.scale} must be above 0")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset {self.offset} must be finite")
        if self.order < 0:
            raise ValueError(f"order {self.order} must be at least 0")


@dataclass(frozen=True)
class ReconstructionSection(Recipe):
    """How to descend, see `recon.descend.Recipe`, and how often to save.

    checkpoint_every: steps between checkpoints.
    """

    checkpoint_every: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.checkpoint_every < 1:
            raise ValueError(f"checkpoint_every {self.checkpoint_every} must be at least 1 step")


@dataclass(frozen=True)
class SimulationSection:
    """How to simulate. seed: of the camera's noise. exact: the specimen's exact field instead of a propagation."""

    seed: int = 0
    exact: bool = False


@dataclass(frozen=True)
class WorkPrecisionSection:
    """How to measure work and precision.

    repeats: timed runs. reference: what counts as converged; None is finer than every candidate.
    """

    repeats: int = 3
    reference: Fidelity | None = None

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ValueError(f"repeats {self.repeats} must be at least 1")


@dataclass(frozen=True, eq=False)
class Config:
    """All sections of a configuration file.

    fidelity: None leaves it to the command. tolerance: of the images, for which a fidelity is planned, see
    `torchdic.plan`; the two exclude each other. specimen: left to `data_synthetic`, which knows its kinds. candidates:
    whose work and precision are measured; None is `torchdic.precision.ladder`.
    """

    volume: VolumeSection
    microscope: Microscope
    acquisition: Acquisition
    data: DataSection | None = None
    fidelity: Fidelity | None = None
    reconstruction: ReconstructionSection = field(default_factory=ReconstructionSection)
    simulation: SimulationSection = field(default_factory=SimulationSection)
    specimen: dict[str, Any] | None = None
    tolerance: float | None = None
    candidates: Sequence[Candidate] | None = None
    work_precision: WorkPrecisionSection = field(default_factory=WorkPrecisionSection)

    def __post_init__(self) -> None:
        if self.tolerance is not None:
            if self.fidelity is not None:
                raise ValueError(f"tolerance {self.tolerance} and [fidelity] exclude each other: leave one out")
            if not (0 < self.tolerance < math.inf):
                raise ValueError(f"tolerance {self.tolerance} must be above 0, and finite")
        check_apertures(self.microscope, self.volume.background)
        if self.candidates is not None and len(self.candidates) == 0:
            raise ValueError("candidates must hold at least one; leave it out for the default ones")
