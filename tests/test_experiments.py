"""experiments/measured.py on an image made here, of known shear axis and phase."""

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdic import Acquisition, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import read_volume, write_stack

SCRIPT = Path(__file__).parents[1] / "experiments" / "measured.py"
SHAPE = (96, 112)


@pytest.fixture
def measured():
    spec = importlib.util.spec_from_file_location("measured_experiment", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def discs() -> torch.Tensor:
    """Δn of round blobs in one slice, none at the border."""
    random = torch.Generator().manual_seed(3)
    y, x = torch.meshgrid(torch.arange(1.0 * SHAPE[0]), torch.arange(1.0 * SHAPE[1]), indexing="ij")
    delta = torch.zeros(SHAPE)
    for _ in range(16):
        place = torch.rand(3, generator=random)
        cy, cx = (30 + (n - 60) * float(p) for n, p in zip(SHAPE, place, strict=False))
        delta = torch.maximum(delta, torch.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * (3 + 4 * place[2]) ** 2)))
    return 0.05 * delta[None]


def run(measured, monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["measured.py", *map(str, arguments)])
    return measured.main()


@pytest.mark.usefixtures("no_pictures")
def test_a_sheared_image_gives_back_its_phase_but_for_scale_and_sign(measured, monkeypatch, tmp_path, discs, capsys):
    grid = Grid((1, *SHAPE), (1.0, 0.25, 0.25))
    angle = math.radians(30)
    prism = Prism((0.25 * math.sin(angle), 0.25 * math.cos(angle)), 0.8)
    recorded = image(Volume(grid, discs, 1.33), Microscope(0.55, Objective(0.3)), Acquisition([prism]))[0, 0].numpy()
    shading = np.linspace(0.9, 1.1, SHAPE[1])
    write_stack(tmp_path / "dic.tif", np.round(200 / recorded.max() * recorded * shading).astype(np.uint8))
    assert run(measured, monkeypatch, tmp_path / "dic.tif", "--out", tmp_path / "out") == 0
    found = float(capsys.readouterr().out.split("shear axis ")[1].split("°")[0])
    assert abs((found - 30 + 90) % 180 - 90) < 10
    phase, _ = read_volume(tmp_path / "out" / "volume.ome.tif")
    assert (tmp_path / "out" / "phase.png").exists()
    likeness = np.corrcoef(phase[0].numpy().ravel(), discs[0].numpy().ravel())[0, 1]
    assert abs(likeness) > 0.7


def test_a_missing_image_is_one_line_and_exit_2(measured, monkeypatch, tmp_path, capsys):
    assert run(measured, monkeypatch, tmp_path / "none.tif", "--out", tmp_path / "out") == 2
    monkeypatch.delenv("TORCHDIC_DATA", raising=False)
    assert run(measured, monkeypatch, "--out", tmp_path / "out") == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "none.tif" in first
    assert "TORCHDIC_DATA" in second
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_measured_beads_are_round_and_alike(measured, measured_file, monkeypatch, tmp_path):
    measured_file("dic_agar_beads.tiff")
    assert run(measured, monkeypatch, "--out", tmp_path / "out") == 0
    phase = read_volume(tmp_path / "out" / "volume.ome.tif")[0][0].numpy()
    # the large bead, left of the middle and below: its disc against the ring around it
    y, x = np.mgrid[: phase.shape[0], : phase.shape[1]]
    distance = np.hypot(y - 400, x - 198)
    inside, around = phase[distance < 50], phase[(distance > 90) & (distance < 120)]
    assert inside.mean() - around.mean() > 2 * phase.std()
