"""A camera's dead, hot and stuck pixels are found, and nothing of a specimen is taken for one."""

import math

import numpy as np
import pytest
import torch

from data_synthetic import Bead
from recon.recording.stuck_pixels import sharpest, stuck_pixels
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

GRID = Grid((10, 32, 36), (0.3, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.6))
USUAL = ((0.0, 0.24), (0.24, 0.0))
RATIO = sharpest(MICROSCOPE, (0.2, 0.2), 1.36)


def recorded(*beads, bias=1.4, focus=(-1.0, 0.0, 1.0), noise=0.0, microscope=MICROSCOPE):
    """Images (prism, focus, y, x) of beads on pixels that integrate, each the mean of 2 × 2 finer ones."""
    nz, ny, nx = GRID.shape
    fine = Grid((nz, 2 * ny, 2 * nx), (0.3, 0.1, 0.1))
    delta = sum(bead.delta(fine, dtype=torch.float32) for bead in beads)
    acquisition = Acquisition([Prism(shear, bias) for shear in USUAL], list(focus))
    with torch.no_grad():
        images = image(Volume(fine, delta, 1.36), microscope, acquisition, Fidelity(sources=12, order=1))
    data = images.unflatten(3, (nx, 2)).unflatten(2, (ny, 2)).mean((3, 5)).numpy()
    return data + noise * np.random.default_rng(0).standard_normal(data.shape).astype(np.float32)


SCENES = {
    "a large bead": (Bead(1.6, 0.05, 1.36, (0.2, 0.3, -0.2)),),
    "a strong small bead in a pixel's middle": (Bead(0.15, 0.2, 1.36, (0.0, 0.1, 0.1)),),
    "a strong small bead between pixels": (Bead(0.15, 0.2, 1.36),),
    "two small beads": (Bead(0.2, 0.1, 1.36, (0.0, 0.1, 0.1)), Bead(0.2, 0.1, 1.36, (0.0, 0.5, 0.5))),
    # a fine fibre, 0.24 µm thick
    "a fine fibre": tuple(Bead(0.12, 0.15, 1.36, (0.0, 0.1, 0.1 * i)) for i in range(-20, 21, 2)),
}


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    return recorded(*SCENES[request.param])


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_no_pixel_of_a_specimen_is_stuck(scene, noise):
    data = scene + noise * np.random.default_rng(1).standard_normal(scene.shape)
    assert not stuck_pixels(data, RATIO).any()
    assert not stuck_pixels(data[:1], RATIO).any()
    assert not stuck_pixels(data[:1, 1:2], RATIO).any()  # in focus alone nothing but the pass-band tells


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_dead_hot_and_stuck_pixels_are_found_and_no_others(scene, noise):
    """At the border, in the corner, beside one another and on the specimen too."""
    data = scene + noise * np.random.default_rng(1).standard_normal(scene.shape)
    level = float(np.median(data))
    places = {(0, 0): 0.0, (1, 1): 3 * level, (31, 20): 2 * level, (12, 35): 0.0, (16, 18): 3 * level}
    for (y, x), value in places.items():
        data[..., y, x] = value
    data[..., 24, 9:11] += level  # two hot ones, which add to the light
    found = {(int(y), int(x)) for y, x in np.argwhere(stuck_pixels(data, RATIO))}
    assert found == {*places, (24, 9), (24, 10)}


def test_a_pixel_that_stands_out_in_some_images_alone_is_not_stuck():
    """Dust that moves, or a cosmic ray."""
    data = np.full((2, 5, 20, 20), 1000.0) + np.random.default_rng(0).standard_normal((2, 5, 20, 20))
    data[0, 2, 7, 8] = 4000.0
    data[1, :, 12, 8] = 4000.0
    assert not stuck_pixels(data, RATIO).any()
    data[:, :, 12, 8] = 4000.0
    assert np.argwhere(stuck_pixels(data, RATIO)).tolist() == [[12, 8]]


@pytest.mark.parametrize("shape", [(2, 5, 64, 64), (1, 1, 200, 200)])
def test_noise_alone_has_no_stuck_pixels(shape):
    random = np.random.default_rng(3)
    for data in (random.standard_normal(shape), random.poisson(5.0, shape), random.random(shape)):
        assert not stuck_pixels(data, 4.0).any()


def test_what_the_user_has_left_out_says_nothing():
    data = recorded(Bead(1.0, 0.03, 1.36), noise=0.005)
    counted = np.ones(data.shape, bool)
    counted[..., 8:14, 8:14] = False
    data[~counted] = np.random.default_rng(0).uniform(0, 50, int((~counted).sum()))
    data[..., 20, 20] = 3.0
    assert np.argwhere(stuck_pixels(data, RATIO, counted)).tolist() == [[20, 20]]


def test_images_too_small_for_neighbours_have_no_stuck_pixels():
    data = np.ones((1, 2, 4, 9))
    data[..., 2, 4] = 9.0
    assert not stuck_pixels(data, RATIO).any()


def test_a_spot_is_as_sharp_as_the_objective_permits():
    """The share of a small spot's light on the next pixel, against the Airy pattern summed on fine points."""
    fine = (np.arange(-300, 300) + 0.5) / 1000  # µm: three pixels of 0.2
    v = 2 * math.pi * 0.9 * np.hypot(fine[:, None], fine) / 0.546
    bessel = sum((-1) ** k * (v / 2) ** (2 * k + 1) / math.factorial(k) / math.factorial(k + 1) for k in range(20))
    parts = ((2 * bessel / v) ** 2).reshape(3, 200, 3, 200).sum((1, 3))
    assert sharpest(MICROSCOPE, (0.1, 0.2), 1.36) == pytest.approx(2 * parts[1, 1] / parts[1, 2], rel=1e-3)
    assert sharpest(MICROSCOPE, (0.01, 0.01), 1.36) == 4.0
    assert sharpest(MICROSCOPE, (150.0, 150.0), 1.36) == 20.0  # nm that were taken for µm; no integral warns
    assert sharpest(MICROSCOPE, (2.0, 2.0), 1.36) == sharpest(Microscope(0.546), (0.2, 0.2), 1.36) == 20.0
