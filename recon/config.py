"""Configuration files: TOML whose schema is the domain's own dataclasses.

Unknown keys, wrong types and unphysical values are errors that name the file, the key, the value and the law.
"""

import dataclasses
import difflib
import math
import os
import tomllib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

import cattrs
import tomli_w
import torch
from cattrs import transform_error
from cattrs.errors import ForbiddenExtraKeysError, IterableValidationError, IterableValidationNote
from cattrs.gen import make_dict_structure_fn, override
from torch import Tensor

from recon.descend import Recipe
from torchdic import (
    Acquisition,
    Candidate,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Layer,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Spectrum,
)
from torchdic.instrument import check_apertures

T = TypeVar("T")
BRIGHT_FIELD = "brightfield"
NONE = "none"  # TOML has no null: this is how to switch off what has a default


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


def load(path: str | os.PathLike[str]) -> Config:
    """Read a configuration file; relative paths in it start from its folder.

    Raises ConfigError. Warns UnitsWarning of a bias beyond a whole turn and of a shear longer than the volume is wide,
    as they are in degrees and nm.
    """
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8")
        values = tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    config = structure(values, Config, str(path))
    if config.data is not None:
        data = dataclasses.replace(config.data, path=str((path.parent / config.data.path).resolve()))
        config = dataclasses.replace(config, data=data)
    _warn_of_other_units(config, path)
    return config


def _warn_of_other_units(config: Config, path: Path) -> None:
    widest = max(config.volume.grid.extent[1:])
    for index, prism in enumerate(config.acquisition.prisms):
        if prism is None:
            continue
        named = f"{path}: acquisition.prisms[{index}]"
        shear, bias = math.hypot(*map(float, prism.shear)), float(prism.bias)
        if abs(bias) > 2 * math.pi:
            warnings.warn(f"{named}.bias: {bias:g} is more than a turn; angles are in rad", UnitsWarning, stacklevel=3)
        if shear > widest:
            warnings.warn(
                f"{named}.shear: {shear:g} is longer than the volume's {widest:g} µm; lengths are in µm",
                UnitsWarning,
                stacklevel=3,
            )


def structure(values: object, kind: type[T], source: str, where: str = "") -> T:
    """A dataclass from plain values. Raises ConfigError that names `source` and the key (below `where`)."""
    try:
        return converter.structure(values, kind)
    except Exception as error:
        problem = _first_problem(error, where)
        if problem is None:
            raise
        raise ConfigError(f"{source}: {problem}") from error


def dump(config: Config) -> str:
    """The resolved configuration as TOML: every default spelled out, what is absent by default left out."""
    return tomli_w.dumps(_plain(config))


def flat(config: Config) -> list[str]:
    """The resolved configuration as lines `key = value`, one for each value that isn't a table."""

    def lines(key: str, value: Any) -> Iterator[str]:
        if isinstance(value, dict):
            for name, below in value.items():
                yield from lines(f"{key}.{name}" if key else name, below)
        elif isinstance(value, list) and any(isinstance(below, dict) for below in value):
            for index, below in enumerate(value):
                yield from lines(f"{key}[{index}]", below)
        else:
            yield f"{key} = {value!r}"

    return list(lines("", _plain(config)))


def _first_problem(error: Exception, where: str) -> str | None:
    """What is wrong, with its key: an unknown one before what it left missing. None for an error not about values."""
    problems = []
    for line in transform_error(error, path=where or "$", format_exception=_describe):
        message, _, path = line.rpartition(" @ ")
        key = path.removeprefix("$").removeprefix(".")
        if message.startswith("unknown key "):
            name = message.removeprefix("unknown key ")
            problems.insert(0, f"unknown key {key}.{name}" if key else f"unknown key {name}")
        elif message == "missing key":
            problems.append(f"missing key {key}")
        elif message:
            problems.append(f"{key}: {message}" if key else message)
    return problems[0] if problems else None


def _describe(error: BaseException, _: Any) -> str:
    if isinstance(error, ForbiddenExtraKeysError):
        name = min(error.extra_fields)
        known = [f.name for f in dataclasses.fields(error.cl)]
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(known)}"
        return f"unknown key {name}; {hint}"
    if isinstance(error, KeyError):
        return "missing key"
    return str(error)


def _strict(kind: type, accepted: tuple[type, ...], words: str) -> Callable[[Any, Any], Any]:
    def hook(value: Any, _: Any) -> Any:
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise TypeError(f"{value!r} must be {words}")
        return kind(value)

    return hook


def _literal(value: Any, kind: Any) -> Any:
    choices = get_args(kind)
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        raise ValueError(f"{value!r} must be one of {', '.join(map(repr, choices))}")
    return value


def _tuple(value: Any, kind: Any) -> tuple[Any, ...]:
    kinds = get_args(kind)
    if not isinstance(value, list | tuple) or len(value) != len(kinds):
        raise ValueError(f"{value!r} must be an array of {len(kinds)} values")
    return tuple(converter.structure(v, k) for v, k in zip(value, kinds, strict=True))


def _prism(value: Any, _: Any) -> Prism | None:
    if value == BRIGHT_FIELD:
        return None
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} must be a table of shear and bias, or {BRIGHT_FIELD!r}")
    if "polariser" in value:
        compensator = converter.structure(value, CompensatorSection)
        return Prism.senarmont(compensator.shear, compensator.polariser, axis=compensator.axis)
    if "wedge" in value:
        given = vars(converter.structure(value, WedgeSection))
        return Prism.from_wedge(given["wedge"], **{key: v for key, v in given.items() if key != "wedge"})
    return converter.structure(value, Prism)


def _sequence_of(hook: Callable[[Any, Any], Any]) -> Callable[[Any, Any], tuple[Any, ...]]:
    def structure_all(value: Any, _: Any) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple):
            raise TypeError(f"{value!r} must be an array")
        return tuple(element(v, i) for i, v in enumerate(value))

    def element(value: Any, index: int) -> Any:
        try:
            return hook(value, None)
        except Exception as error:
            error.add_note(IterableValidationNote(f"element {index}", index, None))
            raise IterableValidationError("an array's element", [error], tuple) from error  # pyright: ignore[reportCallIssue]

    return structure_all


def _tensor(value: Any, _: Any) -> Tensor:
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{value!r} must be an array of numbers") from error


def _pauli_zernike(value: Any, _: Any) -> dict[int, tuple[float, float]]:
    if not isinstance(value, dict) or not all(str(key).isdigit() for key in value):
        raise TypeError(f"{value!r} must be a table of Noll indices, each with a pair of numbers in rad")
    return {int(key): _tuple(pair, tuple[float, float]) for key, pair in value.items()}


def _candidate(value: Any, _: Any) -> Candidate:
    return converter.structure(value, Candidate)


def _aberrations(value: Any, _: Any) -> dict[int, float]:
    if not isinstance(value, dict) or not all(str(key).isdigit() for key in value):
        raise TypeError(f"{value!r} must be a table of Noll indices, each with its phase in rad")
    return {int(key): _number(coefficient, float) for key, coefficient in value.items()}


def _scale(value: Any, _: Any) -> float | str:
    return value if value == "background" else _number(value, float)


def _table(kind: type) -> Callable[[Any, Any], Any]:
    own: dict[str, Any] = {key: override(struct_hook=hook) for key, hook in _hooks.get(kind, {}).items()}
    fields = make_dict_structure_fn(kind, converter, **own)

    def hook(value: Any, _: Any) -> Any:
        if not isinstance(value, dict):
            raise TypeError(f"{value!r} must be a table")
        return fields(value, kind)

    return hook


def _free_table(value: Any, _: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} must be a table")
    return value


def _is_optional(kind: Any) -> bool:
    return get_origin(kind) in (Union, UnionType) and len(get_args(kind)) == 2 and type(None) in get_args(kind)


def _optional(value: Any, kind: Any) -> Any:
    if value is None or value == NONE:
        return None
    return converter.structure(value, next(k for k in get_args(kind) if k is not type(None)))


def _plain(value: Any) -> Any:
    """What TOML can hold: None left out where it is the default, tensors as arrays, a missing prism by its name."""
    if dataclasses.is_dataclass(value):
        values = {f.name: (getattr(value, f.name), f.default) for f in dataclasses.fields(value)}
        return {k: NONE if v is None else _plain(v) for k, (v, usual) in values.items() if not (v is usual is None)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [BRIGHT_FIELD if v is None else _plain(v) for v in value]
    return value.tolist() if isinstance(value, Tensor) else value


_number = _strict(float, (int, float), "a number")

converter = cattrs.Converter(forbid_extra_keys=True)
for _kind, _accepted, _words in (
    (float, (int, float), "a number"),
    (int, (int,), "a whole number"),
    (str, (str,), "a string"),
    (bool, (bool,), "true or false"),
):
    converter.register_structure_hook(_kind, _strict(_kind, _accepted, _words))
converter.register_structure_hook_func(lambda kind: get_origin(kind) is Literal, _literal)
converter.register_structure_hook_func(
    lambda kind: get_origin(kind) is tuple and Ellipsis not in get_args(kind), _tuple
)
converter.register_structure_hook_func(_is_optional, _optional)
converter.register_structure_hook_func(lambda kind: get_origin(kind) is dict, _free_table)
_hooks: dict[type, dict[str, Callable[[Any, Any], Any]]] = {
    Prism: {"shear": lambda value, _: _tuple(value, tuple[float, float]), "bias": _number, "axis": _number},
    Objective: {"aberrations": _aberrations},
    Layer: dict.fromkeys(("thickness", "index", "design_index"), _number),
    Polarisation: {field.name: _number for field in dataclasses.fields(Polarisation) if field.name != "pupil"},
    JonesPupil: dict.fromkeys(("retardance", "diattenuation"), _pauli_zernike),
    Condenser: {"points": _tensor, "weights": _tensor},
    Spectrum: dict.fromkeys(("wavelengths", "weights"), _sequence_of(_number)),
    Acquisition: {"prisms": _sequence_of(_prism), "focus": _sequence_of(_number)},
    DataSection: {"scale": _scale},
    Config: {"candidates": _sequence_of(_candidate)},
}
converter.register_structure_hook_factory(dataclasses.is_dataclass, _table)
