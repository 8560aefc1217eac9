"""The priors' weight: it follows the noise."""

import math
from itertools import pairwise

import pytest
import torch

from recon.misfit.gaussian import GaussianMisfit
from recon.prior.weight import FARTHER, LEAST, MODEL, MOST, TWICE, USUAL, FollowsNoise, reach, record, whiteness

NOISE = 0.2
RULE = FollowsNoise(NOISE, 10**9)
UNKNOWN = FollowsNoise(None, 10**9)
WIDTH = USUAL / 10  # a weight of 10 is a usual one


def following(misfit, white=1.0, before=None, rule=RULE, weights=(10.0,)):
    past = [record(step, weight, "", 0.5) for step, weight in enumerate(weights)]
    return rule.next(past, misfit, before, white, WIDTH)


def test_the_aim_is_the_residuals_noise_and_the_least_that_a_model_of_voxels_leaves():
    assert RULE.aim(0.25, 0.8, 1.0) == pytest.approx(NOISE + MODEL * (1 - NOISE))
    assert RULE.aim(0.25, 0.84, 1.0) == pytest.approx(0.21 + MODEL * (1 - 0.21))
    assert UNKNOWN.aim(0.5, 0.3, 1.0) == pytest.approx(0.15 + MODEL * (1 - 0.15))


def test_the_residuals_noise_is_believed_near_the_measured_one_alone():
    assert RULE.aim(1.0, 1.0, 1.0) == pytest.approx(MOST * NOISE, rel=1e-2)
    assert RULE.aim(0.1, 1.0, 1.0) == pytest.approx(LEAST * NOISE, rel=1e-2)


def test_noise_alone_is_not_taken_for_a_specimen():
    assert FollowsNoise(0.9999, 10_000).aim(0.99, 1.0, 1.0) == 1.0


def test_within_the_noises_own_error_the_usual_weight_is_preferred():
    few = FollowsNoise(NOISE, 10_000)
    assert few.aim(NOISE, 1.0, 3.0) < few.aim(NOISE, 1.0, 1.0) < few.aim(NOISE, 1.0, 1 / 3)
    assert few.aim(NOISE, 1.0, 3.0) > (1 - 2 * math.sqrt(2 / 10_000)) * NOISE


def test_it_rises_below_the_noise_and_falls_above_it():
    assert following(0.95 * NOISE)[0] > 10
    assert following(1.05 * NOISE, white=1 / 1.05)[0] < 10
    assert following(1.05 * NOISE, white=1 / 1.05)[1] == "the priors hold the volume back"


def test_the_weight_falls_as_the_misfit_rises():
    aim = NOISE + MODEL * (1 - NOISE)
    weights = [following(ratio * aim, white=NOISE / (ratio * aim))[0] for ratio in (0.95, 0.99, 1.0, 1.01, 1.03, 1.1)]
    assert all(a > b for a, b in pairwise(weights))
    assert weights[2] == pytest.approx(10, rel=1e-2)


@pytest.mark.parametrize("misfit", [1e-12, 0.01, 0.19, 0.21, 0.3, 1.0, 1e6])
@pytest.mark.parametrize("white", [0.1, 1.0, 1.2])
@pytest.mark.parametrize("rule", [RULE, UNKNOWN], ids=["noise", "no noise"])
def test_no_step_moves_it_by_more_than_twice(misfit, white, rule):
    weight, _ = following(misfit, white, rule=rule)
    assert weight / 10 * (1 + 1e-9) >= 1 / TWICE
    assert weight / 10 <= TWICE * (1 + 1e-9)


def test_it_holds_while_the_misfit_still_falls():
    assert following(0.9, before=1.0) == (10.0, "the misfit still falls")
    assert following(0.9, before=0.91)[1] != "the misfit still falls"
    assert following(0.9)[1] != "the misfit still falls"  # the first one tells nothing


def test_a_weight_that_is_known_is_approached_whatever_the_noise():
    rule, weights = FollowsNoise(NOISE, 10**9, first=10.0, towards=40.0), [10.0]
    for misfit in (0.9, 0.1, NOISE):
        weights.append(following(misfit, before=1.0, rule=rule, weights=weights)[0])
    assert all(before < after < 40.0 for before, after in pairwise(weights))
    distances = [math.log(40.0 / weight) for weight in weights]
    assert [after / before for before, after in pairwise(distances)] == pytest.approx([FARTHER] * 3)
    assert following(0.9, rule=rule, weights=[40.0])[0] == 40.0


def test_where_the_noise_is_not_known_the_residual_becomes_white():
    assert following(0.3, white=0.9, rule=UNKNOWN)[0] < 10  # it still shows the specimen
    assert following(0.3, white=1.1, rule=UNKNOWN)[0] > 10  # the volume follows the noise


def test_each_time_that_a_long_move_turns_back_the_next_is_shorter():
    assert reach([10.0]) == reach([10.0, 20.0, 40.0]) == math.log(TWICE)
    assert reach([10.0, 20.0, 10.0]) == pytest.approx(math.log(TWICE) / 2)
    assert reach([10.0, 20.0, 10.0, 7.0]) == pytest.approx(1.2 * math.log(TWICE) / 2)


@pytest.mark.parametrize("sides", [(64, 64), (48, 65)])
def test_white_noise_is_white_and_a_blurred_residual_is_not(sides):
    random = torch.Generator().manual_seed(0)
    data = torch.randn(2, 3, *sides, generator=random, dtype=torch.float64)
    misfit = GaussianMisfit(data)
    assert whiteness(torch.zeros_like(data), misfit) == pytest.approx(1, abs=0.03)
    blurred = (data + data.roll(1, -1) + data.roll(1, -2) + data.roll((1, 1), (-1, -2))) / 4
    assert whiteness(torch.zeros_like(data), GaussianMisfit(blurred)) < 0.5


def test_images_too_small_for_high_frequencies_count_as_white():
    data = torch.randn(1, 2, 2, 2, generator=torch.Generator().manual_seed(0))
    assert whiteness(torch.zeros_like(data), GaussianMisfit(data)) > 0


def test_a_weight_that_was_lowered_in_vain_goes_back_and_stays():
    """As with straight rays where light is bent: the misfit can't reach the noise, whatever the weight."""
    rule, far = FollowsNoise(0.05, 10**9), 0.2
    past = [record(0, 20.0, ""), record(5, 10.0, "", far)]
    assert rule.next(past, 0.95 * far, None, 0.3, WIDTH) == (20.0, "the model holds the misfit up")
    past.append(record(6, 20.0, "", 0.95 * far))
    assert rule.next(past, far, None, 0.3, WIDTH)[0] == 20.0
    # where little of the specimen is seen, the priors may hide it
    hidden = [record(0, 20.0, ""), record(5, 10.0, "", 0.9)]
    assert UNKNOWN.next(hidden, 0.88, None, 0.1, WIDTH)[0] < 10
    # from where it helped, it is lowered further
    assert rule.next(past[:2], 0.6 * far, None, 0.5, WIDTH)[0] < 10
    # near the aim no step is in vain
    near = 1.1 * NOISE
    assert RULE.next([record(0, 20.0, ""), record(5, 10.0, "", near)], near, None, 1 / 1.1, WIDTH)[0] < 10
