"""The README's examples do what they say, as they stand there."""

import re
from pathlib import Path

import pytest
import torch

from recon.config import load
from recon.reconstruct import load_data, reconstruct

README = Path(__file__).parents[1] / "README.md"


def block(language: str) -> str:
    (code,) = re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    return code


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder in which the README's simulation was run and its configuration saved."""
    monkeypatch.chdir(tmp_path)
    exec(block("python"), {})
    (tmp_path / "cell.toml").write_text(block("toml"), encoding="utf-8")
    return tmp_path


def test_the_simulation_writes_the_stack_that_the_configuration_reads(folder):
    data = load_data(load(folder / "cell.toml")).data
    assert data.shape == (2, 3, 64, 72)
    assert data.std() > 0.01


@pytest.mark.slow
def test_the_reconstruction_finds_the_cell(folder):
    result = reconstruct(load(folder / "cell.toml"), folder / "out", torch.device("cpu"))
    assert result.metrics["misfit"] < 0.01
    assert (folder / "out" / "volume.ome.tif").exists()


def test_the_files_that_the_readme_names_exist():
    text = README.read_text(encoding="utf-8")
    for name in re.findall(r"\]\(([\w/.]+)\)|(?:python|simulate) ((?:experiments|benchmarks)/[\w.]+)", text):
        path = README.parent / "".join(name)
        assert path.exists(), path
