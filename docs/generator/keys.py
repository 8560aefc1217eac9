"""Every key of a configuration: its type, unit, default and meaning, from the dataclasses that are its schema."""

import dataclasses
import math
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from generator.docstrings import raised, read
from recon.cli.specimens import SPECIMENS
from recon.config.conversion import PRISMS
from recon.config.schema import Config, WedgeSection
from recon.config.spelling import FURTHER
from torchdic import Acquisition, Candidate, Fidelity, Prism

# Units that a meaning may name, in the order in which they are looked for.
UNITS = {
    "1/µm": r"1/µm",
    "counts per electron": r"\bcounts per (?:photo)?electron\b",
    "µm": r"µm",
    "rad": r"\brad\b",
    "electrons": r"\belectrons\b",
    "counts": r"\bcounts\b",
    "bytes": r"\bbytes\b",
    "voxels": r"\bvoxels\b",
    "steps": r"\bsteps\b",
}

# Keys whose meaning names the unit of something else.
OTHER_UNITS = {"bits": "bits", "length_within": "", "draft_sources": "", "exact": ""}


@dataclasses.dataclass(frozen=True)
class Key:
    """A key of a table. type, unit, default, meaning: in words; empty where there is none."""

    name: str
    type: str
    unit: str
    default: str
    meaning: str


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of a configuration.

    path: its keys, with dots between them; the array of an array of tables ends with []. text: what its class is.
    law: which values it refuses. further: other spellings of its keys. keys: in the order of the class.
    """

    path: str
    text: str
    law: str
    further: tuple[str, ...]
    keys: tuple[Key, ...]


def tables() -> list[Table]:
    """All tables of a configuration, the outer before the inner ones."""
    return [*_tables("", Config), *(_specimen(kind, made) for kind, made in SPECIMENS.items())]


def paths() -> list[str]:
    """Every key of a configuration with the tables that lead to it, such as `microscope.objective.na`."""
    return [f"{table.path}.{key.name}".lstrip(".") for table in tables() for key in table.keys]


def page() -> str:
    """The page of the reference, in Markdown."""
    return HEAD + "\n".join(map(_section, tables()))


HEAD = """# Every key of a configuration

Made from the dataclasses that are the configuration's schema: what is said here is what the program checks. Where the
default is *needed* a file must have the key; a table without needed keys may be left out. `none` in a file switches
off what has a default. [Other spellings](../configuration.md#other-ways-to-say-a-value) of angles, vectors, planes and
media have a section of their own.

"""


def _specimen(kind: str, made: type) -> Table:
    table = next(iter(_tables(f'specimen (kind = "{kind}")', made)))
    return dataclasses.replace(table, keys=(Key("kind", f'"{kind}"', "", "*needed*", "which specimen"), *table.keys))


def _tables(path: str, section: type) -> Iterator[Table]:
    hints, fields = typing.get_type_hints(section), dataclasses.fields(section)
    below: list[tuple[str, type]] = []
    keys = []
    for field in fields:
        meaning = _meaning(section, field.name)
        keys.append(Key(field.name, *_described(hints[field.name], field, meaning)))
        for kind in _sections(hints[field.name]):
            below.append((f"{path}.{field.name}".lstrip(".") + ("[]" if kind is Candidate else ""), kind))
    if section is Acquisition:
        below += [(f"{path}.prisms[]", Prism)]
        below += [(f"{path}.prisms[] (with {key})", kind) for key, kind in PRISMS.items()]
    text = read(section.__doc__, [field.name for field in fields]).text
    law = " ".join(law for kind in reversed(section.__mro__) if (law := raised(kind.__dict__.get("__doc__"))))
    further = FURTHER.get(section.__name__, ())
    words = " ".join(text).replace(raised(section.__doc__), "").strip()
    yield Table(path, words, law, further, tuple(keys))
    for name, kind in below:
        # a fidelity is told once
        if kind is not Fidelity or name == "fidelity":
            yield from _tables(name, kind)


def _sections(hint: Any) -> Iterator[type]:
    """The dataclasses that a field may hold, alone or in an array."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        yield hint
    elif hint == Sequence[Candidate] | None:
        yield Candidate
    elif get_origin(hint) in (Union, UnionType):
        for kind in get_args(hint):
            yield from _sections(kind)


def _meaning(section: type, name: str) -> str:
    """What the docstring of a section, or of one that it builds on, says of a field."""
    for kind in section.__mro__:
        fields = [field.name for field in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else []
        meanings = read(kind.__dict__.get("__doc__"), fields).meanings if fields else {}
        if name in meanings:
            return meanings[name]
    # the keys of a wedge are the arguments of what makes the prism
    made = Prism.from_wedge if section is WedgeSection else None
    return read(made.__doc__, [name]).meanings.get(name, "") if made else ""


def _described(hint: Any, field: dataclasses.Field[Any], meaning: str) -> tuple[str, str, str, str]:
    named = next((unit for unit, pattern in UNITS.items() if re.search(pattern, meaning)), "")
    kind, unit = _kind(hint), OTHER_UNITS.get(field.name, named)
    measured = re.search("number|array", kind) or (kind == "table" and not list(_sections(hint)))
    return kind, unit if measured else "", _default(field), meaning


def _kind(hint: Any) -> str:
    """A type as TOML knows it."""
    plain = {float: "number", int: "whole number", str: "string", bool: "true or false", NoneType: "", Any: "any value"}
    if hint in plain:
        return plain[hint]
    if dataclasses.is_dataclass(hint):
        return "table"
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return ", ".join(f'"{value}"' if isinstance(value, str) else str(value) for value in args)
    if origin in (Union, UnionType):
        return ", ".join(dict.fromkeys(kind for kind in map(_kind, args) if kind))
    if origin is tuple and Ellipsis not in args:
        return f"array of {len(args)}, each a {_kind(args[0])}"
    if origin is not None and issubclass(origin, Mapping | dict):
        return "table"
    if origin is not None and issubclass(origin, Sequence):
        return f"array, each a {_kind(args[0]) or 'string'}"
    return "array" if _is_tensor(hint) else getattr(hint, "__name__", str(hint))


def _is_tensor(hint: Any) -> bool:
    return "Tensor" in str(hint)


def _default(field: dataclasses.Field[Any]) -> str:
    made: Callable[[], Any] | Any = field.default_factory
    value = made() if made is not dataclasses.MISSING else field.default
    if value is dataclasses.MISSING:
        return "*needed*"
    if dataclasses.is_dataclass(value):
        return "its defaults"
    if value is None:
        return "absent"
    return f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_toml, value))}]"
    return f"{value:.6g}" if isinstance(value, float) and math.isfinite(value) else str(value)


def _section(table: Table) -> str:
    title = f"[{table.path}]" if table.path else "At the top of a file"
    lines = [f"## {title}" if not table.path else f"## `{title}`", "", table.text, ""]
    lines += ["| key | type | unit | default | meaning |", "|---|---|---|---|---|"]
    lines += [
        "| " + " | ".join(map(_cell, (f"`{k.name}`", k.type, k.unit, k.default, k.meaning))) + " |" for k in table.keys
    ]
    if table.further:
        lines += ["", f"Further keys: {', '.join(f'`{name}`' for name in table.further)}."]
    if table.law:
        lines += ["", f"Law: {table.law}"]
    return "\n".join([*lines, ""])


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
