"""Imports point down, the inverse cannot see the truth, and the public names are those promised."""

import ast
import inspect
from pathlib import Path

import pytest

import torchdic

ROOT = Path(__file__).parent.parent

# torchdic's files, lowest first: each imports only from files above it in this list.
LAYERS = (
    "files",
    "scalar",
    "grid",
    "sampling",
    "volume",
    "condenser",
    "fidelity",
    "recompute",
    "ray_equation",
    "ray_solver",
    "caustics",
    "rays",
    "landing",
    "projection",
    "wave",
    "aberration",
    "objective",
    "jones_pupil",
    "jones",
    "prism",
    "space_variant",
    "camera",
    "instrument",
    "wrap_around",
    "passband",
    "imaging",
    "memory",
    "microscope",
    "weak",
    "image_error",
    "pilots",
    "cost",
    "ladders",
    "effects",
    "plan",
    "precision",
    "tiff",
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


def modules(package):
    return sorted((ROOT / package).rglob("*.py"))


def imported(path):
    """The full names of the modules that a file imports, wherever in it."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide the layer"
            assert node.module is not None
            # "from package import module" names a module too
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def packages(path):
    return {name.split(".")[0] for name in imported(path)}


def test_every_file_of_torchdic_has_its_layer():
    found = {path.stem for path in modules("torchdic")} - {"__init__"}
    assert found <= set(LAYERS)
    assert len(found) >= 14


@pytest.mark.parametrize("path", modules("torchdic"), ids=lambda p: p.stem)
def test_imports_point_down(path):
    allowed = LAYERS if path.stem == "__init__" else LAYERS[: LAYERS.index(path.stem)]
    own = {name.split(".")[1] for name in imported(path) if name.startswith("torchdic.")}
    known = {p.stem for p in modules("torchdic")}
    assert own & known <= set(allowed)
    assert path.stem == "__init__" or "torchdic" not in imported(path), "a file names the layers that it uses"


@pytest.mark.parametrize("path", modules("torchdic"), ids=lambda p: p.stem)
def test_torchdic_knows_neither_its_inverse_nor_its_specimens(path):
    assert not packages(path) & {"recon", "data_synthetic"}


@pytest.mark.parametrize("path", modules("recon"), ids=lambda p: p.stem)
def test_inverse_cannot_see_the_truth(path):
    if path.name != "cli.py":
        assert "data_synthetic" not in packages(path)


@pytest.mark.parametrize("path", modules("data_synthetic"), ids=lambda p: p.stem)
def test_specimens_know_the_grid_and_no_more_of_torchdic(path):
    """Their exact answers must not come from the models that they judge."""
    assert "recon" not in packages(path)
    own = {name.split(".")[1] for name in imported(path) if name.startswith("torchdic.")}
    assert own <= {"grid"}


@pytest.mark.parametrize("package", ["recon", "data_synthetic"])
def test_files_of_a_package_do_not_import_in_circles(package):
    known = {path.stem: path for path in modules(package)}
    uses = {
        stem: {n.split(".")[1] for n in imported(path) if n.startswith(f"{package}.")} & set(known)
        for stem, path in known.items()
        if stem != "__init__"
    }
    placed: set[str] = set()
    while ready := {stem for stem, needs in uses.items() if stem not in placed and needs <= placed | {stem}}:
        placed |= ready
    assert placed == set(uses)


def test_no_file_is_a_drawer_for_everything():
    for package in ("torchdic", "recon", "data_synthetic"):
        assert not {"utils", "helpers", "common", "misc"} & {path.stem for path in modules(package)}


def test_solver_and_viewer_stay_in_one_place():
    """torchdiffeq belongs to rays alone, and matplotlib to no physics."""
    users = {path.stem for path in modules("torchdic") if "torchdiffeq" in packages(path)}
    assert users == {"ray_solver"}
    assert not any("matplotlib" in packages(path) for path in modules("torchdic"))


def test_public_names_keep_the_contract():
    assert set(torchdic.__all__) >= CONTRACT
    assert all(hasattr(torchdic, name) for name in torchdic.__all__)
    assert len(set(torchdic.__all__)) == len(torchdic.__all__)
    public = {name for name, value in vars(torchdic).items() if name[0] != "_" and not inspect.ismodule(value)}
    assert public == set(torchdic.__all__)
