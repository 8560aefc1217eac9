"""The names at the top of the packages, which scripts and notebooks import: what they are, and who uses them."""

import ast
import dataclasses
import inspect
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import data_synthetic
import recon
import torchdic

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))

from generator.blocks import PAGES, blocks  # noqa: E402
from generator.docstrings import read  # noqa: E402
from generator.gallery import SCRIPTS  # noqa: E402

TOPS = (torchdic, recon, data_synthetic)
PUBLIC = {name: top for top in TOPS for name in top.__all__}


def imports(program):
    """The module and the name of each `from module import name` of a program."""
    for node in ast.walk(ast.parse(program)):
        if isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


# the face of recon


def test_the_lists_of_names_are_one():
    """That which tools read, that which is loaded from, and that which says what is public."""
    for_tools = {
        (module.removeprefix("recon."), name)
        for module, name in imports((ROOT / "recon" / "__init__.py").read_text(encoding="utf-8"))
        if module.startswith("recon.")
    }
    assert for_tools == {(file, name) for file, names in recon._FILES.items() for name in names}
    assert sorted(name for _, name in for_tools) == sorted(recon.__all__)


@pytest.mark.parametrize("name", recon.__all__)
def test_a_public_name_is_that_of_its_file(name):
    there = getattr(import_module(f"recon.{recon._FILE_OF[name]}"), name)
    assert inspect.unwrap(getattr(recon, name)) is inspect.unwrap(there)
    assert name in dir(recon)


def test_other_names_are_none():
    with pytest.raises(AttributeError, match="module 'recon' has no attribute 'reconstructed'"):
        _ = recon.reconstructed


def test_the_package_loads_nothing_and_its_names_no_truth_and_no_pictures():
    """Help of the command line is there at once."""
    script = (
        "import sys, recon\n"
        "heavy = {'torch', 'numpy', 'scipy', 'skimage', 'matplotlib', 'data_synthetic', 'torchdic'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
        "from recon import descend, Problem\n"
        "assert not {'scipy.optimize', 'skimage', 'matplotlib'} & set(sys.modules)\n"
        "from recon import *\n"
        "assert not {'data_synthetic', 'matplotlib', 'recon.cli', 'recon.descend'} & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True, cwd=ROOT)


def test_the_descents_first_name_stays_whichever_is_imported_first():
    """The module takes the function's place, and is called and explained like it."""
    from recon.descend import Problem, Recipe, Step, descend, minimise

    assert (Problem, Recipe, Step, minimise) == (recon.Problem, recon.Recipe, recon.Step, recon.minimise)
    module = sys.modules["recon.descend"]
    assert recon.descend is module
    assert type(module).__call__ is descend
    assert inspect.signature(module) == inspect.signature(descend)
    assert module.__doc__ == descend.__doc__


# words


def annotations(value):
    """The arguments of a public function, or what a public class is made from, each with its annotation."""
    if dataclasses.is_dataclass(value):
        return {field.name: field.type for field in dataclasses.fields(value)}
    made = vars(value).get("__init__") if inspect.isclass(value) else value
    parameters = {} if made is None else inspect.signature(made).parameters
    return {name: parameter.annotation for name, parameter in parameters.items() if name != "self"}


def words(value):
    """The docstrings of a name, and of the classes on which it builds."""
    return [kind.__doc__ or "" for kind in value.__mro__[:-1]] if inspect.isclass(value) else [value.__doc__]


@pytest.mark.parametrize("name", recon.__all__)
def test_a_public_name_says_what_it_takes(name):
    value = getattr(recon, name)
    taken = annotations(value)
    assert value.__doc__
    assert not value.__doc__.startswith(f"{name}("), "made by dataclass"
    told = set().union(*(read(text, taken).meanings for text in words(value)))
    assert set(taken) - told == set()


UNITS = re.compile(r"µm|rad\b|Δn|relative to|in the unit|in any (?:unit|length)|\(True\)")
AXES = re.compile(r"\(\w+(?:, \w+)*,?\)|broadcast|of any shape")


@pytest.mark.parametrize("name", recon.__all__)
def test_arrays_have_axes_and_a_unit(name):
    """Axes stand in the annotation or in words."""
    value = getattr(recon, name)
    arrays = [kind for kind in map(str, annotations(value).values()) if re.search(r"Tensor|ndarray", kind)]
    text = " ".join(words(value))
    if not all(re.search(r"(Float|Real|Bool|Complex)\[", kind) for kind in arrays):
        assert AXES.search(text)
    assert not arrays or UNITS.search(text)


# who uses them


def deep(program):
    """The imports of a program from deeper down than where a name is public."""
    return [
        f"from {module} import {name}"
        for module, name in imports(program)
        if name in PUBLIC and module.split(".")[0] == PUBLIC[name].__name__ != module
    ]


@pytest.mark.parametrize("script", sorted(SCRIPTS.glob("*.py")), ids=lambda path: path.stem)
def test_the_gallery_imports_public_names_from_the_top(script):
    assert deep(script.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_pages_import_and_name_public_names_from_the_top(page):
    programs = [block for language, block in blocks(page) if language == "python"]
    assert [line for program in programs for line in deep(program)] == []
    named = re.findall(r"`(\w+)\.((?:\w+\.)+)(\w+)`", page.read_text(encoding="utf-8"))
    assert [parts for parts in named if parts[2] in PUBLIC and PUBLIC[parts[2]].__name__ == parts[0]] == []


def test_a_deep_import_is_found():
    assert deep("from recon.fit.problem import Recipe") == ["from recon.fit.problem import Recipe"]
    assert deep("from recon import Recipe\nfrom recon.run.exact_images import WIDENING") == []
