"""The sections of a configuration. Those of the microscope and the acquisition are torchdic's own dataclasses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from recon.coverage.expected import ExpectedSpecimen
from recon.fit.problem import DIRECT, STEPS, Recipe
from torchdic import Acquisition, Candidate, Fidelity, Grid, Microscope, Prism
from torchdic.fidelity import PROPAGATIONS
from torchdic.instrument.microscope import check_apertures


class ConfigError(ValueError):
    """A configuration can't be used. The message is one line with the file, the key, the value and the law."""


class AssumedWarning(UserWarning):
    """A configuration holds values that nobody has said."""


class UnitsWarning(UserWarning):
    """A value in a configuration is so large that another unit was likely meant."""


class UnlikelyWarning(UserWarning):
    """A value in a configuration may be right, but is likely wrong."""


@dataclass(frozen=True)
class VolumeSection:
    """The volume that is simulated or reconstructed.

    shape: voxels (z, y, x).
    spacing: size of a voxel (z, y, x) in µm.
    background: refractive index of the medium.
    Raises ValueError for an index below 1, and as Grid does.
    """

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
    """A prism whose bias is set by the polariser of a de Sénarmont compensator; see `Prism.senarmont`.

    shear: (y, x) in µm.
    polariser: its angle in rad; the bias is twice that.
    axis: of the prism, in rad; None as in `Prism`.
    """

    shear: tuple[float, float]
    polariser: float
    axis: float | None = None

    def prism(self) -> Prism:
        """The prism with the bias that the polariser gives it."""
        return Prism.senarmont(self.shear, self.polariser, axis=self.axis)


@dataclass(frozen=True)
class WedgeSection:
    """A prism given by its wedge; see `Prism.from_wedge`.

    wedge: the wedge's angle in rad.
    The other keys are the arguments of `Prism.from_wedge` under their own names.
    """

    wedge: float
    focal_length: float
    wavelength: float
    material: Literal["quartz", "calcite"] | None = None
    indices: tuple[float, float] | None = None
    offset: float = 0.0
    direction: tuple[float, float] = (0.0, 1.0)
    axis: float | None = None

    def prism(self) -> Prism:
        """The prism with the shear and bias that the wedge gives it."""
        others = {name: value for name, value in vars(self).items() if name != "wedge"}
        return Prism.from_wedge(self.wedge, **others)


@dataclass(frozen=True)
class DataSection:
    """The measured stack, and how it is brought to the model's unit; see `recon.recording.preparation.prepare`.

    path: of the stack, whose channels are the prisms; a relative one starts from the configuration's folder.
    paths: instead of path, several files; their channels, one file after the other, are the prisms.
    channels: which channel of the path each prism is, or which channel of each of the paths; counted from 0. None is
        all of them in their order.
    flatten: whether each image is divided by its background; None does so for integer stacks only.
    scale: counts of an empty bright field, or "background" to find them from the images' background; None does so for
        integer stacks, and takes floats as relative to the empty bright field.
    offset: counts that the camera gives in the dark.
    order: of the polynomial in (y, x) that is fitted to a background.
    gain: counts per photoelectron; with read_noise it gives each pixel its own noise. None is one noise for each prism,
        as it was measured.
    read_noise: standard deviation in counts; it has a say beside gain.
    series: which stack of a file that holds several (series or positions), counted from 0; None for its only one.
    mask: a stack of any integers or floats, 0 where a pixel doesn't count: (y, x), (focus, y, x) or as the stack; a
        relative path starts from the configuration's folder. None is all pixels.
    empty: an image or a stack of the empty field, by which the stack is divided in place of a fitted background, see
        `recon.recording.empty_field`; a relative path starts from the configuration's folder. None is none.
    stuck: "auto" looks for pixels of the camera that are dead, hot or stuck at a value; None trusts them all.
    Raises ValueError for a scale or a gain not above 0, a read noise below 0, an offset that isn't finite, an order, a
    channel or a series below 0, both path and paths, channels that aren't as many as the paths, and an empty field
    that nothing is to be divided by.
    """

    path: str | None = None
    flatten: bool | None = None
    scale: float | Literal["background"] | None = None
    offset: float = 0.0
    order: int = 2
    gain: float | None = None
    read_noise: float = 0.0
    series: int | None = None
    mask: str | None = None
    stuck: Literal["auto"] | None = "auto"
    paths: tuple[str, ...] | None = None
    channels: tuple[int, ...] | None = None
    empty: str | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """The files of the stack; empty where none is named."""
        return self.paths or (() if self.path is None else (self.path,))

    def __post_init__(self) -> None:
        if self.path is not None and self.paths is not None:
            raise ValueError("path and paths say the same: leave one out")
        if self.empty is not None and self.flatten is False:
            raise ValueError("empty divides the images, flatten = false says not to: leave one out")
        if self.paths == ():
            raise ValueError("paths must hold at least one file")
        if self.channels is not None:
            if len(self.files) > 1 and len(self.channels) != len(self.files):
                raise ValueError(f"channels {list(self.channels)} must be as many as the {len(self.files)} paths")
            if not self.channels or min(self.channels) < 0:
                raise ValueError(f"channels {list(self.channels)} must be at least one, each at least 0")
        if self.gain is not None and not (0 < self.gain < math.inf):
            raise ValueError(f"gain {self.gain} must be above 0")
        if not (0 <= self.read_noise < math.inf):
            raise ValueError(f"read_noise {self.read_noise} must be at least 0")
        if not isinstance(self.scale, str | None) and not (0 < self.scale < math.inf):
            raise ValueError(f"scale {self.scale} must be above 0")
        if not math.isfinite(self.offset):
            raise ValueError(f"offset {self.offset} must be finite")
        if self.order < 0:
            raise ValueError(f"order {self.order} must be at least 0")
        if self.series is not None and self.series < 0:
            raise ValueError(f"series {self.series} must be at least 0; the first is 0")


@dataclass(frozen=True)
class ReconstructionSection(Recipe):
    """How to fit the volume, see `recon.descend.Recipe`, and how often to save a checkpoint.

    checkpoint_every: steps between two checkpoints.
    margin: voxels of specimen beyond the field of the images on each side, which the light from there asks for; "auto"
        adds them where the images show the specimen at their border.
    tiles: voxels along a side of the overlapping tiles in which the field is fitted; "auto" cuts it where there is no
        room to fit it whole, into tiles as large as memory allows; None never does.
    support: where Δn is sought; elsewhere it is 0. "edges" finds it from the edges in each focus plane; or the file of
        a mask, (z, y, x) or (y, x), 0 where there is none; a relative path starts from the configuration's folder.
        None is everywhere.
    Raises ValueError where a value breaks its law.
    """

    checkpoint_every: int = 10
    margin: int | Literal["auto"] = "auto"
    tiles: int | Literal["auto"] | None = "auto"
    support: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.margin, int) and self.margin < 0:
            raise ValueError(f"margin {self.margin} must be at least 0")
        if isinstance(self.tiles, int) and self.tiles < 1:
            raise ValueError(f"tiles {self.tiles} must be at least 1 voxel; 'none' cuts nothing")
        if isinstance(self.tiles, int) and self.method in DIRECT:
            raise ValueError(f"tiles {self.tiles}: method {self.method!r} solves the whole field at once; use 'newton'")
        if self.checkpoint_every < 1:
            raise ValueError(f"checkpoint_every {self.checkpoint_every} must be at least 1 step")


@dataclass(frozen=True)
class BeadSection:
    """A bead of known size and index, of which the stack in [data] is.

    radius: in µm. index: its refractive index.
    Raises ValueError for a radius not above 0 and an index below 1.
    """

    radius: float
    index: float

    def __post_init__(self) -> None:
        if not (0 < self.radius < math.inf):
            raise ValueError(f"radius {self.radius} must be above 0")
        if not (1 <= self.index < math.inf):
            raise ValueError(f"index {self.index} must be a refractive index of at least 1")


@dataclass(frozen=True)
class CalibrationSection:
    """How `torchdic calibrate` works.

    bead: of which the stack is; None for a specimen that isn't known.
    aberrations: Noll indices of the objective's Zernike terms that are sought with a bead.
    one_exposure: whether all prism settings were recorded with one lamp, exposure and gain, so that the levels of their
        backgrounds tell of their biases.
    length_within, bias_within, angle_within: how closely the shear's length is known beforehand, as a share of it, the
        bias, and the shear's direction, in rad (bias_within_degrees, angle_within_degrees in a file): what the images
        of an unknown specimen tell is weighed against it.
    Raises ValueError for a length_within, bias_within or angle_within out of range, for a Noll index below 4, which a
        picture doesn't show, or named twice, and for aberrations without a bead.
    """

    bead: BeadSection | None = None
    aberrations: tuple[int, ...] = ()
    one_exposure: bool = False
    length_within: float = 0.15
    bias_within: float = math.radians(10)
    angle_within: float = math.radians(10)

    def __post_init__(self) -> None:
        if not 0 <= self.length_within < 1:
            raise ValueError(f"length_within {self.length_within:g} must be a share from 0 to below 1; 0.1 is 10 %")
        for name in ("bias_within", "angle_within"):
            if not 0 <= (angle := getattr(self, name)) <= math.pi / 2:
                degrees = math.degrees(angle)
                raise ValueError(
                    f"{name} {angle:g} rad, {degrees:g}°, must be within 0 and 90°; {name}_degrees is in °"
                )
        for term in self.aberrations:
            if term < 4:
                raise ValueError(f"aberrations {term}: piston and tilts (Noll 1 to 3) don't show; 5 and above do")
            if term == 4:
                raise ValueError("aberrations 4: defocus is where the bead lies along z")
        if len(set(self.aberrations)) < len(self.aberrations):
            raise ValueError(f"aberrations {list(self.aberrations)} names one twice")
        if self.aberrations and self.bead is None:
            raise ValueError(f"aberrations {list(self.aberrations)} show beside a bead of known size: give bead too")


@dataclass(frozen=True)
class CoverageSection(ExpectedSpecimen):
    """What `torchdic coverage` expects of a specimen beforehand; see `recon.coverage.expected.ExpectedSpecimen`."""


@dataclass(frozen=True)
class SimulationSection:
    """How to simulate.

    seed: of the camera's noise.
    exact: whether the images come from the specimen's exact field instead of a propagation.
    Raises ValueError for a seed that torch's generator doesn't take.
    """

    seed: int = 0
    exact: bool = False

    def __post_init__(self) -> None:
        if not -(2**63) <= self.seed < 2**64:
            raise ValueError(f"seed {self.seed} must be from -2^63 to 2^64 - 1")


@dataclass(frozen=True)
class WorkPrecisionSection:
    """How `torchdic work-precision` measures.

    repeats: how often each candidate is timed.
    reference: the fidelity whose result counts as converged; None takes one that is finer than every candidate.
    methods, propagations, directions, planes: what fits are made of (`--fit`), each combination that makes sense; see
        `recon.run.fits.ladder`. directions are numbers of condenser directions, planes of focus planes. None takes all
        methods and propagations, each with its recommended directions (Newton's also with those of its drafts alone),
        and all planes, every second, every fourth.
    Raises ValueError for repeats below 1, an empty list, a method or a propagation that there isn't, and a number of
    directions or planes below 1.
    """

    repeats: int = 3
    reference: Fidelity | None = None
    methods: tuple[str, ...] | None = None
    propagations: tuple[str, ...] | None = None
    directions: tuple[int, ...] | None = None
    planes: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ValueError(f"repeats {self.repeats} must be at least 1")
        for name in ("methods", "propagations", "directions", "planes"):
            if getattr(self, name) == ():
                raise ValueError(f"{name} must hold at least one; leave it out for the default ones")
        for name, known in (("methods", (*STEPS, *DIRECT)), ("propagations", tuple(PROPAGATIONS))):
            for value in getattr(self, name) or ():
                if value not in known:
                    raise ValueError(f"{name} {value!r} must be among {', '.join(map(repr, known))}")
        for name in ("directions", "planes"):
            for value in getattr(self, name) or ():
                if value < 1:
                    raise ValueError(f"{name} {value} must be at least 1")


@dataclass(frozen=True, eq=False)
class Config:
    """All sections of a configuration file.

    volume, microscope, acquisition: the volume, the microscope, and what was recorded with it.
    data: the measured stack; None where there is none.
    fidelity: how carefully to compute; None lets the command choose.
    reconstruction, calibration, coverage, simulation, work_precision: how the commands of these names work.
    specimen: the kind and the measures of a known specimen, which `recon.cli` makes of it; None where there is none.
    tolerance: the error that images may have, for which a fidelity is planned, see `torchdic.plan`; None plans none.
    candidates: the ways to compute that `torchdic work-precision` compares; None takes those of
        `torchdic.planning.work_precision.ladder`.
    assumed: names of values that nobody has said, which a reconstruction warns of; see `torchdic new`.
    Raises ValueError where both fidelity and tolerance are given, for a tolerance not above 0, for an aperture that
    no lens has, for a condenser of which no light enters the medium, for a bead of the medium's index, and for an empty
    list of candidates.
    """

    volume: VolumeSection
    microscope: Microscope
    acquisition: Acquisition
    data: DataSection | None = None
    fidelity: Fidelity | None = None
    reconstruction: ReconstructionSection = field(default_factory=ReconstructionSection)
    calibration: CalibrationSection = field(default_factory=CalibrationSection)
    coverage: CoverageSection = field(default_factory=CoverageSection)
    simulation: SimulationSection = field(default_factory=SimulationSection)
    specimen: dict[str, Any] | None = None
    tolerance: float | None = None
    candidates: Sequence[Candidate] | None = None
    work_precision: WorkPrecisionSection = field(default_factory=WorkPrecisionSection)
    assumed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.tolerance is not None:
            if self.fidelity is not None:
                raise ValueError(f"tolerance {self.tolerance} and [fidelity] exclude each other: leave one out")
            if not (0 < self.tolerance < math.inf):
                raise ValueError(f"tolerance {self.tolerance} must be above 0, and finite")
        check_apertures(self.microscope, self.volume.background)
        bead = self.calibration.bead
        if bead is not None and bead.index == self.volume.background:
            raise ValueError(f"calibration.bead.index {bead.index} is the medium's: such a bead doesn't show")
        if self.candidates is not None and len(self.candidates) == 0:
            raise ValueError("candidates must hold at least one; leave it out for the default ones")
