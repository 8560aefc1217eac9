"""The scenes of `python benchmarks/scenes.py`: known specimens, images of no model that fits them, and their noise."""

import importlib
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from data_synthetic import Bead, Ellipsoid
from torchdic import Acquisition, Fidelity, Grid, Prism, Volume, image

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
GRID = Grid((6, 24, 20), (0.4, 0.2, 0.2))
ONE_PLANE = Acquisition([Prism((0.0, 0.24), math.pi / 2), Prism((0.24, 0.0), -0.5)], [0.5])


@pytest.fixture(scope="module")
def scenes():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("scenes")
        for name in ("scenes", "specimens"):
            patch.delitem(sys.modules, name)


@pytest.fixture(scope="module")
def truths(scenes):
    """Every scene by its name, with its true Δn, each made once."""
    setups = {name: make() for name, make in scenes.SETUPS.items()}
    return {name: (setup, setup.truth()) for name, setup in setups.items()}


@pytest.fixture(scope="module")
def specimens(scenes):
    return sys.modules["specimens"]


@pytest.fixture(scope="module")
def small(scenes, specimens):
    """A weak bead of the finer model, small enough for a test."""
    beads = specimens.Together((Bead(0.7, 0.01, 1.36, (0.1, 0.2, -0.3)),))
    return scenes.Setup("beads", beads, GRID, acquisition=ONE_PLANE, margin=8, sources=50)


def test_truth_holds_the_specimens_volume(small):
    volume = math.prod(GRID.spacing) * float(small.truth().double().sum())
    # columns of 0.025 µm sample the bead; the rim's error is below their share of its section
    assert volume == pytest.approx(0.01 * Ellipsoid((0.7, 0.7, 0.7)).volume, rel=0.01)


def test_fibre_covers_a_cylinder_and_two_hemispheres(specimens):
    fibre = specimens.Fibre(0.6, 2.0, 0.02, 1.36, 0.7, (0.2, 0.1, -0.3))
    volume = math.prod(GRID.spacing) * float(fibre.delta(GRID).sum())
    assert volume == pytest.approx(0.02 * math.pi * 0.6**2 * (2.0 + 4 / 3 * 0.6), rel=0.01)


def test_fibre_lies_along_its_angle(specimens):
    along = specimens.Fibre(0.3, 2.4, 0.02, 1.36, math.pi / 2).delta(GRID).sum(0)
    y, x = (GRID.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    assert float((along.sum(1) * y.square()).sum()) > 5 * float((along.sum(0) * x.square()).sum())


def test_graded_ellipsoid_holds_two_fifths_of_a_solid_one(specimens):
    fine = Grid((40, 80, 80), (0.1, 0.05, 0.05))
    shape = Ellipsoid((1.2, 1.5, 1.8))
    graded = specimens.GradedEllipsoid(shape, 0.03, 1.36).delta(fine).sum() * math.prod(fine.spacing)
    assert float(graded) == pytest.approx(0.4 * 0.03 * shape.volume, rel=2e-3)


def test_stronger_cell_is_the_cell_times_the_factor(scenes, specimens):
    grid = Grid((10, 24, 24), (0.6, 0.4, 0.4))
    torch.testing.assert_close(specimens.stronger(scenes.CELL, 3).delta(grid), 3 * scenes.CELL.delta(grid))


def test_specimens_in_two_media_are_refused(specimens):
    with pytest.raises(ValueError, match=r"media of index \[1.36, 1.45\]: there must be one medium"):
        specimens.Together((Bead(0.5, 0.01, 1.36), Bead(0.5, 0.01, 1.45)))


def test_finer_model_and_exact_field_agree(small):
    """Of a weak bead, whose images both methods know; each is computed on its own way to the recorded pixels."""
    (bead,) = small.specimen.parts
    exact = replace(small, specimen=bead).images()
    contrast = exact.std((2, 3), correction=0)
    # 0.020 and 0.012, of which a wider margin takes a third: a sharp edge in voxels errs by about 0.01
    assert float(((small.images() - exact).square().mean((2, 3)).sqrt() / contrast).max()) < 0.025


@pytest.mark.filterwarnings("ignore::torchdic.SamplingWarning")  # of the coarse voxels that a reconstruction has
def test_images_are_not_those_of_the_model_that_fits_them(small):
    images = small.images()
    volume = Volume(GRID, small.truth(), 1.36)
    fitted = image(volume, small.microscope, small.acquisition, Fidelity("wave", sources=40))
    error = (images - fitted).square().mean((2, 3)).sqrt() / images.std((2, 3), correction=0)
    assert float(error.min()) > 0.01


@pytest.mark.slow
def test_images_don_t_depend_on_the_margin(small):
    """Nothing that reaches the recorded field comes from the other side of the simulated one."""
    images, wider = replace(small, margin=16).images(), replace(small, margin=24).images()
    difference = (images - wider).square().mean((2, 3)).sqrt() / wider.std((2, 3), correction=0)
    assert float(difference.max()) < 0.01


def test_noise_has_the_standard_deviation_that_the_scene_states(small):
    clean = replace(small, photons=None).scene("clean")
    assert clean.noise == (0.0, 0.0)
    assert clean.noise_misfit == 0.0
    noisy = replace(small, photons=900.0).scene("noisy")
    found = (noisy.data - clean.data).square().mean((1, 2, 3)).sqrt()
    # of 480 pixels the standard deviation is known to 1/√960, three times over
    torch.testing.assert_close(found, torch.tensor(noisy.noise), rtol=3 / math.sqrt(960), atol=0.0)
    assert 0 < noisy.noise_misfit < 1


def test_kept_images_are_those_that_were_computed(small, tmp_path):
    small = replace(small, sources=8)
    first, again = (small.scene("kept", tmp_path) for _ in range(2))
    assert len(list(tmp_path.iterdir())) == 1
    for kept in (first, again):
        torch.testing.assert_close(kept.data, small.scene("computed").data, rtol=0, atol=0)
        torch.testing.assert_close(kept.truth, small.truth(), rtol=0, atol=0)


def test_what_changes_the_images_changes_the_fingerprint(small):
    others = [
        replace(small, specimen=Bead(0.7, 0.011, 1.36)),
        replace(small, grid=Grid((6, 24, 20), (0.4, 0.2, 0.21))),
        replace(small, acquisition=Acquisition(ONE_PLANE.prisms, [0.6])),
        replace(small, sources=40),
    ]
    assert len({setup.fingerprint for setup in (small, *others)}) == 5
    assert replace(small, photons=7.0, seed=3).fingerprint == small.fingerprint


def test_unknown_scene_is_refused(scenes):
    with pytest.raises(ValueError, match="scene 'moon' must be one of 'two beads'"):
        scenes.scene("moon")


def test_every_specimen_leaves_a_margin_unless_its_field_is_cut(truths):
    for name, (_, truth) in truths.items():
        delta = truth.abs()
        rim = torch.cat([delta[:, [0, -1]].flatten(), delta[:, :, [0, -1]].flatten(), delta[[0, -1]].flatten()])
        # a Gaussian ball never ends: 1e-3 of it is left at the faces of its box
        assert (float(rim.max()) > 0.01 * float(delta.max())) == (name == "yeast"), name


def assert_admitted(setup, truth):
    low, high = setup.bounds
    assert low is None or float(truth.min()) >= low - 1e-8
    assert high is None or float(truth.max()) <= high + 1e-8


def test_every_bound_admits_the_truth(truths):
    for setup, truth in truths.values():
        assert_admitted(setup, truth)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_bounds_of_drawn_scenes_admit_their_truth(scenes, seed):
    setup = scenes.drawn_setup(seed)
    assert_admitted(setup, setup.truth())


def test_drawn_scenes_differ_and_repeat(scenes):
    drawn = [scenes.drawn_setup(seed) for seed in range(30)]
    assert len({setup.fingerprint for setup in drawn}) == 30
    assert {setup.kind for setup in drawn} == {f"drawn {k}" for k in ("beads", "cell", "fibres", "graded", "lower")}
    assert scenes.drawn_setup(7).fingerprint == drawn[7].fingerprint


def test_drawn_optics_stay_within_their_limits(scenes):
    for seed in range(30):
        setup = scenes.drawn_setup(seed)
        na, condenser = setup.microscope.objective.na, setup.microscope.condenser.na
        assert 0.6 <= na <= 1.3
        assert na < setup.specimen.background
        assert 0.3 * na <= condenser <= 0.9 * na
        assert 0.5 <= setup.microscope.wavelength <= 0.6
        assert 500 <= setup.photons <= 40000
        assert 5 <= len(setup.acquisition.focus) <= 15
        assert all(0.12 <= math.hypot(*prism.shear) <= 0.3 for prism in setup.acquisition.prisms)
