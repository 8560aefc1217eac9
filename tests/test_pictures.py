"""The scripts that draw docs/figure1.png and docs/etched_glass.png: what they show is what their captions say."""

import importlib.util
import math
import sys
from pathlib import Path

import pytest
import torch

from torchdic import Condenser, Grid, Microscope, Objective

EXPERIMENTS = Path(__file__).parents[1] / "experiments"


def load(name):
    spec = importlib.util.spec_from_file_location(f"{name}_experiment", EXPERIMENTS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def figure1(monkeypatch):
    """Figure 1 on coarser voxels and few directions."""
    script = load("figure1")
    monkeypatch.setattr(script, "GRID", Grid((40, 72, 72), (0.25, 0.2, 0.2)))
    monkeypatch.setattr(script, "MICROSCOPE", Microscope(0.546, Objective(0.75), Condenser(0.5)))
    monkeypatch.setattr(script, "SOURCES", 5)
    return script


@pytest.fixture
def etched(monkeypatch):
    """Etched glass on few rows: it is the same along y."""
    script = load("etched_glass")
    monkeypatch.setattr(script, "GRID", Grid((6, 8, 128), (0.07, 0.125, 0.125)))
    return script


def run(script, monkeypatch, out):
    monkeypatch.setattr(sys, "argv", [script.__file__, "--out", str(out)])
    return script.main()


def test_figure_1_s_bead_is_the_exact_one(figure1, monkeypatch, tmp_path, capsys):
    assert run(figure1, monkeypatch, tmp_path / "out") == 0
    assert (tmp_path / "out" / "figure1.png").stat().st_size > 10_000
    lines = capsys.readouterr().out.splitlines()
    errors = [float(line.split(" by ")[1].split()[0]) for line in lines if line.startswith("focus")]
    assert len(errors) == 3
    assert max(errors) < 0.03


def test_figure_1_s_bead_is_bright_where_its_path_rises_along_the_shear(figure1):
    modelled, exact = figure1.stacks()
    left, right = figure1.GRID.shape[2] // 2 - 24, figure1.GRID.shape[2] // 2 + 23
    for stack in (modelled, exact):
        middle = stack[0, figure1.GRID.shape[1] // 2]
        assert float(middle[left - 2 : left + 3].max()) > 0.6
        assert float(middle[right - 2 : right + 3].min()) < 0.4


def test_etched_walls_obey_the_law_of_a_thin_phase_step(etched):
    """sin²((bias ± 2π/λ·opd_step)/2) over the shear's width at each wall, and sin²(bias/2) elsewhere."""
    step, grating = etched.SPECIMENS["step"], etched.SPECIMENS["grating"]
    half = math.pi / 0.546 * step.opd_step
    for bias, line in zip(etched.BIASES, etched.law(step)[:2, 4], strict=True):
        assert float(line[64]) == pytest.approx(math.sin(bias / 2 + half) ** 2, rel=1e-12)
        assert float(line[32]) == pytest.approx(math.sin(bias / 2) ** 2, rel=1e-12)
    x = etched.GRID.coordinates(2, dtype=torch.float64)
    line = etched.law(grating)[0, 4]
    for bias_sign, wall in ((1, 0.0), (-1, 1.5), (1, 4.0), (-1, -2.5)):
        at_wall = line[int((x - wall).abs().argmin())]
        assert float(at_wall) == pytest.approx(math.sin(math.pi / 4 + bias_sign * half) ** 2, rel=1e-12)
    # without a lens's blur nothing is seen along the walls
    torch.testing.assert_close(etched.law(step)[2], torch.full((8, 128), 0.5).double(), rtol=0, atol=1e-12)


def test_etched_images_are_the_law_seen_through_the_lens(etched, monkeypatch, tmp_path, capsys):
    assert run(etched, monkeypatch, tmp_path / "out") == 0
    assert (tmp_path / "out" / "etched_glass.png").stat().st_size > 10_000
    assert "step" in capsys.readouterr().out
    for specimen in etched.SPECIMENS.values():
        difference = (etched.modelled(specimen) - etched.thin(specimen))[:2]
        assert float(difference.abs().max()) < 0.02
        # and the lens does not hide the walls
        assert float((etched.thin(specimen)[0, 0] - 0.5).abs().max()) > 0.1


@pytest.mark.parametrize("name", ["figure1", "etched"])
def test_a_folder_that_cannot_be_made_is_one_line_and_exit_2(request, name, monkeypatch, tmp_path, capsys):
    script = request.getfixturevalue(name)
    (tmp_path / "file").write_text("")
    assert run(script, monkeypatch, tmp_path / "file" / "out") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "file" in line
