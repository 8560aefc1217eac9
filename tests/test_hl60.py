"""`python benchmarks/hl60.py`, the cell of a tomogram, and the parts of scenes that `reconstruction.py` compares."""

import importlib
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchdic import Acquisition, Grid, Prism

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
FILE = "ri_hl60_tomogram_derived.npz"


@pytest.fixture(scope="module")
def hl60():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("hl60")
        for name in ("hl60", "reconstruction", "scenes", "specimens"):
            patch.delitem(sys.modules, name)


def run(hl60, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["hl60.py", *map(str, arguments)])
    return hl60.main()


def test_without_the_tomogram_it_is_one_line_and_exit_2(hl60, monkeypatch, tmp_path, capsys):
    monkeypatch.delenv("TORCHDIC_DATA", raising=False)
    assert run(hl60, monkeypatch, "--out", tmp_path / "out") == 2
    monkeypatch.setenv("TORCHDIC_DATA", str(tmp_path))
    assert run(hl60, monkeypatch, "--out", tmp_path / "out") == 2
    np.savez(tmp_path / FILE, something=np.zeros(3))
    assert run(hl60, monkeypatch, "--out", tmp_path / "out") == 2
    unset, absent, other = capsys.readouterr().err.splitlines()
    assert "TORCHDIC_DATA is unset" in unset
    assert FILE in unset
    assert "No such file" in absent
    assert FILE in other
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def tomogram(hl60):
    """A ball of 5 µm with a nucleus and a nucleolus, blurred by half a voxel's side, in place of the measured one."""
    z, y, x = np.mgrid[-30:31, -30:31, -30:31] * 0.2
    radius = np.sqrt(z**2 + y**2 + x**2)
    delta = 0.020 / (1 + np.exp((radius - 5) / 0.1))
    delta = np.where(np.sqrt(z**2 + y**2 + (x + 0.5) ** 2) < 2.2, 0.015, delta)
    delta = np.where(np.sqrt(z**2 + y**2 + (x - 3) ** 2) < 1.2, 0.030, delta)
    return hl60.Tomogram(delta, 0.2, 1.335, "drawn")


def test_a_tomogram_is_its_own_values_at_its_cubes_and_nothing_beyond(hl60, tomogram):
    own = tomogram.delta(Grid((61, 61, 61), (0.2, 0.2, 0.2))).numpy()
    np.testing.assert_allclose(own[tomogram.delta_measured > hl60.LEAST], tomogram.delta_measured[own > 0], atol=1e-12)
    wide = tomogram.delta(Grid((63, 61, 61), (0.2, 0.2, 0.2)))
    assert float(wide[[0, -1]].abs().max()) == 0
    assert float(tomogram.delta(Grid((40, 40, 40), (0.3, 0.3, 0.3))).min()) == 0


def test_parts_are_apart_and_hold_their_index(hl60, tomogram):
    grid = Grid((41, 61, 61), (0.3, 0.2, 0.2))
    parts, delta = tomogram.parts(grid), tomogram.delta(grid)
    three = [parts[name] for name in ("cytoplasm", "nucleus", "nucleolus")]
    assert all(int(part.sum()) > 50 for part in three)
    assert int(sum(part.int() for part in three).max()) == 1
    assert all(bool((part <= parts["cell"]).all()) for part in three)
    for part, index in zip(three, (0.020, 0.015, 0.030), strict=True):
        assert float(delta[part].mean()) == pytest.approx(index, rel=0.01)


def test_width_of_a_gaussian_is_that_at_half_of_its_maximum(hl60):
    x = torch.arange(-20, 21, dtype=torch.float64)
    profile = 0.3 + torch.exp(-(x**2) / (2 * 5**2))
    # chords of the profile between its points are off by (spacing/σ)²/8
    assert hl60.width(profile, 0.1, 0.3) == pytest.approx(0.5 * 2 * math.sqrt(2 * math.log(2)), rel=5e-3)
    assert hl60.width(torch.ones(5), 1.0) == math.inf


def test_extents_are_those_of_the_voxels(hl60):
    delta, (ny, nx) = torch.zeros(hl60.GRID.shape), hl60.GRID.shape[1:]
    part = torch.zeros_like(delta, dtype=torch.bool)
    part[10:30, ny // 2 - 5 : ny // 2 + 5, nx // 2 - 5 : nx // 2 + 5] = True
    delta[part] = 0.02
    assert hl60.cell_extent(delta, part, 0.02) == pytest.approx(20 * 0.4)
    assert hl60.extent(delta, part, 0.0) == pytest.approx(20 * 0.4)
    assert hl60.extent(delta, part, 0.0, axis=2) == pytest.approx(10 * 0.2)


def test_resolution_is_the_shortest_period_that_is_left(hl60):
    """White noise that is cut at 2 µm along z alone; shells are 0.06/µm thick, and a cone is 30° wide."""
    truth = torch.randn(hl60.GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    finest = 1 / (int(0.5 / max(hl60.GRID.spacing) / hl60.SHELL) * hl60.SHELL)
    assert hl60.resolutions(truth, truth) == (pytest.approx(finest), pytest.approx(finest))
    frequency = torch.fft.fftfreq(hl60.GRID.shape[0], hl60.GRID.spacing[0], dtype=torch.float64).abs()
    blurred = torch.fft.ifft(torch.fft.fft(truth, dim=0) * (frequency < 0.5)[:, None, None], dim=0).real
    axial, lateral = hl60.resolutions(blurred, truth)
    # at this angle the cone's frequencies reach 0.5/cos 30°
    assert 1 / 0.5 * math.cos(math.radians(30)) - 0.1 < axial < 1 / 0.5 + 0.1
    assert lateral == pytest.approx(finest)


def test_a_droplets_response_is_centred_on_its_places(hl60):
    change = torch.zeros(hl60.GRID.shape)
    for place in hl60.PLACES:
        droplet = replace(hl60.DROPLET, centre=place).delta(hl60.GRID, dtype=torch.float32)
        peak = [int(i) for i in (droplet == droplet.max()).nonzero()[0]]
        at = [float(hl60.GRID.coordinates(axis)[i]) for axis, i in enumerate(peak)]
        assert at == pytest.approx(place, abs=1e-6)
        change += droplet
    mean = hl60.response(change)
    assert float(mean.max()) == float(mean[hl60.AROUND])
    assert "| 1.00 | 1.00 |" in hl60.point_row("truth", change, change, change)


def test_a_dip_is_that_between_both_droplets(hl60):
    """Apart they fall to nothing between them; blurred along z until they are one, they don't fall at all."""
    cell = hl60.Tomogram(np.zeros((3, 3, 3)), 0.2, 1.335, "empty")
    pairs = hl60.with_pairs(cell).delta(hl60.GRID)
    for apart in (1.6, 2.4):
        assert hl60.dip(pairs, apart) == pytest.approx(1, abs=1e-6)
    assert 0.8 < hl60.dip(pairs, 0.8) < 1
    frequency = torch.fft.fftfreq(hl60.GRID.shape[0], hl60.GRID.spacing[0], dtype=torch.float64)
    blur = torch.exp(-2 * (math.pi * 1.0 * frequency) ** 2)[:, None, None]
    blurred = torch.fft.ifft(torch.fft.fft(pairs, dim=0) * blur, dim=0).real
    assert hl60.dip(blurred, 0.8) == 0 < hl60.dip(blurred, 2.4) < 0.4


def test_a_part_of_a_stack_has_the_images_of_its_prisms_and_planes(hl60):
    """Without a specimen's noise the images are those of the whole stack, whose values name prism and plane."""
    reconstruction, scenes = sys.modules["reconstruction"], sys.modules["scenes"]
    prisms = [Prism(shear, bias) for shear in scenes.SHEARS for bias in (1.0, -1.0)]
    focus = [i / 2 for i in range(-8, 9)]
    data = (1 + torch.arange(4)[:, None] + torch.arange(17) / 100)[..., None, None].expand(4, 17, 9, 9)
    full = scenes.Scene("numbers", "", data, data, None, 1.3, None, Acquisition(prisms, focus), None)
    for planes, chosen in ((1, [8]), (3, [0, 8, 16]), (5, [0, 4, 8, 12, 16]), (17, list(range(17)))):
        found = reconstruction.part(full, (0, 2), planes, 1e12)
        torch.testing.assert_close(found.data, data[[0, 2]][:, chosen], rtol=1e-4, atol=0)
        assert list(found.acquisition.focus) == [focus[i] for i in chosen]
        assert list(found.acquisition.prisms) == [prisms[0], prisms[2]]


@pytest.mark.slow
def test_the_measured_cell_is_found_best_by_the_default(hl60, measured_file, monkeypatch, tmp_path, capsys):
    """On voxels twice as coarse and half of the planes. What the apertures don't see of the cell's ends stays lost."""
    folder = measured_file(FILE).parent
    monkeypatch.setenv("TORCHDIC_DATA", str(folder))
    monkeypatch.setattr(hl60, "GRID", Grid((22, 70, 70), (0.8, 0.3, 0.3)))
    monkeypatch.setattr(hl60, "FOCUS", tuple(float(z) for z in range(-7, 8, 2)))
    assert run(hl60, monkeypatch, "--out", tmp_path, "--cache", tmp_path, "--no-points") == 0
    rows = [row.split("|")[1:-1] for row in capsys.readouterr().out.splitlines() if row.startswith("| ")]
    found = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows[1:]}
    newton, linear, opl = (float(found[name][0]) for name in ("newton", "linear", "opl"))
    assert newton < 0.25 < 0.8 * linear
    assert linear < opl
    # the default's resolution along z is worse than across it
    assert float(found["newton"][10]) > 1.5 * float(found["newton"][11])
    assert (tmp_path / "hl60.png").stat().st_size > 10000
