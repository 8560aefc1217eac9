"""Every public name, by the package from which it is imported: pages of Sphinx's autodoc."""

import inspect
from importlib import import_module

# The packages and modules whose `__all__` is public, and what each is.
MODULES = {
    "torchdic": "the microscope",
    "recon.descend": "the fit of a volume, step by step",
    "data_synthetic": "specimens with a known answer",
}


def page() -> str:
    """The page of the reference, in Markdown around autodoc's directives."""
    return "# Every public name\n\nMade from the docstrings.\n\n" + "\n".join(map(_module, MODULES))


def _module(module: str) -> str:
    lines = [f"## {module}: {MODULES[module]}", ""]
    described = inspect.getdoc(import_module(module)) and module != "recon.descend"
    lines += ["```{eval-rst}", f".. automodule:: {module}", "   :no-members:", "```", ""] if described else []
    for name in import_module(module).__all__:
        lines += ["```{eval-rst}", f".. {_directive(module, name)}", "```", ""]
    return "\n".join(lines)


def _directive(module: str, name: str) -> str:
    value = getattr(import_module(module), name)
    if inspect.isclass(value):
        return f"autoclass:: {module}.{name}\n   :members:"
    if callable(value):
        return f"autofunction:: {module}.{name}"
    return f"autodata:: {module}.{name}\n   :no-value:"
