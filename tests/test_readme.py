"""The examples of README and of the pages that lead on from it do what they say, as they stand there."""

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


def blocks(language: str, page: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


# From the pages on simulating and on reconstructing: a scene, further tables of it, its stack, and how it is fitted.
SCENE, FURTHER = blocks("toml", "simulate.md")
STACK, RECIPE = blocks("toml", "reconstruct.md")


def written(path: Path, *tables: str) -> Path:
    path.write_text("".join(tables), encoding="utf-8")
    return path


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder in which the pages' simulation was run, and its configuration for the fit saved."""
    monkeypatch.chdir(tmp_path)
    scene = written(tmp_path / "bead.toml", SCENE)
    assert main(["simulate", str(scene), "--out", "bead"]) == 0
    written(scene, SCENE, STACK)
    return tmp_path


def test_the_simulation_leaves_the_stack_that_the_configuration_reads(folder):
    data = load_data(load(folder / "bead.toml")).data
    assert data.shape == (1, 3, 48, 48)
    assert data.std() > 0.01


def test_the_further_tables_go_into_the_configuration(tmp_path):
    config = load(written(tmp_path / "more.toml", SCENE, FURTHER))
    assert config.microscope.polarisation.pupil.strained
    assert config.microscope.polarisation.pupil.depolarisation
    assert (config.fidelity.object_aberration, config.fidelity.defocus) == ("cone", "paraxial")
    assert config.specimen is not None
    assert config.specimen["kind"] == "bead"


@pytest.mark.slow
def test_the_further_tables_are_simulated(tmp_path):
    more = written(tmp_path / "more.toml", SCENE, FURTHER)
    assert main(["simulate", str(more), "--out", str(tmp_path / "out")]) == 0
    stack = read_stack(tmp_path / "out" / "stack.ome.tif").data
    assert stack.shape == (1, 3, 48, 48)
    assert stack.std() > 0.01
    # the rim is even but for the noise of 5000 photons at half the brightness: the bead stands clear of the sides
    assert stack[:, :, [0, -1]].std() == pytest.approx(0.01, rel=0.15)


def test_the_fit_s_table_goes_into_the_configuration(tmp_path):
    config = load(written(tmp_path / "fit.toml", SCENE, STACK, RECIPE))
    assert config.reconstruction.learn == ("bias", "drift", "lamp")
    assert (config.reconstruction.bounds.lower, config.reconstruction.bounds.upper) == (-0.05, 0.0)


@pytest.mark.slow
def test_the_reconstruction_finds_the_bead(folder):
    result = reconstruct(load(folder / "bead.toml"), folder / "out", torch.device("cpu"))
    assert result.metrics["misfit"] < 1.1 * result.metrics["noise_misfit"]
    assert (folder / "out" / "volume.ome.tif").exists()


def test_ones_own_misfit_prior_and_schedule_descend_by_both_methods(capsys):
    (program,) = blocks("python", "reconstruction.md")
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


def test_the_readme_takes_a_screen_and_a_half():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 75
