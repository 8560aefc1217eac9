"""A configuration file as plain values, with those of the files that it includes beneath its own.

A microscope is described once and used for many specimens: `include = "microscope.toml"`.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from recon.config.encoding import values_in
from recon.config.spelling import ALTERNATIVES

INCLUDE = "include"

# Values that name a file, by their keys; words that stand in a file's place.
_FILES = (*(("data", key) for key in ("path", "paths", "mask", "empty")), ("reconstruction", "support"))
_WORDS = ("none", "edges")

Table = dict[str, Any]


class CircleError(ValueError):
    """A file includes itself, directly or not."""


def values_of(path: Path) -> tuple[Table, list[Path]]:
    """The values of a configuration file, as TOML holds them, and the files that it includes, directly or not.

    `include` names a file or several, of which a later one goes before an earlier one; it isn't among the values. The
    values of the file itself go before all of these, key by key; an array counts as one value. Where two keys are
    spellings of one value, the one of the file that goes before counts. A relative name of a file starts from the
    folder of the file that says it.

    Raises ValueError, in one line that doesn't name `path`, for a file that can't be read, isn't TOML or includes
    itself, for an `include` that is no name, and for files whose names aren't UTF-8.
    """
    found: list[Path] = []
    return _values(path, (), found), found


def _values(path: Path, above: tuple[Path, ...], found: list[Path]) -> Table:
    """above: the files by which this one is included, outermost first. found: grows by those that it includes."""
    try:
        values = values_in(path.read_bytes())
    except OSError as error:
        raise ValueError(error.strerror or str(error)) from error
    values = _from_folder(values, path.parent)
    chain, beneath = (*above, _resolved(path)), {}
    for name in _names(values.pop(INCLUDE, [])):
        included = _resolved(path.parent / name)
        if included in chain:
            circle = " → ".join(file.name for file in (*chain[chain.index(included) :], included))
            raise CircleError(f"{INCLUDE}: {circle} is a circle: a file can't include itself")
        try:
            beneath = _over(_values(included, chain, found), beneath)
        except CircleError:
            raise
        except ValueError as error:
            raise ValueError(f"{INCLUDE}: {included}: {error}") from error
        found.append(included)
    return _over(values, beneath)


def _resolved(path: Path) -> Path:
    """As `Path.resolve`, which raises where links lead in a circle; reading says so in plain words."""
    return Path(os.path.realpath(path))


def _names(value: Any) -> list[str]:
    """The files that an `include` names."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{INCLUDE}: {value!r} must be the name of a file, or an array of names")
    return names


def _over(upper: Table, lower: Table, key: str = "") -> Table:
    """The values of two tables; where both say one, the upper's. key: of the tables in the file."""
    said = {
        other
        for spellings in ALTERNATIVES.get(key, ())
        for spelling in spellings
        if any(name in upper for name in spelling)
        for others in spellings
        if others is not spelling
        for other in others
    }
    merged = {name: value for name, value in lower.items() if name not in said}
    for name, value in upper.items():
        below = merged.get(name)
        if isinstance(value, dict) and isinstance(below, dict):
            value = _over(value, below, f"{key}.{name}".lstrip("."))
        merged[name] = value
    return merged


def seen_from(folder: Path, file: Path) -> str:
    """A file's name as a configuration in a folder says it: from there, unless it is on another drive.

    Raises ValueError for a name that isn't UTF-8.
    """
    seen = os.path.realpath(file)
    with suppress(ValueError):
        seen = os.path.relpath(seen, os.path.realpath(folder))
    return _writable(Path(seen).as_posix())


def _writable(name: str) -> str:
    """A file's name, where TOML can hold it. Raises ValueError elsewhere."""
    try:
        name.encode()
    except UnicodeEncodeError as error:
        told = f"{name} is a name that isn't UTF-8, in which a configuration is written; rename it"
        raise ValueError(told) from error
    return name


def relative_to(values: Table, folder: Path) -> Table:
    """The values with names of files as `seen_from` a folder; the inverse of what `values_of` does with them."""
    return _with_files(values, lambda name: seen_from(folder, Path(name)))


def _from_folder(values: Table, folder: Path) -> Table:
    """The values with relative names of files starting from a folder."""
    return _with_files(values, lambda name: _writable(os.path.realpath(folder / name)))


def _with_files(values: Table, change: Callable[[str], str]) -> Table:
    """The values with all names of files changed."""

    def changed(name: Any) -> Any:
        if isinstance(name, list):
            return [changed(one) for one in name]
        return change(name) if isinstance(name, str) and name not in _WORDS else name

    for section, key in _FILES:
        values = _changed(values, section, lambda table, key=key: _changed(table, key, changed))

    def prisms(found: Any) -> Any:
        return [_changed(prism, "file", changed) for prism in found] if isinstance(found, list) else found

    return _changed(values, "acquisition", lambda table: _changed(table, "prisms", prisms))


def _changed(table: Any, key: str, change: Callable[[Any], Any]) -> Any:
    """A table with one value changed, if it is there."""
    return {**table, key: change(table[key])} if isinstance(table, dict) and key in table else table
