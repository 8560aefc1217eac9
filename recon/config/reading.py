"""Reading of configuration files, and errors in one line where a file can't be used."""

import dataclasses
import math
import os
import tomllib
import warnings
from pathlib import Path
from typing import Any, TypeVar

from cattrs import transform_error
from cattrs.errors import ForbiddenExtraKeysError

from recon.config.conversion import converter
from recon.config.encoding import decoded
from recon.config.schema import Config, ConfigError, UnitsWarning
from recon.config.spelling import FURTHER, canonical, unknown_key
from recon.config.units import wrong_unit

T = TypeVar("T")


def load(path: str | os.PathLike[str]) -> Config:
    """Read a configuration file. A relative path in it starts from its folder.

    Raises ConfigError where the file can't be used, or where a value can't be in its unit, such as a wavelength of 546
    µm. Warns UnitsWarning of a shear longer than the volume is wide, which is likely in another unit.
    """
    path = Path(path)
    try:
        values = tomllib.loads(decoded(path.read_bytes()))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except ValueError as error:  # TOMLDecodeError is one
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    wrong = wrong_unit(values)
    if wrong is not None:
        raise ConfigError(f"{path}: {wrong}")
    try:
        values = canonical(values)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from error
    config = structure(values, Config, str(path))
    if config.data is not None:
        given = {"path": config.data.path, "mask": config.data.mask}
        files = {key: str((path.parent / name).resolve()) for key, name in given.items() if name is not None}
        config = dataclasses.replace(config, data=dataclasses.replace(config.data, **files))
    support = config.reconstruction.support
    if support not in (None, "edges"):
        section = dataclasses.replace(config.reconstruction, support=str((path.parent / support).resolve()))
        config = dataclasses.replace(config, reconstruction=section)
    _warn_of_long_shears(config, path)
    return config


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
        further = FURTHER.get(error.cl.__name__, ())
        name = min(error.extra_fields, key=lambda extra: (extra in further, extra))
        known = [*(f.name for f in dataclasses.fields(error.cl)), *further]
        return f"unknown key {name}; {unknown_key(name, known)}"
    if isinstance(error, KeyError):
        return "missing key"
    return str(error)
