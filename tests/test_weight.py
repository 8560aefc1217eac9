"""The priors' weight: it follows the noise."""

import math
from itertools import pairwise

import pytest
import torch

from recon.misfit.gaussian import GaussianMisfit
from recon.prior.weight import HELD_UP, MODEL, TWICE, WHITE, FollowsNoise, correlation

NOISE = 0.2
RULE = FollowsNoise(NOISE)
UNKNOWN = FollowsNoise(None)


def following(misfit, rho=0.1, before=None, rule=RULE, weight=10.0):
    return rule.next(weight, misfit, before, rho)


def test_the_aim_is_the_noise_and_the_least_that_a_model_of_voxels_leaves():
    assert RULE.aim == pytest.approx(NOISE + MODEL * (1 - NOISE))
    assert FollowsNoise(0.0).aim == MODEL
    assert FollowsNoise(1.2).aim == 1.2  # nothing but noise
    assert UNKNOWN.aim is None


def test_it_rises_below_the_noise_and_falls_above_it():
    assert following(0.98 * RULE.aim)[0] > 10
    assert following(RULE.aim)[0] == pytest.approx(10)
    assert following(1.02 * RULE.aim)[0] < 10
    assert following(1.02 * RULE.aim)[1] == "towards the noise"


def test_the_weight_falls_as_the_misfit_rises():
    weights = [following(ratio * RULE.aim, rho=0.5)[0] for ratio in (0.5, 0.9, 0.97, 1.0, 1.01, 1.03, 1.049)]
    assert all(a >= b for a, b in pairwise(weights))


@pytest.mark.parametrize("misfit", [1e-12, 0.01, 0.19, 0.21, 0.3, 1.0, 1e6])
@pytest.mark.parametrize("rho", [-1.0, 0.0, 1.0])
@pytest.mark.parametrize("rule", [RULE, UNKNOWN], ids=["noise", "no noise"])
def test_no_step_moves_it_by_more_than_twice(misfit, rho, rule):
    weight, _ = following(misfit, rho, rule=rule)
    assert 1 / TWICE <= weight / 10 <= TWICE


def test_it_holds_while_the_misfit_still_falls():
    assert following(0.9, before=1.0) == (10.0, "the misfit still falls")
    assert following(0.9, before=0.91)[1] != "the misfit still falls"
    assert following(0.9)[1] != "the misfit still falls"  # the first one tells nothing


def test_a_misfit_below_the_noise_is_not_waited_for():
    assert following(0.9 * NOISE, before=1.0)[0] == 20.0


def test_where_the_noise_is_not_known_the_residual_becomes_white():
    assert following(0.3, rho=0.1, rule=UNKNOWN)[0] < 10  # it still shows the specimen
    assert following(0.3, rho=-0.1, rule=UNKNOWN)[0] > 10  # the volume follows the noise
    assert following(0.3, rho=0.0, rule=UNKNOWN)[0] == 10
    assert following(0.3, rho=0.1, before=1.0, rule=UNKNOWN) == (10.0, "the misfit still falls")


def test_a_white_residual_above_the_noise_is_left_alone():
    """Then the noise was measured too low, or the model leaves something that no weight removes."""
    high = 1.01 * HELD_UP * RULE.aim
    assert following(high, rho=0.0) == (10.0, "the residual is white, though above the noise")
    assert following(high, rho=2 * WHITE)[0] < 10
    assert following(high, rho=-2 * WHITE) == (pytest.approx(10 * math.exp(15 * 2 * WHITE)), "towards a white residual")


# the correlation


@pytest.fixture
def stack():
    return torch.rand(2, 3, 64, 60, dtype=torch.float64)


def test_white_noise_is_not_correlated(stack):
    noise = 0.1 * torch.randn_like(stack)
    error = 1 / math.sqrt(2 * stack.numel())  # two neighbours of each pixel are averaged
    assert abs(correlation(stack + noise, GaussianMisfit(stack))) < 4 * error


def test_a_blurred_residual_is_correlated_by_what_neighbours_share(stack):
    noise = torch.randn_like(stack)
    blurred = noise + noise.roll(1, 3)
    assert correlation(stack + blurred, GaussianMisfit(stack)) == pytest.approx(0.25, abs=0.02)  # ½ along x, 0 along y


def test_a_residual_of_alternating_signs_is_correlated_negatively(stack):
    sign = torch.ones_like(stack)
    sign[..., ::2] = -1
    sign[..., ::2, :] *= -1
    assert correlation(stack + sign, GaussianMisfit(stack)) == pytest.approx(-1, abs=1e-9)


def test_neither_an_images_brightness_nor_the_residuals_size_matters(stack):
    noise = torch.randn_like(stack)
    noise = noise + 0.5 * noise.roll(1, 2)
    misfit = GaussianMisfit(stack)
    offset = torch.arange(6, dtype=torch.float64).reshape(2, 3, 1, 1)
    expected = correlation(stack + noise, misfit)
    assert correlation(stack + 0.01 * noise + offset, misfit) == pytest.approx(expected, abs=1e-6)


def test_no_residual_is_not_correlated(stack):
    assert correlation(stack, GaussianMisfit(stack)) == 0


def test_masked_pixels_have_no_say(stack):
    """Whatever they hold, and whatever brightness the others have."""
    mask = torch.rand_like(stack) > 0.4
    noise = 0.1 * torch.randn_like(stack)
    wild = torch.where(mask, noise, 100.0)
    misfit = GaussianMisfit(stack, mask=mask)
    known = correlation(stack + noise, misfit)
    assert correlation(stack + wild, misfit) == pytest.approx(known, abs=1e-12)
    assert abs(known) < 0.02
    assert correlation(stack + noise + 3.0, misfit) == pytest.approx(known, abs=1e-9)


def test_a_mask_of_dots_leaves_the_correlation_as_it_is(stack):
    noise = torch.randn_like(stack)
    blurred = noise + noise.roll(1, 3) + noise.roll(1, 2) + noise.roll((1, 1), (2, 3))
    mask = torch.rand_like(stack) > 0.3
    whole = correlation(stack + blurred, GaussianMisfit(stack))
    assert whole == pytest.approx(0.5, abs=0.02)
    assert correlation(stack + blurred, GaussianMisfit(stack, mask=mask)) == pytest.approx(whole, abs=0.03)
