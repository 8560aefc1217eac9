"""Pixels that don't count, from a configuration to its results: whatever they held, the results are the same."""

import io
import json
import re
import warnings
from contextlib import nullcontext, redirect_stderr, redirect_stdout

import numpy as np
import pytest
import tifffile
import tomli_w
import torch

from data_synthetic import GaussianBall
from recon.cli import main
from recon.config.reading import load
from recon.recording.masks import counted_pixels, left_out, median_of_known, nearest_counted
from recon.recording.preparation import ExpectedStack, Normalisation, prepare
from recon.run import recorded
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.format import Stack
from torchdic.files.stack import read_volume, write_stack

GRID = Grid((6, 32, 30), (0.5, 0.2, 0.2))
PRISMS = (((0.0, 0.24), 1.4), ((0.24, 0.0), -1.2))
FOCUS = (-1.0, 0.0, 1.0)
CONFIG = {
    "volume": {"shape": list(GRID.shape), "spacing": list(GRID.spacing), "background": 1.5},
    "microscope": {"wavelength": 0.546, "objective": {"na": 0.7}, "condenser": {"na": 0.4}},
    "acquisition": {"focus": list(FOCUS), "prisms": [{"shear": list(s), "bias": b} for s, b in PRISMS]},
    "fidelity": {"sources": 6, "order": 1},
}
# a dead pixel, a hot one at the border, and one beside another
STUCK = {(9, 20): 0, (0, 7): 9000, (22, 11): 14000, (22, 12): 11000}


@pytest.fixture(scope="module")
def counts():
    """A camera's counts (prism, focus, y, x) of a soft ball, with noise."""
    ball = GaussianBall(0.7, 0.03, 1.5, (0.1, 0.3, -0.4))
    acquisition = Acquisition([Prism(s, b) for s, b in PRISMS], FOCUS)
    microscope = Microscope(0.546, Objective(0.7), Condenser(0.4))
    with torch.no_grad():
        volume = Volume(GRID, ball.delta(GRID, dtype=torch.float32), 1.5)
        images = image(volume, microscope, acquisition, Fidelity(sources=6, order=1)).numpy()
    return (np.random.default_rng(0).poisson(8000 * images) + 100).astype(np.uint16)


def spoiled(counts, places=STUCK):
    data = counts.copy()
    for (y, x), value in places.items():
        data[..., y, x] = value
    return data


@pytest.fixture
def run(tmp_path):
    """Reconstruct counts by the command; returns (exit code, stdout, stderr, volume, metrics, resolved)."""

    def reconstruct(data, *options, name="out", files=None, section=None, **reconstruction):
        write_stack(tmp_path / "stack.ome.tif", data)
        for file, array in (files or {}).items():
            tifffile.imwrite(tmp_path / file, array, photometric="minisblack")
        values = CONFIG | {"data": {"path": "stack.ome.tif", "offset": 100.0} | (section or {})}
        values["reconstruction"] = {"steps": 5} | reconstruction
        (tmp_path / "config.toml").write_text(tomli_w.dumps(values), encoding="utf-8")
        out, err, folder = io.StringIO(), io.StringIO(), tmp_path / name
        options = options or ("--restart",)
        with redirect_stdout(out), redirect_stderr(err):
            code = main(["reconstruct", str(tmp_path / "config.toml"), "--out", str(folder), *options])
        if code:
            return code, out.getvalue(), err.getvalue(), None, None, None
        volume, metrics = read_volume(folder / "volume.ome.tif")[0], json.loads((folder / "metrics.json").read_text())
        return code, out.getvalue(), err.getvalue(), volume, metrics, (folder / "config.resolved.toml").read_text()

    return reconstruct


@pytest.fixture(autouse=True)
def _fast(no_pictures):
    pass


METHODS = [
    {"method": "newton"},
    {"method": "linear"},
    *(pytest.param({"method": name}, marks=pytest.mark.slow, id=name) for name in ("adam", "opl")),
]
MISFITS = [pytest.param({"misfit": name}, marks=pytest.mark.slow, id=name) for name in ("poisson", "robust")]


@pytest.mark.parametrize("how", METHODS + MISFITS, ids=lambda how: next(iter(how.values())))
def test_what_a_stuck_pixel_held_changes_nothing(run, counts, how):
    camera = {"gain": 1.0} if how.get("misfit") == "poisson" else {}
    _, out, err, found, metrics, resolved = run(spoiled(counts), section=camera, **how)
    assert "warning" not in err
    line = "left out of the fit: 4 stuck pixels of the camera (0.42% of the stack)"
    assert line in out
    assert resolved.startswith(f"# {line}\n")
    assert metrics["left_out"] == {"stuck": 4, "saturated": 0, "masked": 0, "share": pytest.approx(4 / 960)}
    others = spoiled(counts, dict(zip(STUCK, (60000, 0, 2, 65535), strict=True)))
    _, _, _, again, other, _ = run(others, section=camera, **how)
    assert torch.equal(again, found)
    for key in ("misfit", "noise_misfit", "residual_rms", "prisms", "learned"):
        assert other[key] == metrics[key]
    _, _, _, clean, _, _ = run(counts, section=camera, **how)
    # a few steps on other noise; beside stuck pixels that count they differ by more than the whole
    assert float((found - clean).norm() / clean.norm()) < 0.15


def test_stuck_pixels_may_count(run, counts):
    _, out, _, found, metrics, resolved = run(spoiled(counts), section={"stuck": "none"})
    assert "left out" not in out
    assert metrics["left_out"]["stuck"] == 0
    assert 'stuck = "none"' in resolved
    _, _, _, clean, _, _ = run(counts)
    assert float((found - clean).norm() / clean.norm()) > 0.5


@pytest.mark.slow
def test_a_clean_stack_leaves_nothing_out(run, counts):
    _, out, _, found, metrics, resolved = run(counts)
    assert metrics["left_out"] == {"stuck": 0, "saturated": 0, "masked": 0, "share": 0.0}
    assert "left out" not in out + resolved
    _, _, _, trusted, _, _ = run(counts, section={"stuck": "none"})
    assert torch.equal(trusted, found)
    ones = np.ones(counts.shape[2:], np.uint8)
    _, _, _, masked, _, _ = run(counts, section={"mask": "mask.tif"}, files={"mask.tif": ones})
    assert torch.equal(masked, found)


@pytest.mark.parametrize(
    "shape", [(32, 30), *(pytest.param(shape, marks=pytest.mark.slow) for shape in ((3, 32, 30), (2, 3, 32, 30)))]
)
def test_what_the_users_mask_leaves_out_changes_nothing(run, counts, shape):
    mask = np.full(shape, 7, np.uint8)
    mask[..., 3:9, 20:28] = 0
    section, files = {"mask": "mask.tif"}, {"mask.tif": mask}
    _, out, _, found, metrics, _ = run(counts, section=section, files=files)
    assert metrics["left_out"]["masked"] == 6 * 48
    assert "288 masked pixels by the user (5.00% of the stack)" in out
    dirty = counts.copy()
    dirty[:, :, 3:9, 20:28] = np.random.default_rng(1).integers(0, 65000, (2, 3, 6, 8))
    _, _, _, again, _, _ = run(dirty, section=section, files=files)
    assert torch.equal(again, found)


def test_a_mask_of_another_shape_is_refused_in_one_line(run, counts):
    code, _, err, *_ = run(counts, section={"mask": "mask.tif"}, files={"mask.tif": np.ones((30, 32), np.uint8)})
    assert code == 2
    assert err.count("\n") == 1
    assert re.search(
        r"data\.mask: .*mask\.tif has 1 × 1 × 30 × 32 \(prism, focus, y, x\), the images of .* 2 × 3 × 32 × 30;", err
    )


def test_a_mask_that_leaves_nothing_is_refused_in_one_line(run, counts):
    code, _, err, *_ = run(counts, section={"mask": "mask.tif"}, files={"mask.tif": np.zeros((32, 30), np.uint8)})
    assert code == 2
    assert err.count("\n") == 1
    assert "no pixel of prism 1 counts" in err


def test_a_stack_of_which_most_is_saturated_is_refused_in_one_line(run, counts):
    """Nearly any volume would explain what is left; what the user's mask leaves out isn't counted."""
    data = spoiled(counts)
    data[1, :, :18] = 65535
    code, _, err, *_ = run(data)
    assert code == 2
    (line,) = [line for line in err.splitlines() if "error" in line]
    assert "of prism 2's pixels are saturated or stuck: at most 50% may be left out so" in line
    stack = Stack(data)
    mask = np.ones(data.shape, bool)
    mask[:, :, :18] = False
    assert left_out(stack, mask).share > 0.5


def test_another_mask_is_another_descent(run, counts, monkeypatch):
    mask, data = np.ones((32, 30), np.uint8), counts.copy()
    data[..., 3:9, 3:9] = 3900  # so that the prepared data are the same whichever of these pixels is left out
    mask[5, 5] = 0

    def interrupted():
        raise KeyboardInterrupt

    section = {"mask": "mask.tif", "flatten": False, "scale": 8000.0}
    monkeypatch.setattr(recorded, "signals_kept", lambda: nullcontext(interrupted))
    assert run(data, section=section, files={"mask.tif": mask})[0] == 130
    mask[5, 6] = 0
    code, _, err, *_ = run(data, "--resume", section=section, files={"mask.tif": mask})
    assert code == 2
    assert "mask's sha256 was" in err


def test_saturated_pixels_are_left_out_where_they_are_saturated(run, counts):
    data = counts.copy()
    data[0, 1, 14:17, 10] = 65535
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # 3 of 5760 are few
        _, out, _, _, metrics, _ = run(data)
    assert metrics["left_out"] == {"stuck": 0, "saturated": 3, "masked": 0, "share": pytest.approx(3 / 5760)}
    assert "3 saturated pixels" in out


def test_the_preparation_reads_no_pixel_that_is_left_out(counts):
    """Neither the background, flattened or not, nor the noise or the scale."""
    random, counted = np.random.default_rng(2), np.ones(counts.shape, bool)
    counted[:, :, 4:14, 4:14] = False
    counted[0, 1, 20:, :] = False
    expected = ExpectedStack((1.4, -1.2), FOCUS, (0.2, 0.2))
    dirty = np.where(counted, counts, random.integers(0, 60000, counts.shape).astype(np.uint16))
    for flatten in (True, False):
        ready = [
            prepare(Stack(data), expected, Normalisation(flatten, offset=100), left_out(Stack(data), counted))
            for data in (counts, dirty)
        ]
        assert np.array_equal(ready[0].data, ready[1].data)
        assert ready[0].prisms == ready[1].prisms
        clean = prepare(Stack(counts), expected, Normalisation(flatten, offset=100))
        assert ready[0].data[counted] == pytest.approx(clean.data[counted], rel=0.02)
        for found, whole in zip(ready[0].prisms, clean.prisms, strict=True):
            assert found.noise == pytest.approx(whole.noise, rel=0.1)
            assert found.background == pytest.approx(whole.background, rel=0.01)


def test_each_pixel_is_counted_for_one_reason():
    data = np.full((2, 3, 5, 6), 100, np.uint8)
    data[0, :, 1, 1:4] = 255
    mask, stuck = np.ones((5, 6), bool), np.zeros((5, 6), bool)
    mask[1, 1] = False
    stuck[1, 2] = True
    found = left_out(Stack(data), mask, stuck)
    assert (found.masked, found.stuck, found.saturated) == (6, 1, 3)
    assert found.share == pytest.approx((6 + 6 + 3) / 180)
    assert str(found) == (
        "left out of the fit: 1 stuck pixel of the camera, 3 saturated pixels, 6 masked pixels by the user "
        "(8.33% of the stack)"
    )
    assert found.counted is not None
    assert np.array_equal(found.counted, counted_pixels(Stack(data), mask, stuck))


def test_medians_are_of_what_is_known():
    planes = np.array([[[1.0, np.nan, 5.0]], [[2.0, np.nan, 7.0]], [[9.0, np.nan, np.nan]]])
    assert np.array_equal(median_of_known(planes), [[2.0, np.nan, 6.0]], equal_nan=True)


def test_the_nearest_pixel_that_counts_stands_in():
    values, counted = np.array([[1, 2, 3, 4, 5]]), np.array([[True, False, True, False, False]])
    assert nearest_counted(values, counted)[0, [0, 2, 3, 4]].tolist() == [1, 3, 3, 3]
    assert np.array_equal(nearest_counted(values, np.zeros((1, 5), bool)), values)


def test_a_relative_mask_starts_from_the_configurations_folder(tmp_path):
    values = CONFIG | {"data": {"path": "stack.tif", "mask": "masks/mask.tif"}}
    (tmp_path / "config.toml").write_text(tomli_w.dumps(values), encoding="utf-8")
    config = load(tmp_path / "config.toml")
    assert config.data is not None
    assert config.data.mask == str((tmp_path / "masks" / "mask.tif").resolve())
