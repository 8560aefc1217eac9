"""Conversion between TOML's values and the configuration's dataclasses, both ways.

Each kind of value is one function here, which checks a value and converts it, and one row of a table at the end: TYPES
for plain values, KINDS for types that are made of others, FIELDS for a field whose type doesn't say all.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import cattrs
import tomli_w
import torch
from cattrs.errors import IterableValidationError, IterableValidationNote
from cattrs.gen import make_dict_structure_fn, override
from torch import Tensor

from recon.config.schema import (
    CalibrationSection,
    CompensatorSection,
    Config,
    DataSection,
    ReconstructionSection,
    WedgeSection,
    WorkPrecisionSection,
)
from recon.config.spelling import BRIGHT_FIELD
from torchdic import Acquisition, Candidate, Condenser, JonesPupil, Layer, Objective, Polarisation, Prism, Spectrum

# TOML has no null. This word switches off what has a default.
NONE = "none"

# Checks a value of TOML and converts it to a type. Raises TypeError or ValueError with the value and the law.
Hook = Callable[[Any, Any], Any]

converter = cattrs.Converter(forbid_extra_keys=True)


# --- to TOML ----------------------------------------------------------------------------------------------------------


def dump(config: Config) -> str:
    """The whole configuration as TOML, with every default; what is absent by default is left out."""
    return tomli_w.dumps(plain(config))


def flat(config: Config) -> list[str]:
    """The whole configuration as lines `key = value`, one for each value that isn't a table."""

    def lines(key: str, value: Any) -> Iterator[str]:
        if isinstance(value, dict):
            for name, below in value.items():
                yield from lines(f"{key}.{name}" if key else name, below)
        elif isinstance(value, list) and any(isinstance(below, dict) for below in value):
            for index, below in enumerate(value):
                yield from lines(f"{key}[{index}]", below)
        else:
            yield f"{key} = {value!r}"

    return list(lines("", plain(config)))


def plain(value: Any) -> Any:
    """A value as TOML can hold it: tensors as arrays, bright field by its name, None by its word or left out.

    None is left out where it is the default.
    """
    if dataclasses.is_dataclass(value):
        values = {f.name: (getattr(value, f.name), f.default) for f in dataclasses.fields(value)}
        return {k: NONE if v is None else plain(v) for k, (v, usual) in values.items() if not (v is usual is None)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items() if v is not None}
    if isinstance(value, list | tuple):
        return [BRIGHT_FIELD if v is None else plain(v) for v in value]
    return value.tolist() if isinstance(value, Tensor) else value


# --- from TOML: single values -----------------------------------------------------------------------------------------


def _strict(kind: type, accepted: tuple[type, ...], words: str) -> Hook:
    """A hook for values of the accepted types alone, which become `kind`; true and false are no numbers."""

    def hook(value: Any, _: Any) -> Any:
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise TypeError(f"{value!r} must be {words}")
        return kind(value)

    return hook


_number = _strict(float, (int, float), "a number")
_whole_number = _strict(int, (int,), "a whole number")
_string = _strict(str, (str,), "a string")
_truth_value = _strict(bool, (bool,), "true or false")


def _choice(value: Any, kind: Any) -> Any:
    choices = get_args(kind)
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        raise ValueError(f"{value!r} must be one of {', '.join(map(repr, choices))}")
    return value


def _optional(value: Any, kind: Any) -> Any:
    if value is None or value == NONE:
        return None
    return converter.structure(value, next(k for k in get_args(kind) if k is not type(None)))


def _or(word: str, hook: Hook) -> Hook:
    """A hook for a word, or for what another hook converts; a value that is neither is told both."""

    def either(value: Any, kind: Any) -> Any:
        if value == word:
            return value
        try:
            return hook(value, kind)
        except (TypeError, ValueError) as error:
            if repr(word) in str(error):
                raise
            raise type(error)(f"{error}, or {word!r}") from error

    return either


def _or_none(value: Any, _: Any) -> Any:
    """A whole number, or None by its word."""
    if value is None or value == NONE:
        return None
    return _strict(int, (int,), f"a whole number, {NONE!r}")(value, int)


# --- from TOML: arrays ------------------------------------------------------------------------------------------------


def _array_of_fixed_length(value: Any, kind: Any) -> tuple[Any, ...]:
    kinds = get_args(kind)
    if not isinstance(value, list | tuple) or len(value) != len(kinds):
        raise ValueError(f"{value!r} must be an array of {len(kinds)} values")
    return tuple(converter.structure(v, k) for v, k in zip(value, kinds, strict=True))


def _pair(value: Any, _: Any) -> tuple[Any, ...]:
    return _array_of_fixed_length(value, tuple[float, float])


def _weights(value: Any, _: Any) -> tuple[Any, ...]:
    try:
        return _pair(value, None)
    except ValueError as error:
        raise ValueError(f"{value!r} must be 'auto', or an array of the first and the last weight") from error


def _array_of(hook: Hook) -> Hook:
    """A hook for an array of any length, each of whose elements another hook converts."""

    def element(value: Any, index: int) -> Any:
        try:
            return hook(value, None)
        except Exception as error:
            # cattrs finds the element's place in this note, and the message then has it in its key
            error.add_note(IterableValidationNote(f"element {index}", index, None))
            raise IterableValidationError("an array's element", [error], tuple) from error  # pyright: ignore[reportCallIssue]

    def structure_all(value: Any, _: Any) -> tuple[Any, ...]:
        if not isinstance(value, list | tuple):
            raise TypeError(f"{value!r} must be an array")
        return tuple(element(v, i) for i, v in enumerate(value))

    return structure_all


def _tensor(value: Any, _: Any) -> Tensor:
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{value!r} must be an array of numbers") from error


# --- from TOML: tables ------------------------------------------------------------------------------------------------


def _free_table(value: Any, _: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} must be a table")
    return value


def _section(kind: type) -> Hook:
    """A hook for a table whose keys are a dataclass's fields, those in FIELDS by hooks of their own."""
    own: dict[str, Any] = {key: override(struct_hook=hook) for key, hook in FIELDS.get(kind, {}).items()}
    fields = make_dict_structure_fn(kind, converter, **own)
    return lambda value, _: fields(_free_table(value, dict), kind)


def _by_noll_index(hook: Hook, words: str) -> Hook:
    """A hook for a table of Noll indices, each of whose values another hook converts."""

    def structure_all(value: Any, _: Any) -> dict[int, Any]:
        if not isinstance(value, dict) or not all(str(key).isdigit() for key in value):
            raise TypeError(f"{value!r} must be a table of Noll indices, each with {words}")
        return {int(key): hook(below, None) for key, below in value.items()}

    return structure_all


def _prism(value: Any, _: Any) -> Prism | None:
    """A prism, given by its shear and bias or as one of PRISMS, or bright field by its name."""
    if value == BRIGHT_FIELD:
        return None
    if not isinstance(value, dict):
        raise TypeError(f"{value!r} must be a table of shear and bias, or {BRIGHT_FIELD!r}")
    for key, section in PRISMS.items():
        if key in value:
            return converter.structure(value, section).prism()
    return converter.structure(value, Prism)


def _candidate(value: Any, _: Any) -> Candidate:
    return converter.structure(value, Candidate)


# --- which value goes by which hook -----------------------------------------------------------------------------------


def _is_optional(kind: Any) -> bool:
    return get_origin(kind) in (Union, UnionType) and len(get_args(kind)) == 2 and type(None) in get_args(kind)


def _has_fixed_length(kind: Any) -> bool:
    return get_origin(kind) is tuple and Ellipsis not in get_args(kind)


# The hook of each plain type.
TYPES: dict[type, Hook] = {float: _number, int: _whole_number, str: _string, bool: _truth_value}

# How a type made of others is told, and the hook for its values.
KINDS: tuple[tuple[Callable[[Any], bool], Hook], ...] = (
    (lambda kind: get_origin(kind) is Literal, _choice),
    (lambda kind: get_origin(kind) is dict, _free_table),
    (_has_fixed_length, _array_of_fixed_length),
    (_is_optional, _optional),
)

# The key that only one kind of prism has, and the section that reads it.
PRISMS = {"polariser": CompensatorSection, "wedge": WedgeSection}

# Fields whose type allows more than a file may say (a tensor, any sequence), and their hooks.
FIELDS: dict[type, dict[str, Hook]] = {
    Prism: {"shear": _pair, "bias": _number, "axis": _number},
    Objective: {"aberrations": _by_noll_index(_number, "its phase in rad")},
    Layer: dict.fromkeys(("thickness", "index", "design_index"), _number),
    Polarisation: {field.name: _number for field in dataclasses.fields(Polarisation) if field.name != "pupil"},
    JonesPupil: dict.fromkeys(("retardance", "diattenuation"), _by_noll_index(_pair, "a pair of numbers in rad")),
    Condenser: {"points": _tensor, "weights": _tensor},
    Spectrum: dict.fromkeys(("wavelengths", "weights"), _array_of(_number)),
    Acquisition: {"prisms": _array_of(_prism), "focus": _array_of(_number)},
    DataSection: {
        "scale": _or("background", _number),
        "paths": _array_of(_string),
        "channels": _array_of(_whole_number),
    },
    ReconstructionSection: {
        "tv": _or("auto", _weights),
        "learn": _array_of(_string),
        "draft_sources": _or("auto", _or_none),
        "margin": _or("auto", _whole_number),
        "tiles": _or("auto", _or_none),
    },
    CalibrationSection: {"aberrations": _array_of(_whole_number)},
    WorkPrecisionSection: {
        **dict.fromkeys(("methods", "propagations"), _array_of(_string)),
        **dict.fromkeys(("directions", "planes"), _array_of(_whole_number)),
    },
    Config: {"candidates": _array_of(_candidate), "assumed": _array_of(_string)},
}

for _type, _hook in TYPES.items():
    converter.register_structure_hook(_type, _hook)
for _is_of, _hook in KINDS:
    converter.register_structure_hook_func(_is_of, _hook)
converter.register_structure_hook_factory(dataclasses.is_dataclass, _section)
