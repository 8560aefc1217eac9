import math
from itertools import pairwise

import pytest
import torch
from absolute import Absolute

from recon.fit.bounds import SHARPNESS, Bounds
from recon.misfit.base import spatial_variance
from recon.misfit.gaussian import GaussianMisfit
from recon.prior.edges import CORNERS, SMOOTHING, TotalVariation, total_variation
from recon.prior.magnitude import Magnitude, magnitude
from recon.prior.schedule import cosine, held_then_annealed
from torchdic import Grid, Volume

BOUNDS = {
    "free": Bounds(None, None),
    "above": Bounds(0.0, None),
    "above a negative": Bounds(-0.02, None),
    "below": Bounds(None, 0.05),
    "between": Bounds(-0.01, 0.06),
}


@pytest.fixture
def data():
    """Three prisms of unlike backgrounds and contrasts, (prism, focus, y, x)."""
    level = torch.tensor([0.5, 1.0, 0.1]).reshape(3, 1, 1, 1)
    contrast = torch.tensor([0.01, 0.2, 0.003]).reshape(3, 1, 1, 1)
    return level + contrast * torch.randn(3, 2, 9, 12)


@pytest.fixture(params=BOUNDS.values(), ids=BOUNDS)
def bounds(request):
    return request.param


# misfit


def test_an_empty_models_misfit_is_1(data):
    level = data.mean((2, 3), keepdim=True).expand_as(data)
    assert GaussianMisfit(data)(level).item() == pytest.approx(1, rel=1e-5)


def test_a_perfect_models_misfit_is_0(data):
    assert GaussianMisfit(data)(data).item() == 0


def test_every_prism_counts_alike_whatever_its_contrast(data):
    level = data.mean((2, 3), keepdim=True).expand_as(data)
    for prism in range(3):
        images = data.clone()
        images[prism] = level[prism]
        assert GaussianMisfit(data)(images).item() == pytest.approx(1 / 3, rel=1e-4)


def test_a_difference_between_backgrounds_does_not_count_as_variance(data):
    shifted = data + torch.tensor([3.0, -2.0, 0.0]).reshape(3, 1, 1, 1)
    assert torch.allclose(spatial_variance(shifted), spatial_variance(data), rtol=1e-3)


def test_the_misfit_does_not_depend_on_the_unit_of_light(data):
    images = data + 0.01 * torch.randn_like(data)
    expected = GaussianMisfit(data)(images)
    scaled = GaussianMisfit(100 * data)(100 * images)
    assert scaled.item() == pytest.approx(expected.item(), rel=1e-4)


def test_the_misfits_gradient_is_the_scaled_residual(data):
    images = (data + 0.1).requires_grad_()
    variance = spatial_variance(data)
    GaussianMisfit(data)(images).backward()
    expected = 2 * 0.1 / variance / data.numel()
    assert torch.allclose(images.grad, expected[:, None, None, None].expand_as(data), rtol=1e-4)


@pytest.mark.parametrize("level", [0.0, 0.1, 0.3, 0.5, 0.7, 1e4])
@pytest.mark.parametrize("shape", [(16, 16), (17, 19), (1, 1)])
def test_uniform_images_are_refused_up_to_rounding(level, shape, dtype):
    data = torch.stack([torch.randn(2, *shape, dtype=dtype), torch.full((2, *shape), level, dtype=dtype)])
    data[0, :, 0, 0] += 1
    if shape == (1, 1):
        data = data[1:]
    with pytest.raises(ValueError, match=rf"images of prism {len(data)} are uniform .*nothing to fit"):
        spatial_variance(data)


def test_a_faint_specimen_is_not_taken_for_a_uniform_image():
    data = 0.5 + 1e-5 * torch.randn(1, 1, 20, 20)
    assert spatial_variance(data).item() == pytest.approx(1e-10, rel=0.3)


@pytest.mark.parametrize("kind", [GaussianMisfit, Absolute])
def test_noise_alone_leaves_what_the_misfit_says(kind):
    """The images of a perfect model differ from noisy data by the noise."""
    images = torch.sin(torch.arange(3 * 2 * 60 * 64) * 0.07).reshape(3, 2, 60, 64).double()
    noise = [0.1, 0.2, 0.05]
    data = images + torch.tensor(noise).reshape(3, 1, 1, 1) * torch.randn(images.shape, dtype=torch.float64)
    misfit = kind(data)
    assert misfit.of_noise(noise) == pytest.approx(misfit(images).item(), rel=0.03)  # 5 standard errors of 7680 pixels


def test_a_misfit_divides_by_each_prisms_spatial_variance(data):
    assert GaussianMisfit(data).variance.shape == (3, 1, 1, 1)
    assert torch.equal(GaussianMisfit(data).variance.flatten(), spatial_variance(data))


def test_data_without_four_axes_are_refused(data):
    with pytest.raises(ValueError, match=r"the data have shape \(2, 9, 12\)"):
        GaussianMisfit(data[0])


# priors


def test_each_prior_is_its_term_of_the_volumes_delta():
    volume = Volume(Grid((4, 5, 6), (0.4, 0.3, 0.2)), 0.02 * torch.rand(4, 5, 6) - 0.01, 1.5)
    assert torch.equal(TotalVariation(60.0, 5.0)(volume), total_variation(volume.delta, (0.4, 0.3, 0.2)))
    assert torch.equal(Magnitude(0.5)(volume), magnitude(volume.delta))


def test_each_prior_has_its_own_schedule():
    annealed, constant = TotalVariation(60.0, 5.0), Magnitude(0.5)
    assert [annealed.weight(step, 10) for step in range(10)] == [
        held_then_annealed(s, 10, 60.0, 5.0) for s in range(10)
    ]
    assert [constant.weight(step, 10) for step in range(10)] == [0.5] * 10


# regularisers


def test_total_variation_of_one_voxel_is_its_differences_to_the_next():
    delta = torch.zeros(3, 4, 5, dtype=torch.float64)
    delta[1, 2, 3] = 0.01
    # at each corner the voxel itself has three differences (√3), and three neighbours have one each
    expected = 0.01 * (math.sqrt(3) + 3) / 60
    assert total_variation(delta, (0.2, 0.2, 0.2)).item() == pytest.approx(expected, abs=2 * SMOOTHING)


@pytest.mark.parametrize("axis", range(3))
def test_total_variation_of_a_ramp_is_its_slope_along_each_axis(axis):
    shape, spacing = (4, 5, 6), (0.4, 0.3, 0.2)
    index = torch.arange(shape[axis], dtype=torch.float64)
    ramp = (0.01 * index).reshape([-1 if a == axis else 1 for a in range(3)]).expand(shape)
    inside = (shape[axis] - 1) / shape[axis]  # the last voxel has no next one
    expected = 0.01 * 0.2 / spacing[axis] * inside
    assert total_variation(ramp, spacing).item() == pytest.approx(expected, abs=1.1 * SMOOTHING)


def test_total_variation_depends_on_the_spacings_ratio_only():
    delta = 0.02 * torch.rand(4, 5, 6, dtype=torch.float64)
    one = total_variation(delta, (0.4, 0.3, 0.2))
    assert total_variation(delta, (4.0, 3.0, 2.0)).item() == pytest.approx(one.item(), rel=1e-12)


def test_total_variation_treats_axes_alike_where_their_spacing_is():
    delta = 0.02 * torch.rand(4, 5, 6, dtype=torch.float64)
    one = total_variation(delta, (0.2, 0.2, 0.2))
    for order in ((1, 2, 0), (2, 1, 0), (0, 2, 1)):
        assert total_variation(delta.permute(order), (0.2, 0.2, 0.2)).item() == pytest.approx(one.item(), rel=1e-12)


def test_total_variation_ignores_a_uniform_index():
    delta = 0.02 * torch.rand(4, 5, 6, dtype=torch.float64)
    shifted = total_variation(delta + 0.01, (0.4, 0.2, 0.2))
    assert shifted.item() == pytest.approx(total_variation(delta, (0.4, 0.2, 0.2)).item(), rel=1e-12)
    assert total_variation(torch.full((3, 3, 3), 0.05), (0.4, 0.2, 0.2)).item() <= 1.01 * SMOOTHING


@pytest.mark.parametrize("axis", range(3))
def test_total_variation_of_a_single_slice_is_that_of_the_other_axes(axis):
    thick = torch.rand(4, 5, 6, dtype=torch.float64)
    thin = thick.narrow(axis, 0, 1).clone().requires_grad_()
    total = 0.0
    for corner in CORNERS:
        squares = SMOOTHING**2
        for other, step in enumerate((0.4, 0.3, 0.2)):
            if other != axis:
                rise = thin.detach().diff(dim=other) * 0.2 / step
                none = torch.zeros_like(thin.detach().narrow(other, 0, 1))
                squares = squares + torch.cat([none, rise] if corner[other] else [rise, none], other).square()
        total += squares.sqrt().mean().item() / len(CORNERS)
    value = total_variation(thin, (0.4, 0.3, 0.2))
    assert value.item() == pytest.approx(total, rel=1e-12)
    value.backward()
    assert bool(torch.isfinite(thin.grad).all())


def test_the_regularisers_gradients_are_finite_where_the_volume_is_empty():
    delta = torch.zeros(3, 4, 5, requires_grad=True)
    (total_variation(delta, (0.4, 0.2, 0.2)) + magnitude(delta)).backward()
    assert bool(torch.isfinite(delta.grad).all())


def test_magnitude_is_the_mean_of_the_absolute_values():
    assert magnitude(torch.tensor([[[0.01, -0.03], [0.0, 0.02]]])).item() == pytest.approx(0.015)


# bounds


def test_the_parameter_of_a_delta_gives_it_back(bounds, dtype):
    delta = torch.linspace(-0.008, 0.048, 40, dtype=dtype)
    if bounds.lower == 0:
        delta = delta.clamp_min(1e-3)
    again = bounds.delta(bounds.parameter(delta, margin=1e-3))
    # logit and log lose digits in proportion to the width of the range and the knee
    assert torch.allclose(again, delta, rtol=0, atol=100 * torch.finfo(dtype).eps * 0.07)


def test_every_parameter_gives_a_delta_within_the_bounds(bounds):
    extremes = torch.cat([torch.tensor([-1e6, -10.0, 10.0, 1e6]), torch.linspace(-0.5, 0.5, 101)])
    delta = bounds.delta(extremes)
    assert bool(torch.isfinite(delta).all())
    rounding = 0.1 * torch.finfo(delta.dtype).eps
    if bounds.lower is not None:
        assert float(delta.min()) >= bounds.lower - rounding
    if bounds.upper is not None:
        assert float(delta.max()) <= bounds.upper + rounding


def test_delta_rises_with_its_parameter(bounds):
    delta = bounds.delta(torch.linspace(-0.02, 0.02, 101, dtype=torch.float64))
    assert bool((delta.diff() > 0).all())


@pytest.mark.parametrize("beyond", [-1.0, 0.0, 1.0])
def test_a_voxel_beyond_the_bounds_starts_at_the_margin_and_can_still_move(bounds, beyond):
    margin = 1e-3
    parameter = bounds.parameter(torch.full((4,), beyond), margin=margin).requires_grad_()
    delta = bounds.delta(parameter)
    lower = -math.inf if bounds.lower is None else bounds.lower + margin
    upper = math.inf if bounds.upper is None else bounds.upper - margin
    expected = min(max(beyond, lower), upper)
    assert delta.tolist() == pytest.approx([expected] * 4, abs=1e-6)
    delta.sum().backward()
    assert float(parameter.grad.min()) > 0.05


def test_far_from_its_bounds_a_parameter_is_delta_itself():
    knee = 1 / SHARPNESS
    assert Bounds(0.0, None).delta(torch.tensor(20 * knee)).item() == pytest.approx(20 * knee, rel=1e-6)
    assert Bounds(None, 0.0).delta(torch.tensor(-20 * knee)).item() == pytest.approx(-20 * knee, rel=1e-6)
    slope = Bounds(-1.0, 1.0).delta(torch.tensor([-1e-3, 1e-3])).diff().item() / 2e-3
    assert slope == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize(
    ("lower", "upper", "law"),
    [
        (0.1, 0.05, "lower bound 0.1 must be below the upper bound 0.05"),
        (0.0, 0.0, "must be below"),
        (math.nan, None, "lower bound nan must be a finite"),
        (0.0, math.inf, "upper bound inf must be a finite"),
    ],
)
def test_bounds_that_leave_no_room_are_refused(lower, upper, law):
    with pytest.raises(ValueError, match=law):
        Bounds(lower, upper)


# schedules


def test_the_learning_rate_falls_from_its_peak_to_0_along_half_a_cosine():
    rates = [cosine(step, 10, 5e-3) for step in range(11)]
    assert rates[0] == 5e-3
    assert rates[5] == pytest.approx(2.5e-3)
    assert rates[10] == pytest.approx(0, abs=1e-15)
    assert all(a > b for a, b in pairwise(rates))
    assert rates[9] > 0  # the last step still moves


@pytest.mark.parametrize(("first", "last"), [(100.0, 10.0), (1.0, 50.0), (100.0, 0.0), (0.0, 3.0), (7.0, 7.0)])
def test_total_variation_is_held_then_annealed_then_held(first, last):
    weights = [held_then_annealed(step, 100, first, last) for step in range(100)]
    assert weights[:41] == [first] * 41
    assert weights[80:] == pytest.approx([last] * 20)
    middle = math.sqrt(first * last) if first > 0 and last > 0 else (first + last) / 2
    assert weights[60] == pytest.approx(middle)


def test_one_step_takes_the_first_weight():
    assert held_then_annealed(0, 1, 100.0, 10.0) == 100.0
