"""The README's examples do what they say, as they stand there."""

import re
from pathlib import Path

import pytest
import torch

from recon.cli import main
from recon.config.reading import load
from recon.run.data import load_data
from recon.run.reconstruct import reconstruct
from torchdic.files.stack import read_stack

README = Path(__file__).parents[1] / "README.md"


DOCS = README.parent / "docs"


def blocks(language: str, page: Path = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder in which the README's simulation was run and its configuration saved."""
    monkeypatch.chdir(tmp_path)
    (program,) = blocks("python")
    exec(program, {})
    (tmp_path / "cell.toml").write_text(blocks("toml")[0], encoding="utf-8")
    return tmp_path


def test_the_simulation_writes_the_stack_that_the_configuration_reads(folder):
    data = load_data(load(folder / "cell.toml")).data
    assert data.shape == (2, 3, 64, 72)
    assert data.std() > 0.01


@pytest.fixture
def more(tmp_path) -> Path:
    """The README's configuration with its further tables."""
    path = tmp_path / "more.toml"
    path.write_text("".join(blocks("toml")), encoding="utf-8")
    return path


def test_the_further_tables_go_into_the_configuration(more):
    config = load(more)
    assert config.microscope.polarisation.pupil.strained
    assert config.microscope.polarisation.pupil.depolarisation
    assert (config.fidelity.object_aberration, config.fidelity.defocus) == ("cone", "paraxial")
    assert config.specimen is not None
    assert config.specimen["kind"] == "cell"


@pytest.mark.slow
def test_the_further_tables_are_simulated(more, tmp_path):
    assert main(["simulate", str(more), "--out", str(tmp_path / "out")]) == 0
    stack = read_stack(tmp_path / "out" / "stack.ome.tif").data
    assert stack.shape == (2, 3, 64, 72)
    assert stack.std() > 0.01
    # the rim, 1 µm wide, is even: the cell stands clear of the sides
    assert stack[:, :, [0, -1]].std() < 0.1 * stack.std()


@pytest.mark.slow
def test_the_reconstruction_finds_the_cell(folder):
    result = reconstruct(load(folder / "cell.toml"), folder / "out", torch.device("cpu"))
    assert result.metrics["misfit"] < 0.01
    assert (folder / "out" / "volume.ome.tif").exists()


def test_ones_own_misfit_prior_and_schedule_descend_by_both_methods(capsys):
    (program,) = blocks("python", DOCS / "reconstruction.md")
    exec(program, {"__name__": "own"})
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    for method in ("newton", "adam"):
        misfits = [float(misfit) for name, _, misfit in rows if name == method]
        assert misfits[-1] < 0.5 * misfits[0]


def test_the_files_that_the_readme_names_exist():
    text = README.read_text(encoding="utf-8")
    for name in re.findall(r"\]\(([\w/.]+)\)|(?:python|simulate) ((?:experiments|benchmarks)/[\w.]+)", text):
        path = README.parent / "".join(name)
        assert path.exists(), path
