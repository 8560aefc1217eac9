"""Values and gradients between voxel centres."""

import math

import pytest
import torch

from torchdic import Acquisition, Fidelity, Grid, Prism, Volume, image
from torchdic.specimen.interpolation import SliceSampler, depth_weights, shares, spline_coefficients, window

GRID = Grid((6, 9, 11), (0.5, 0.2, 0.3))
BOTH = pytest.mark.parametrize("interpolation", ["linear", "cubic"])


def sampler(grid, field, interpolation):
    slices = spline_coefficients(field) if interpolation == "cubic" else field
    return SliceSampler(grid, slices.unbind(0), interpolation)


def random_places(count=200, reach=0.9):
    half_y, half_x = 0.8 * reach, 1.5 * reach
    return half_y * (2 * torch.rand(count).double() - 1), half_x * (2 * torch.rand(count).double() - 1)


@BOTH
def test_field_is_the_voxels_value_at_its_centre(interpolation):
    field = torch.randn(GRID.shape, dtype=torch.float64)
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    for i in range(6):
        value, _, _ = sampler(GRID, field, interpolation).sample(GRID.centre(0, i), y, x)
        torch.testing.assert_close(value, field[i], rtol=0, atol=1e-12)
        alone = sampler(GRID, field, interpolation).value(GRID.centre(0, i), y, x)
        torch.testing.assert_close(alone, value, rtol=0, atol=1e-14)


@BOTH
def test_ramp_and_its_gradient_are_exact_away_from_the_sides(interpolation):
    """A swapped axis or spacing would show. The spline's zero slope at the sides fades as 0.27^voxels."""
    grid = Grid((6, 61, 63), (0.5, 0.2, 0.3))
    z, y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in range(3)), indexing="ij")
    field = 0.3 + 0.7 * y - 1.1 * x + (0.2 * z if interpolation == "linear" else 0)
    py, px = random_places()
    value, slope_y, slope_x = sampler(grid, field, interpolation).sample(0.37, py, px)
    expected = 0.3 + 0.7 * py - 1.1 * px + (0.2 * 0.37 if interpolation == "linear" else 0)
    torch.testing.assert_close(value, expected, rtol=0, atol=1e-10)
    torch.testing.assert_close(slope_y, torch.full_like(py, 0.7), rtol=0, atol=1e-10)
    torch.testing.assert_close(slope_x, torch.full_like(px, -1.1), rtol=0, atol=1e-10)


@pytest.mark.parametrize(("interpolation", "value_order", "slope_order"), [("linear", 2, 2), ("cubic", 4, 3)])
def test_interpolation_has_its_order(interpolation, value_order, slope_order):
    py, px = random_places(2000, 0.5)

    def errors(n):
        grid = Grid((n, n, n), (6 / n, 6 / n, 6 / n))
        z, y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in range(3)), indexing="ij")

        def gauss(z, y, x):
            return torch.exp(-(z**2) - (y - 0.2) ** 2 / 0.8 - x**2)

        found = sampler(grid, gauss(z, y, x), interpolation)
        squares = torch.zeros(2, dtype=torch.float64)
        for depth in torch.linspace(-0.8, 0.8, 17, dtype=torch.float64):
            value, slope_y, slope_x = found.sample(float(depth), py, px)
            exact = gauss(depth, py, px)
            slopes = torch.stack((slope_y + 2 * (py - 0.2) / 0.8 * exact, slope_x + 2 * px * exact))
            squares += torch.stack(((value - exact).square().sum(), slopes.square().sum()))
        return squares.sqrt().tolist()

    coarse, fine = errors(30), errors(60)
    assert math.log2(coarse[0] / fine[0]) == pytest.approx(value_order, abs=0.5)
    assert math.log2(coarse[1] / fine[1]) > slope_order - 0.5


def test_cubic_gradient_is_the_derivative_of_its_value():
    field = torch.randn(GRID.shape, dtype=torch.float64)
    py, px = (p.requires_grad_() for p in random_places())
    value, slope_y, slope_x = sampler(GRID, field, "cubic").sample(0.2, py, px)
    for place, slope in ((py, slope_y), (px, slope_x)):
        (derivative,) = torch.autograd.grad(value.sum(), place, retain_graph=True)
        torch.testing.assert_close(slope, derivative, rtol=0, atol=1e-10)


@BOTH
def test_field_is_constant_beyond_the_outermost_centres(interpolation):
    field = torch.randn(GRID.shape, dtype=torch.float64)
    s = sampler(GRID, field, interpolation)
    y, x = torch.tensor([0.8, 0.9, 7.0]).double(), torch.full((3,), 0.13).double()
    value, slope_y, _ = s.sample(0.2, y, x)
    torch.testing.assert_close(value, value[:1].expand(3))
    assert float(slope_y[2]) == 0
    for z in (1.26, 1.5, 9.0):
        assert torch.equal(s.value(z, y, x), s.value(1.25, y, x))
    assert torch.equal(s.value(-1.5, y, x), s.value(-1.25, y, x))


@BOTH
@pytest.mark.parametrize("slices", [1, 2, 3, 7])
def test_depth_weights_sum_to_one_and_lie_in_the_window(interpolation, slices):
    grid = Grid((slices, 3, 3), (0.4, 0.2, 0.2))
    edge = grid.extent[0] / 2
    for i in range(25):
        z = edge * (i / 12 - 1)
        weights = depth_weights(grid, z, interpolation)
        assert sum(weights.values()) == pytest.approx(1, abs=1e-14)
        for z0, z1 in ((z, z), (z, min(z + 0.3, edge)), (min(z + 0.3, edge), z), (-edge, z)):
            near = window(grid, z0, z1, interpolation)
            assert set(weights) <= set(range(slices)[near])


@BOTH
def test_window_of_slices_gives_what_the_whole_field_does(interpolation):
    field = torch.randn(20, 5, 5, dtype=torch.float64)
    grid = Grid((20, 5, 5), (0.4, 0.2, 0.2))
    slices = spline_coefficients(field) if interpolation == "cubic" else field
    whole = SliceSampler(grid, slices.unbind(0), interpolation)
    y, x = torch.tensor([0.1, -0.2]).double(), torch.tensor([0.03, 0.21]).double()
    for z0, z1 in ((-4.0, -3.1), (-0.5, 0.4), (3.3, 4.0)):
        near = window(grid, z0, z1, interpolation)
        assert near.stop - near.start < 10
        part = SliceSampler(grid, slices.unbind(0)[near], interpolation, near.start)
        for t in (0, 0.31, 1):
            z = z0 + t * (z1 - z0)
            for a, b in zip(part.sample(z, y, x), whole.sample(z, y, x), strict=True):
                assert torch.equal(a, b)


@BOTH
def test_one_voxel_thick_axes_are_constant_along_them(interpolation):
    for shape in ((1, 5, 5), (4, 1, 5), (4, 5, 1), (1, 1, 1)):
        grid = Grid(shape, (0.4, 0.2, 0.2))
        field = torch.randn(shape, dtype=torch.float64)
        y = torch.tensor([0.0, 0.3, -0.7]).double() if shape[1] == 1 else torch.zeros(3).double()
        x = torch.tensor([0.0, 0.3, -0.7]).double() if shape[2] == 1 else torch.zeros(3).double()
        value, slope_y, slope_x = sampler(grid, field, interpolation).sample(0.0, y, x)
        torch.testing.assert_close(value, value[:1].expand(3))
        if shape[1] == 1:
            assert not slope_y.any()
        if shape[2] == 1:
            assert not slope_x.any()


def test_nan_place_has_a_nan_value_and_spoils_no_other():
    field = torch.randn(GRID.shape, dtype=torch.float64)
    y = torch.tensor([0.1, math.nan, 0.3], dtype=torch.float64)
    value, _, _ = sampler(GRID, field, "cubic").sample(0.2, y, torch.zeros(3).double())
    assert value.isnan().tolist() == [False, True, False]


@BOTH
@pytest.mark.parametrize("shape", [(4, 6, 5), (1, 1, 5), (3, 2, 1)], ids=str)
def test_pull_back_is_what_autograd_finds(interpolation, shape):
    """Rays beyond every side too, where the index is continued and the slope falls to 0."""
    grid = Grid(shape, (0.5, 0.2, 0.3))
    slices = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    found = SliceSampler(grid, slices.unbind(0), interpolation)
    y, x = (v.requires_grad_() for v in random_places(300, 2.0))
    z = grid.centre(0, 0) + 0.13
    for sample, pull_back, weights in (
        (found.sample, found.pull_back, torch.randn(3, 300, dtype=torch.float64)),
        (found.value, found.pull_back_value, torch.randn(300, dtype=torch.float64)),
    ):
        plane = found.plane(z).detach().requires_grad_()
        part = found.sample_plane if weights.ndim == 2 else found.value_plane
        y_bar, x_bar, plane_bar = torch.autograd.grad((part(plane, y, x) * weights).sum(), (y, x, plane))
        torch.testing.assert_close(part(plane, y, x), sample(z, y, x), rtol=0, atol=0)
        place, voxels = pull_back(z, y.detach(), x.detach(), weights)
        torch.testing.assert_close(place, torch.stack((y_bar, x_bar)), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(voxels, plane_bar, rtol=1e-12, atol=1e-12)


def test_pull_back_skips_voxels_that_no_one_learns():
    found = sampler(GRID, torch.randn(GRID.shape, dtype=torch.float64), "linear")
    y, x = random_places(10)
    assert found.pull_back(0.1, y, x, torch.ones(3, 10, dtype=torch.float64))[1] is None


@pytest.fixture
def threads():
    """Sets how many threads torch may use, until the test ends."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("rays", "available", "parts"),
    [(600, 1, 1), (600, 4, 4), (600, 7, 6), (599, 4, 1), (99, 8, 3), (24, 8, 1), (0, 8, 1)],
)
def test_threads_share_rays_equally_and_not_too_few(threads, rays, available, parts):
    """Of 9 × 11 voxels: at least 99/4 rays each."""
    threads(available)
    assert shares(GRID, rays, torch.device("cpu")) == parts
    assert shares(GRID, rays, torch.device("meta")) == 1


@BOTH
@pytest.mark.parametrize("shape", [(300,), (3, 100), (4, 5, 15)], ids=str)
def test_threads_change_nothing(threads, interpolation, shape):
    field = torch.randn(GRID.shape, dtype=torch.float64, requires_grad=True)
    y, x = (v.reshape(shape) for v in random_places(300, 2.0))
    weights = torch.randn(3, *shape, dtype=torch.float64)
    results = []
    for count in (1, 3, 4):
        threads(count)
        found = sampler(GRID, field, interpolation)
        place, plane = found.pull_back(0.2, y, x, weights)
        results.append((found.sample(0.2, y, x), found.value(0.2, y, x), place, plane))
    torch.testing.assert_close(results[1], results[0], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(results[2], results[0], rtol=1e-12, atol=1e-12)


def test_threads_change_no_image(threads, small, microscope, smooth_field, propagation):
    acquisition = Acquisition([Prism((0.1, 0.2), 0.8)], [0.3])
    results = []
    for count in (1, 2, 7):
        threads(count)
        delta = smooth_field(small, 0.03).requires_grad_()
        images = image(Volume(small, delta, 1.36), microscope, acquisition, Fidelity(propagation, sources=4))
        (gradient,) = torch.autograd.grad(images.square().sum(), delta)
        results.append((images, gradient))
    torch.testing.assert_close(results[1], results[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(results[2], results[0], rtol=1e-10, atol=1e-10)
