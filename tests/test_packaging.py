"""What is shipped: one version everywhere, type hints marked as such."""

import re
from pathlib import Path

import pytest

import torchdic

ROOT = Path(__file__).parents[1]


def test_the_citation_has_the_projects_version():
    (cited,) = re.findall(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited == torchdic.__version__


def test_the_version_is_written_in_one_place():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert 'dynamic = ["version"]' in project
    assert 'path = "torchdic/__init__.py"' in project
    assert torchdic.__version__ not in re.findall(r'^version = "(.*)"', project, re.MULTILINE)


@pytest.mark.parametrize("package", ["torchdic", "recon", "data_synthetic"])
def test_type_hints_are_marked_for_type_checkers(package):
    """PEP 561: without this file a type checker takes the package for untyped."""
    assert (ROOT / package / "py.typed").read_bytes() == b""
