import pytest
import torch

from data_synthetic import GaussianBall
from recon.fit.start import linear_start
from recon.report.metrics import volume_error
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BACKGROUND = 1.5
GRID = Grid((6, 24, 20), (0.5, 0.2, 0.19))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
PRISMS = (Prism((0.0, 0.2), 1.3), Prism((0.2, 0.0), -1.3))
FOCUS = (-1.5, -0.75, 0.0, 0.75, 1.5)


def images(delta, prisms=PRISMS, focus=FOCUS, microscope=MICROSCOPE, grid=GRID):
    acquisition = Acquisition(prisms, focus)
    with torch.no_grad():
        made = image(Volume(grid, delta, BACKGROUND), microscope, acquisition, Fidelity(sources=24))
    return made, acquisition


def two_balls(contrast, dtype=torch.float32):
    """Unequal balls off the centre along every axis: no swapped or mirrored axis leaves them alike."""
    one = GaussianBall(0.45, contrast, BACKGROUND, (0.5, -0.9, 0.7))
    other = GaussianBall(0.35, contrast / 2, BACKGROUND, (-0.75, 1.1, -0.8))
    return one.delta(GRID, dtype=dtype) + other.delta(GRID, dtype=dtype)


@pytest.mark.parametrize("sign", [1, -1])
def test_the_start_is_most_of_a_weak_specimen_with_its_sign(sign):
    truth = two_balls(sign * 2e-3)
    data, acquisition = images(truth)
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert start.shape == GRID.shape
    assert start.dtype == torch.float32
    assert volume_error(start, truth) < 0.6
    for axis in range(3):  # mirrored along any axis it is a worse one
        assert volume_error(start.flip(axis), truth) > 1
    overlap = (start * truth).sum() / (start.norm() * truth.norm())
    assert float(overlap) > 0.8


def test_the_start_is_right_in_the_place_of_the_strongest_voxel():
    truth = two_balls(2e-3)
    data, acquisition = images(truth)
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    peak, found = (torch.unravel_index(v.argmax(), GRID.shape) for v in (truth, start))
    assert all(abs(int(a) - int(b)) <= 1 for a, b in zip(peak, found, strict=True))


def test_the_start_is_linear_in_the_data():
    data, acquisition = images(two_balls(2e-3))
    empty, _ = images(torch.zeros(GRID.shape))
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    half = linear_start(empty + (data - empty) / 2, GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert volume_error(2 * half, start) < 1e-3


def test_an_axis_of_the_stack_rolled_rolls_the_start():
    data, acquisition = images(two_balls(2e-3))
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    rolled = linear_start(data.roll((3, -4), (2, 3)), GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert volume_error(rolled, start.roll((3, -4), (1, 2))) < 1e-4


def test_a_strong_specimens_start_has_the_right_order_of_magnitude():
    truth = two_balls(0.03)
    data, acquisition = images(truth)
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert volume_error(start, truth) < 0.9


@pytest.mark.parametrize(
    ("prisms", "focus"),
    [(PRISMS, (0.0,)), (PRISMS[:1], FOCUS), ((None,), FOCUS), ((Prism((0.1, 0.2), -0.4),), (0.3,))],
    ids=["one plane", "one prism", "bright field", "one image"],
)
def test_fewer_images_still_start_finite_and_on_the_right_side(prisms, focus):
    truth = two_balls(2e-3)
    data, acquisition = images(truth, prisms, focus)
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert bool(torch.isfinite(start).all())
    assert float((start * truth).sum()) > 0
    assert float(start.norm()) < 3 * float(truth.norm())


def test_float64_data_give_a_float64_start_close_to_float32s():
    truth = two_balls(2e-3, torch.float64)
    data, acquisition = images(truth)
    start = linear_start(data, GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert start.dtype == torch.float64
    single = linear_start(data.float(), GRID, BACKGROUND, MICROSCOPE, acquisition)
    assert volume_error(single.double(), start) < 0.02


def test_one_slice_of_one_coherent_source_has_a_start():
    grid = Grid((1, 20, 16), (0.5, 0.2, 0.2))
    microscope = Microscope(0.546, Objective(0.8))
    truth = GaussianBall(0.45, 2e-3, BACKGROUND, (0.0, -0.5, 0.4)).delta(grid, dtype=torch.float32)
    data, acquisition = images(truth, PRISMS, (0.0,), microscope, grid)
    start = linear_start(data, grid, BACKGROUND, microscope, acquisition)
    # a uniform Δn is invisible: compare without the mean
    assert volume_error(start - start.mean(), truth - truth.mean()) < 0.4
