"""The house keeps its rules: rooms in the order of imports, small files and functions, names in their places."""

import ast
import inspect
import subprocess
import sys
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import recon
import torchdic
from torchdic.propagation.base import propagations

ROOT = Path(__file__).parent.parent
PACKAGES = ("torchdic", "recon", "data_synthetic")

# torchdic's rooms and single files, lowest first: each imports only from those before it in this list, and from itself.
ROOMS = (
    "errors",
    "scalar",
    "grid",
    "memory",
    "ranks",
    "plane_waves",
    "specimen",
    "fidelity",
    "instrument",
    "imaging",
    "rays",
    "propagation",
    "object_aberration",
    "forward",
    "linear",
    "planning",
    "files",
    "tiff",
    "__main__",
)
# recon's, likewise; data_synthetic stands beside them, and only the command line sees it.
RECON = (
    "recording",
    "misfit",
    "prior",
    "fit",
    "earlier",
    "descend",
    "tiling",
    "calibration",
    "coverage",
    "evidence",
    "config",
    "report",
    "run",
    "cli",
    "__main__",
)
CONTRACT = {
    "Acquisition",
    "Camera",
    "Condenser",
    "Fidelity",
    "Grid",
    "Microscope",
    "Objective",
    "Plan",
    "Prism",
    "Rays",
    "Volume",
    "image",
    "image_field",
    "plan",
    "trace",
}
MOST_FILES, MOST_PARAMETERS, MOST_LINES = 10, 7, 50
# Functions that are larger, each with the reason why it is better so.
LARGER = {
    "Prism.from_wedge": "its parameters are the keys of a configuration's wedge",
    "transfer_function": "a public function since 0.1, whose parameters are those of an image",
    "transfer_functions": "as transfer_function, for all images at once",
    "effective_defocus": "as wavefront, whose result it reads",
    "wavefront": "what the paper's section 3.3 chooses: the point, the cone and the lens",
    "descend": "a public function since 0.1: what the data were recorded with, and how to descend",
    "sphere_field": "a public function since 0.1: the sphere, the light and the array",
    "radial_field": "as sphere_field, and the profile of the index",
}
# Where a propagation's name may stand: its own room, the fidelity that names it, and the planner's comparisons.
NAMED_IN = ("torchdic/propagation/", "torchdic/fidelity.py", "torchdic/planning/comparisons.py")


def modules(package):
    return sorted((ROOT / package).rglob("*.py"))


def name_of(path):
    return str(path.relative_to(ROOT))


ALL = [path for package in PACKAGES for path in modules(package)]


@cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path):
    """The full names of the modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the room"
            assert node.module is not None
            # "from package import module" names a module too
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def packages(path):
    return {name.split(".")[0] for name in imported(path)}


def room(path):
    """The room or single file of a package in which a file is."""
    return Path(*path.relative_to(ROOT).parts[1:2]).stem


def rooms_imported(path, package):
    return {name.split(".")[1] for name in imported(path) if name.startswith(f"{package}.")} & rooms(package)


@cache
def rooms(package):
    return {room(path) for path in modules(package)}


def offenders(paths, what):
    """The files of which `what` holds anything, by name, and what it holds."""
    return {name_of(path): found for path in paths if (found := what(path))}


# --- the order of imports --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("package", "order"), [("torchdic", ROOMS), ("recon", RECON)])
def test_every_room_has_its_place(package, order):
    assert rooms(package) - {"__init__"} == set(order)


@pytest.mark.parametrize(("package", "order"), [("torchdic", ROOMS), ("recon", RECON)])
def test_imports_point_down(package, order):
    def upward(path):
        return rooms_imported(path, package) - set(order[: order.index(room(path)) + 1])

    assert offenders((path for path in modules(package) if room(path) != "__init__"), upward) == {}


@pytest.mark.parametrize("package", ["torchdic", "recon"])
def test_a_file_names_the_room_that_it_uses(package):
    inside = [path for path in modules(package) if room(path) != "__init__"]
    assert offenders(inside, lambda path: {package} & imported(path)) == {}


def test_public_names_of_the_inverse_come_from_below_its_command_line():
    """Which alone sees the truth."""
    assert rooms_imported(ROOT / "recon/__init__.py", "recon") & {"cli", "__main__"} == set()
    assert not any(name.startswith("cli.") for name in recon._FILES)


@pytest.mark.parametrize("package", PACKAGES)
def test_files_do_not_import_in_circles(package):
    def dotted(path):
        return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")

    files = {dotted(path): path for path in modules(package)}
    faces = {name for name, path in files.items() if path.name == "__init__.py"}
    uses = {name: imported(path) & set(files) - {name} - faces for name, path in files.items() if name not in faces}
    placed: set[str] = set()
    while ready := {name for name, needs in uses.items() if name not in placed and needs <= placed}:
        placed |= ready
    assert placed == set(uses)


def test_torchdic_knows_neither_its_inverse_nor_its_specimens():
    assert offenders(modules("torchdic"), lambda path: packages(path) & {"recon", "data_synthetic"}) == {}


def test_inverse_cannot_see_the_truth():
    blind = [path for path in modules("recon") if room(path) != "cli"]
    assert offenders(blind, lambda path: packages(path) & {"data_synthetic"}) == {}


def test_specimens_know_the_grid_and_no_more_of_torchdic():
    """Their exact answers must not come from the models that they judge; a recorder's images must come from one."""
    specimens = modules("data_synthetic")
    assert offenders(specimens, lambda path: packages(path) & {"recon"}) == {}
    exact = [path for path in specimens if room(path) != "recorder"]
    assert offenders(exact, lambda path: rooms_imported(path, "torchdic") - {"grid"}) == {}
    of_recorder = "data_synthetic.recorder"
    assert offenders(exact, lambda path: [n for n in imported(path) if n.startswith(of_recorder)]) == {}


def test_memory_knows_no_optics():
    inside = modules("torchdic/memory")
    assert offenders(inside, lambda path: rooms_imported(path, "torchdic") - {"errors", "grid", "memory"}) == {}


def test_solver_and_viewer_stay_in_one_place():
    """torchdiffeq belongs to rays alone, and matplotlib to no physics."""
    users = {name_of(path) for path in modules("torchdic") if "torchdiffeq" in packages(path)}
    assert users == {"torchdic/rays/solver.py"}
    assert not any("matplotlib" in packages(path) for path in modules("torchdic"))


def test_the_objective_alone_loads_no_solver():
    """Nor do images by waves: only who traces rays loads torchdiffeq."""
    script = (
        "import sys, torch, torchdic.instrument.objective\n"
        "assert 'torchdiffeq' not in sys.modules\n"
        "from torchdic import Acquisition, Grid, Microscope, Volume, image\n"
        "image(Volume(Grid((2, 8, 8), (1, 1, 1)), torch.zeros(2, 8, 8), 1.3), Microscope(0.5), Acquisition())\n"
        "assert 'torchdiffeq' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True, cwd=ROOT)


# --- size and names --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("package", PACKAGES)
def test_a_folder_has_few_files(package):
    files = Counter(path.parent for path in modules(package) if path.name != "__init__.py")
    assert {folder: count for folder, count in files.items() if count > MOST_FILES} == {}


def functions(tree, within=""):
    """Every function, with its name and its class's."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef):
            yield from functions(node, f"{node.name}.")
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield f"{within}{node.name}", node
            yield from functions(node, f"{within}{node.name}.")
        else:
            yield from functions(node, within)


def lines_without_docstring(node):
    lines = node.end_lineno - node.lineno + 1
    first = node.body[0]
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
        lines -= first.end_lineno - first.lineno + 1
    return lines


def test_functions_are_small():
    """Parameters count without self and cls, lines without the docstring; the exceptions are still needed."""
    larger = set()
    for path in ALL:
        for name, node in functions(parsed(path)):
            taken = [a.arg for a in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
            parameters = len(taken) - (taken[:1] in (["self"], ["cls"]))
            if parameters > MOST_PARAMETERS or lines_without_docstring(node) > MOST_LINES:
                larger.add(name)
    assert larger == set(LARGER)


def test_no_file_is_a_drawer_for_everything():
    assert not {"utils", "helpers", "common", "misc"} & {path.stem for path in ALL}


def test_a_class_has_a_name_of_its_own():
    """Two of one name would each be taken for the other."""
    names = Counter(node.name for path in ALL for node in ast.walk(parsed(path)) if isinstance(node, ast.ClassDef))
    assert {name: count for name, count in names.items() if count > 1} == {}


def without_docstrings(tree):
    """The strings of a file that are values."""
    docs = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docs
    ]


def test_a_propagations_name_stands_in_its_places_alone():
    names = {propagation.name for propagation in propagations()}
    elsewhere = [path for path in modules("torchdic") if not name_of(path).startswith(NAMED_IN)]
    assert offenders(elsewhere, lambda path: names & set(without_docstrings(parsed(path)))) == {}


def test_rooms_hand_nothing_on():
    """A name is imported from the file that defines it; only these faces hand names on."""
    faces = {
        name_of(path)
        for path in ALL
        if path.name == "__init__.py" and any(isinstance(node, ast.ImportFrom) for node in parsed(path).body)
    }
    assert faces == {
        "torchdic/__init__.py",
        "recon/__init__.py",
        "data_synthetic/__init__.py",
        "recon/config/__init__.py",
        "recon/cli/__init__.py",
    }


def test_public_names_keep_the_contract():
    assert set(torchdic.__all__) >= CONTRACT
    assert all(hasattr(torchdic, name) for name in torchdic.__all__)
    assert len(set(torchdic.__all__)) == len(torchdic.__all__)
    public = {name for name, value in vars(torchdic).items() if name[0] != "_" and not inspect.ismodule(value)}
    assert public == set(torchdic.__all__)


def test_errors_that_face_users_are_public():
    """Whoever catches one imports it from torchdic."""
    from torchdic import errors

    raised = {
        name
        for name, value in vars(errors).items()
        if inspect.isclass(value) and issubclass(value, Warning | Exception)
    }
    inner = {"BatchWarning"}
    assert raised - inner <= set(torchdic.__all__)
