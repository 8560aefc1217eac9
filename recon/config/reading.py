"""Reading of configuration files, and errors in one line where a file can't be used."""

import dataclasses
import math
import os
import warnings
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Any, Literal, TypeVar

from cattrs import transform_error
from cattrs.errors import ForbiddenExtraKeysError

from recon.config.conversion import converter
from recon.config.encoding import values_in
from recon.config.including import INCLUDE, values_of
from recon.config.plausible.impossible import impossible
from recon.config.plausible.unlikely import degrees_in_radians, unlikely
from recon.config.schema import Config, ConfigError, UnitsWarning, UnlikelyWarning
from recon.config.spelling import FURTHER, canonical, unknown_key
from torchdic.files.stack import FORMATS
from torchdic.propagation.base import propagation_of

T = TypeVar("T")


def load(path: str | os.PathLike[str]) -> Config:
    """Read a configuration file, with those that it includes. A relative path in a file starts from its folder.

    Raises ConfigError where the file can't be used, or where a value can't be, such as a wavelength of 546 µm or an
    index of 13.6. Warns UnitsWarning of a shear longer than the volume is wide, which is likely in another unit, and
    UnlikelyWarning of other values that are likely wrong.
    """
    path = Path(path)
    _check_no_images(path)
    try:
        values, included = values_of(path)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from error
    # what is wrong may stand in any of them
    source = f"{path} (with {', '.join(file.name for file in included)})" if included else str(path)
    config = _configuration(values, source)
    if config.data is not None and not config.data.files:
        raise ConfigError(f"{source}: missing key data.path")
    _warn_of_long_shears(config, path)
    for line in (*unlikely(config), *degrees_in_radians(values)):
        warnings.warn(f"{path}: {line}", UnlikelyWarning, stacklevel=2)
    return config


def _check_no_images(path: Path) -> None:
    """Raise ConfigError for what holds images instead of a configuration, with the command that makes one of them."""
    suffixes = tuple(suffix for known in FORMATS for suffix in known.suffixes)
    try:
        folder = path.is_dir()
    except PermissionError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    kind = "a folder" if folder else "an image" if path.name.lower().endswith(suffixes) else None
    if kind is not None and path.exists():
        raise ConfigError(
            f"{path}: is {kind}, not a configuration; torchdic new {quote(str(path))} --out run.toml writes one for a "
            "stack"
        )


def parse(content: bytes, source: str) -> Config:
    """A configuration from the bytes of its file. source: the file's name, with which messages begin.

    Relative paths stay as they are. Raises ConfigError as `load` does.
    """
    try:
        values = values_in(content)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from error
    return _configuration(values, source)


def _configuration(values: dict[str, Any], source: str) -> Config:
    """The configuration of a file's values. Raises ConfigError as `load` does."""
    wrong = impossible(values)
    if wrong is not None:
        raise ConfigError(f"{source}: {wrong}")
    try:
        values = canonical(values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{source}: {error}") from error
    config = structure(values, Config, source)
    if "method" in values.get("reconstruction", {}):
        return config
    return replace(config, reconstruction=replace(config.reconstruction, method=_usual_method(config)))


def _usual_method(config: Config) -> Literal["newton", "adam"]:
    """The method that errs least with a configuration's propagation.

    A weak specimen's Hessian is near the wave's. On rays Newton's method converges on few specimens, Adam on more.
    """
    fidelity = config.fidelity
    return "newton" if fidelity is None or propagation_of(fidelity).spreads else "adam"


def _warn_of_long_shears(config: Config, path: Path) -> None:
    widest = max(config.volume.grid.extent[1:])
    for index, prism in enumerate(config.acquisition.prisms):
        if prism is None:
            continue
        named = f"{path}: acquisition.prisms[{index}]"
        shear = math.hypot(*map(float, prism.shear))
        if shear > widest:
            warnings.warn(
                f"{named}.shear: {shear:g} is longer than the volume's {widest:g} µm; lengths are in µm",
                UnitsWarning,
                stacklevel=3,
            )


def structure(values: object, kind: type[T], source: str, where: str = "") -> T:
    """Make a dataclass of plain values.

    values: as TOML holds them.
    kind: the dataclass.
    source: the file's name, with which messages begin.
    where: the key of these values in the file, which precedes their own keys in messages.
    Raises ConfigError where a key is unknown or missing, or where a value breaks its law.
    """
    try:
        return converter.structure(values, kind)
    except Exception as error:
        problem = _first_problem(error, where)
        if problem is None:
            raise
        raise ConfigError(f"{source}: {problem}") from error


def _first_problem(error: Exception, where: str) -> str | None:
    """What is wrong with the values, with its key; None for an error that isn't about them.

    An unknown key comes before a missing one, because it is likely a misspelling of that one.
    """
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
    """An error in the words of the user's file, for cattrs, which adds " @ " and the key."""
    if isinstance(error, ForbiddenExtraKeysError):
        if INCLUDE in error.extra_fields and error.cl is not Config:
            return f"unknown key {INCLUDE}; it stands at the top of a file, before its first table"
        further = FURTHER.get(error.cl.__name__, ())
        name = min(error.extra_fields, key=lambda extra: (extra in further, extra))
        known = [*(f.name for f in dataclasses.fields(error.cl)), *further]
        return f"unknown key {name}; {unknown_key(name, known)}"
    if isinstance(error, KeyError):
        return "missing key"
    return str(error)
