"""Every public name, by the package from which it is imported: pages of Sphinx's autodoc."""

import inspect
from importlib import import_module

# The packages whose `__all__` is public, and what each is.
PACKAGES = {
    "torchdic": "the microscope",
    "recon": "the inverse",
    "data_synthetic": "specimens with a known answer",
}


def page() -> str:
    """The page of the reference, in Markdown around autodoc's directives."""
    return "# Every public name\n\nMade from the docstrings.\n\n" + "\n".join(map(_package, PACKAGES))


def _package(package: str) -> str:
    lines = [f"## {package}: {PACKAGES[package]}", ""]
    lines += ["```{eval-rst}", f".. automodule:: {package}", "   :no-members:", "```", ""]
    for name in import_module(package).__all__:
        lines += ["```{eval-rst}", f".. {_directive(package, name)}", "```", ""]
    return "\n".join(lines)


def _directive(package: str, name: str) -> str:
    value = getattr(import_module(package), name)
    if inspect.isclass(value):
        return f"autoclass:: {package}.{name}\n   :members:"
    if callable(value):
        return f"autofunction:: {package}.{name}"
    return f"autodata:: {package}.{name}\n   :no-value:"
