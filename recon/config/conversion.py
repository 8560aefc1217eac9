"""From TOML's values to the configuration's dataclasses and back."""

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

from recon.config.schema import CompensatorSection, Config, DataSection, WedgeSection
from torchdic import Acquisition, Candidate, Condenser, JonesPupil, Layer, Objective, Polarisation, Prism, Spectrum

BRIGHT_FIELD = "brightfield"

NONE = "none"  # TOML has no null: this is how to switch off what has a default


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
