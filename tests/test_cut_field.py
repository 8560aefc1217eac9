import math

import numpy as np
import pytest
import torch

from data_synthetic import Bead
from recon.recording.cut_field import margin_beyond, needed_margin, reaches_border
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BACKGROUND = 1.5
GRID = Grid((8, 40, 44), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.75), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), None, Prism((0.24, 0.0), -1.2)], [-1.0, 1.0])
MARGIN = 10


def recorded(centre, radius=1.0, noise=0.0):
    """Images (prism, focus, 40, 44) of a bead at a centre (y, x) in µm; of a field that may cut it."""
    wide = GRID.widened(MARGIN, MARGIN)
    delta = Bead(radius, 0.02, BACKGROUND, (0.2, *centre)).delta(wide, dtype=torch.float32)
    with torch.no_grad():
        images = image(Volume(wide, delta, BACKGROUND), MICROSCOPE, ACQUISITION, Fidelity(sources=12))
    within = slice(MARGIN, -MARGIN)
    data = images[..., within, within].numpy()
    return data + noise * np.random.default_rng(0).standard_normal(data.shape).astype(np.float32)


@pytest.mark.parametrize("noise", [0.0, 0.003, 0.02])
def test_a_specimen_inside_does_not_reach_the_border(noise):
    data = recorded((0.2, -0.3), noise=noise)
    assert not reaches_border(data, [noise] * 3)
    assert not reaches_border(data)
    assert needed_margin(data, [noise] * 3, GRID, MICROSCOPE, BACKGROUND) == 0


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("centre", [(4.0, 0.5), (-4.0, 0.5), (0.5, 4.4), (0.5, -4.4), (3.6, 4.0)])
def test_a_specimen_that_one_side_cuts_is_found(centre, noise):
    data = recorded(centre, noise=noise)
    assert reaches_border(data, [noise] * 3)
    assert reaches_border(data)
    assert needed_margin(data, None, GRID, MICROSCOPE, BACKGROUND) > 0


def test_a_specimen_that_fills_the_field_is_found():
    assert reaches_border(recorded((0.0, 0.0), radius=8.0))


def test_a_specimen_at_the_border_beside_a_stronger_one_inside_is_found():
    assert reaches_border(recorded((0.0, 0.0)) + 0.5 * (recorded((0.3, 4.4)) - recorded((0.0, 20.0))))


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_does_not_reach_the_border(seed):
    data = 0.5 + 0.02 * np.random.default_rng(seed).standard_normal((2, 9, 64, 61))
    assert not reaches_border(data, [0.02, 0.02])
    assert not reaches_border(data)


def test_a_border_below_the_noise_is_not_found():
    """A hundredth of contrast under noise of a tenth."""
    data = recorded((4.0, 0.5))
    assert not reaches_border(data, [float(np.ptp(data))] * 3)


def test_stuck_pixels_at_the_border_are_no_specimen():
    data = recorded((0.2, -0.3))
    data[:, :, 0, 7] = 5.0
    data[:, :, 20, -1] = 0.0
    data[:, :, -1, -1] = 5.0
    assert not reaches_border(data)


def test_one_prism_that_shows_it_is_enough():
    """A shear along the border shows little of a specimen that is cut there."""
    data = recorded((4.0, 0.5))
    inside = recorded((0.2, -0.3))
    inside[2] = data[2]
    assert reaches_border(inside)


def test_the_unit_plays_no_part():
    for data in (recorded((4.0, 0.5), noise=0.01), recorded((0.2, -0.3), noise=0.01)):
        assert reaches_border(1000 * data + 30, [10.0] * 3) == reaches_border(data, [0.01] * 3)


def test_images_without_a_frame_and_unlike_noises_are_refused():
    with pytest.raises(ValueError, match="7 × 9 pixels have no frame"):
        reaches_border(np.ones((1, 1, 7, 9)))
    with pytest.raises(ValueError, match="noise has 2 values for 3 prisms"):
        reaches_border(recorded((0.2, -0.3)), [0.1, 0.1])


# the margin


def test_a_margin_is_the_lateral_spread_of_half_the_depth():
    """½·depth·tanθ of the wider aperture, in voxels of the narrower side."""
    grid = Grid((10, 200, 210), (0.4, 0.2, 0.21))
    for objective, condenser in ((0.9, 0.7), (0.6, 0.7), (0.9, None)):
        microscope = Microscope(0.546, Objective(objective), None if condenser is None else Condenser(condenser))
        angle = math.asin(max(objective, condenser or 0.0) / BACKGROUND)
        assert margin_beyond(grid, microscope, BACKGROUND) == math.ceil(2.0 * math.tan(angle) / 0.2)


def test_a_margin_is_a_third_of_the_shorter_side_at_most():
    grid = Grid((31, 96, 90), (0.3, 0.1, 0.1))
    assert margin_beyond(grid, Microscope(0.546, Objective(1.33), Condenser(0.9)), 1.335) == 30
    assert margin_beyond(grid, Microscope(0.546, Objective(1.335)), 1.335) == 30


def test_axial_light_without_a_pupil_spreads_nowhere():
    assert margin_beyond(GRID, Microscope(0.546), BACKGROUND) == 0
