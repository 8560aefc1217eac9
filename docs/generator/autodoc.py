"""The house's docstrings as autodoc wants them."""

import dataclasses
import inspect

from generator.docstrings import restructured


def describe(app: object, what: str, name: str, described: object, options: object, lines: list[str]) -> None:
    """Replace the lines of a docstring, as Sphinx's event autodoc-process-docstring asks."""
    if what == "data":  # autodoc would repeat the class's docstring
        lines[:] = [f"``{_said(described)}``"]
        return
    lines[:] = restructured("\n".join(lines), _names(described))


def _names(described: object) -> list[str]:
    """The arguments of a function, or the fields of a class, that its docstring may explain."""
    if isinstance(described, type) and dataclasses.is_dataclass(described):
        return [field.name for field in dataclasses.fields(described)]
    if isinstance(described, type) and issubclass(described, tuple):
        return list(getattr(described, "_fields", ()))
    if not callable(described):
        return []
    try:
        return list(inspect.signature(described).parameters)
    except (TypeError, ValueError):  # a class written in C
        return []


def _said(value: object) -> str:
    """A dataclass's value as it would be written, without its defaults."""
    fields = [field for field in dataclasses.fields(value) if getattr(value, field.name) != field.default]  # pyright: ignore[reportArgumentType]
    return f"{type(value).__name__}({', '.join(f'{f.name}={getattr(value, f.name)!r}' for f in fields)})"
