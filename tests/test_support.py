"""Δn is sought within a support: from a mask, or from the edges that are in focus."""

import io
import json
from contextlib import nullcontext, redirect_stderr, redirect_stdout

import numpy as np
import pytest
import tifffile
import tomli_w
import torch

from data_synthetic import Bead
from recon.cli import main
from recon.descend import Problem, Recipe, minimise
from recon.fit.bounds import Bounds, SupportedBounds
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.support import edges_support
from recon.run import recorded
from recon.run.room import held_beside_images
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import read_volume, write_stack

GRID = Grid((8, 32, 30), (0.5, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
FOCUS = (-1.5, -0.5, 0.5, 1.5)
PRISMS = (((0.0, 0.24), 1.4), ((0.24, 0.0), -1.2))
ACQUISITION = Acquisition([Prism(s, b) for s, b in PRISMS], FOCUS)
FIDELITY = Fidelity("wave", sources=6, order=1)
BEAD = Bead(0.9, 0.02, 1.45, (0.2, 0.3, -0.6))


def images_of(bead=BEAD, noise=0.005):
    with torch.no_grad():
        images = image(Volume(GRID, bead.delta(GRID, dtype=torch.float32), 1.45), MICROSCOPE, ACQUISITION, FIDELITY)
    return images + noise * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))


def fitted(data, support, method, steps=6, **recipe):
    setup = Setup(empty_medium(GRID, 1.45, data), MICROSCOPE, ACQUISITION)
    problem = Problem.from_recipe(data, setup, FIDELITY, Recipe(method, steps, **recipe), support=support)
    last = None
    for step in minimise(problem):
        last = step
    assert last is not None
    return last.delta


@pytest.fixture(scope="module")
def data():
    return images_of()


@pytest.fixture(scope="module")
def half():
    """The lower half of the slices, and not all of these: some of the bead is outside."""
    support = torch.zeros(GRID.shape, dtype=torch.bool)
    support[4:, 5:25, 4:20] = True
    return support


@pytest.mark.parametrize("bounds", [Bounds(), Bounds(None, None), Bounds(0.001, 0.05), Bounds(None, 0.0)])
@pytest.mark.parametrize("method", ["newton", "adam"])
def test_outside_the_support_delta_is_exactly_0(data, half, method, bounds):
    found = fitted(data, half, method, bounds=bounds)
    assert bool((found[~half] == 0).all())
    assert bool((found[half] != 0).any())


@pytest.mark.parametrize("method", ["newton", "adam"])
def test_a_support_that_is_everywhere_changes_nothing_bit_for_bit(data, method):
    everywhere = torch.ones(GRID.shape, dtype=torch.bool)
    assert torch.equal(fitted(data, everywhere, method), fitted(data, None, method))


@pytest.mark.parametrize("bounds", [(0.0, None), (None, None), (-0.01, 0.03), (None, 0.0)])
def test_gradients_are_those_of_differences_within_the_support_and_0_outside(bounds):
    random = torch.Generator().manual_seed(1)
    parameter = 0.01 * torch.randn(2, 3, 4, dtype=torch.float64, generator=random).requires_grad_()
    support = torch.rand(2, 3, 4, generator=random) > 0.4
    within = SupportedBounds(*bounds, support)
    assert torch.autograd.gradcheck(within.delta, (parameter.detach().requires_grad_(),))
    free = parameter.detach().clone().requires_grad_()
    (gradient,) = torch.autograd.grad(within.delta(free).square().sum(), free)
    (plain,) = torch.autograd.grad(Bounds(*bounds).delta(free).square().sum(), free)
    assert torch.equal(gradient, torch.where(support, plain, 0))


def test_a_support_that_means_nothing_is_refused(data):
    with pytest.raises(ValueError, match=r"the support has shape \(8, 32, 31\), the field \(8, 32, 30\)"):
        fitted(data, torch.ones(8, 32, 31, dtype=torch.bool), "newton")
    with pytest.raises(ValueError, match="the support holds no voxel"):
        fitted(data, torch.zeros(GRID.shape, dtype=torch.bool), "newton")


def test_in_a_margin_the_support_goes_on(data, half):
    support = torch.zeros(GRID.shape, dtype=torch.bool)
    support[:, :10] = True
    setup = Setup(empty_medium(GRID.widened(4, 4), 1.45, data), MICROSCOPE, ACQUISITION, margin=4)
    problem = Problem.from_recipe(data, setup, FIDELITY, Recipe(), support=support)
    assert problem.support is not None
    assert problem.support.shape == (8, 40, 38)
    assert bool(problem.support[:, :14].all())
    assert not bool(problem.support[:, 14:].any())


# from edges


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.01])
@pytest.mark.parametrize("centre", [(0.2, 0.3, -0.6), (-0.8, -1.4, 1.2), (0.0, 3.0, 0.0)])
def test_the_support_of_edges_holds_the_specimen_and_is_smaller_than_the_volume(centre, noise):
    """Also of one that the field's edge cuts."""
    bead = Bead(0.9, 0.04, 1.45, centre)
    support = edges_support(images_of(bead, noise).numpy(), FOCUS, GRID, MICROSCOPE, 1.45)
    assert bool(support[bead.delta(GRID).numpy() > 0].all())
    assert support.mean() < 0.7


def test_the_order_of_planes_and_the_unit_play_no_part(data):
    found = edges_support(data.numpy(), FOCUS, GRID, MICROSCOPE, 1.45)
    assert np.array_equal(edges_support(data.numpy()[:, ::-1], FOCUS[::-1], GRID, MICROSCOPE, 1.45), found)
    assert np.array_equal(edges_support(64 * data.numpy(), FOCUS, GRID, MICROSCOPE, 1.45), found)


def test_images_without_edges_have_support_everywhere():
    assert edges_support(np.full((2, 4, 32, 30), 0.5), FOCUS, GRID, MICROSCOPE, 1.45).all()


# by the command


@pytest.fixture
def run(tmp_path, data, no_pictures):
    def reconstruct(*options, support=None, mask=None, **reconstruction):
        write_stack(tmp_path / "stack.ome.tif", data.numpy())
        if mask is not None:
            tifffile.imwrite(tmp_path / "mask.tif", mask, photometric="minisblack")
        values = {
            "volume": {"shape": list(GRID.shape), "spacing": list(GRID.spacing), "background": 1.45},
            "microscope": {"wavelength": 0.546, "objective": {"na": 0.8}, "condenser": {"na": 0.5}},
            "acquisition": {"focus": list(FOCUS), "prisms": [{"shear": list(s), "bias": b} for s, b in PRISMS]},
            "fidelity": {"sources": 6, "order": 1},
            "data": {"path": "stack.ome.tif"},
            "reconstruction": {"steps": 3} | ({} if support is None else {"support": support}) | reconstruction,
        }
        (tmp_path / "config.toml").write_text(tomli_w.dumps(values), encoding="utf-8")
        out, err, folder = io.StringIO(), io.StringIO(), tmp_path / "out"
        with redirect_stdout(out), redirect_stderr(err):
            code = main(["reconstruct", str(tmp_path / "config.toml"), "--out", str(folder), *options])
        if code:
            return code, out.getvalue(), err.getvalue(), None, {}
        found = read_volume(folder / "volume.ome.tif")[0]
        return code, out.getvalue(), err.getvalue(), found, json.loads((folder / "metrics.json").read_text())

    return reconstruct


@pytest.mark.parametrize("method", ["newton", "adam", "linear"])
def test_a_masks_support_holds_in_every_method(run, half, method):
    mask = half.numpy().astype(np.uint8)
    code, out, _, found, metrics = run(support="mask.tif", mask=mask, method=method)
    assert code == 0
    assert bool((found[~half] == 0).all())
    assert bool((found[half] != 0).any())
    assert metrics["support"]["share"] == pytest.approx(mask.mean())
    assert "of the voxels (support = " in out


def test_a_plane_mask_is_that_of_every_slice(run):
    mask = np.zeros(GRID.shape[1:], np.uint8)
    mask[8:24, 6:22] = 1
    _, _, _, found, metrics = run(support="mask.tif", mask=mask)
    assert bool((found[:, mask == 0] == 0).all())
    assert metrics["support"]["share"] == pytest.approx(mask.mean())


def test_edges_are_the_support_where_asked_for(run, data):
    _, out, _, found, metrics = run(support="edges")
    assert "(support = edges)" in out
    support = edges_support(data.numpy(), FOCUS, GRID, MICROSCOPE, 1.45)
    assert bool((found[~torch.from_numpy(support)] == 0).all())
    assert metrics["support"]["share"] == pytest.approx(support.mean())
    assert "support" not in run()[4]


def test_another_support_is_another_descent(run, half, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    mask = half.numpy().astype(np.uint8)
    monkeypatch.setattr(recorded, "signals_kept", lambda: nullcontext(interrupted))
    assert run(support="mask.tif", mask=mask)[0] == 130
    mask[5, 6, 7] = 0
    code, _, err, *_ = run("--resume", support="mask.tif", mask=mask)
    assert code == 2
    assert "support's sha256 was" in err


@pytest.mark.parametrize("shape", [(8, 30, 32), (4, 32, 30), (30, 32), (2, 8, 32, 30)])
def test_a_mask_of_another_shape_than_the_volumes_is_refused_in_one_line(run, shape):
    code, _, err, *_ = run(support="mask.tif", mask=np.ones(shape, np.uint8))
    assert code == 2
    assert err.count("\n") == 1
    assert "reconstruction.support: " in err
    assert "the volume has 8×32×30" in err


def test_an_empty_mask_and_a_method_without_voxels_are_refused_in_one_line(run):
    for said, changes in (
        ("holds no voxel", {"mask": np.zeros(GRID.shape, np.uint8)}),
        ("a path length by section has none", {"mask": np.ones(GRID.shape, np.uint8), "method": "opl"}),
    ):
        code, _, err, *_ = run(support="mask.tif", **changes)
        assert code == 2
        assert err.count("\n") == 1
        assert said in err


@pytest.mark.slow
def test_memory_is_foreseen_with_a_support():
    """On few voxels, whose support is another."""
    grid = Grid((4, 48, 44), (0.5, 0.2, 0.2))
    data = 1 + 0.1 * torch.rand(2, 4, 48, 44)
    setup, half = Setup(empty_medium(grid, 1.45, data), MICROSCOPE, ACQUISITION), torch.ones(grid.shape) > 0
    half[:2] = False
    for method in ("newton", "adam"):
        problem = Problem.from_recipe(data, setup, FIDELITY, Recipe(method), support=half)
        assert held_beside_images(problem, GaussianMisfit, FIDELITY) > half.numel()
