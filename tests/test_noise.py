"""The noise of a recording, given and measured, and which pixels of it count."""

import math

import numpy as np
import pytest
import torch

from recon.recording.background import noise_level
from recon.recording.masks import counted_pixels
from recon.recording.noise import NoiseModel, noise_of_level
from torchdic.errors import StackError
from torchdic.files.format import Stack

GAIN = 2.2


def blurred(field, sigma):
    """As an objective blurs: no frequency near the pixels' own is left."""
    along = [np.exp(-2 * (math.pi * sigma * np.fft.fftfreq(n)) ** 2) for n in field.shape[-2:]]
    return np.fft.ifft2(np.fft.fft2(field) * along[0][:, None] * along[1]).real


def scene(levels, contrast, seed=0, shape=(5, 161, 170)):
    """Images (prism, focus, y, x) of a specimen in the middle of a uniform field, for one level each."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape[1:])
    inside = np.hypot(y - shape[1] / 2, x - shape[2] / 2) < 0.35 * min(shape[1:])
    texture = blurred(rng.normal(size=(len(levels), *shape)), 1.5)
    shown = contrast * blurred(inside, 1.5) * texture / texture.std()
    return np.array(levels)[:, None, None, None] * np.exp(shown)


def counts(photons, read, gain=GAIN, seed=1):
    """As a camera without dark counts records photons."""
    rng = np.random.default_rng(seed)
    return np.round(gain * (rng.poisson(photons) + read * rng.normal(size=photons.shape)))


# measured


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("levels", "read"), [([4, 100], 4), ([3, 30, 90], 5), ([30, 500], 20)])
def test_gain_and_read_noise_are_found_under_a_specimen(levels, read, seed):
    found = noise_of_level(counts(scene(levels, 0.25, seed), read, seed=seed))
    assert found.gain == pytest.approx(GAIN, rel=0.1)
    assert found.read == pytest.approx(GAIN * read, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("levels", [[400, 1600], [2000, 9000]])
def test_the_gain_is_found_where_read_noise_hardly_matters(levels, seed):
    found = noise_of_level(counts(scene(levels, 0.25, seed), 3, seed=seed))
    assert found.gain == pytest.approx(GAIN, rel=0.1)
    light = GAIN * torch.tensor(levels, dtype=torch.float64)
    expected = NoiseModel(GAIN, GAIN * 3).variance(light)
    assert torch.allclose(found.variance(light), expected, rtol=0.1)


def test_the_unit_of_light_makes_no_difference():
    images = counts(scene([4, 100], 0.25), 4)
    one, other = noise_of_level(images), noise_of_level(images / 500)
    assert (500 * other.gain, 500 * other.read) == pytest.approx((one.gain, one.read))
    assert (one.in_unit(500).gain, one.in_unit(500).read) == pytest.approx((other.gain, other.read))


def test_saturated_pixels_do_not_count_under_a_mask():
    images = counts(scene([4, 100], 0.3), 4)
    clipped = np.minimum(images, 360.0)
    assert (clipped == 360).mean() > 0.01
    found = noise_of_level(clipped, clipped < 360)
    assert found.gain == pytest.approx(GAIN, rel=0.1)
    assert found.read == pytest.approx(GAIN * 4, rel=0.1)


def test_a_few_hot_pixels_move_neither_gain_nor_read_noise():
    images = counts(scene([4, 100], 0.25), 4)
    images[np.random.default_rng(3).random(images.shape) < 1e-3] += 5000
    found = noise_of_level(images)
    assert found.gain == pytest.approx(GAIN, rel=0.1)
    assert found.read == pytest.approx(GAIN * 4, rel=0.1)


@pytest.mark.parametrize(
    "images",
    [
        counts(scene([500], 0.0), 4),
        counts(scene([500], 0.02), 4),
        np.full((2, 64, 65), 7.0),
        counts(scene([4, 100], 0.25, shape=(1, 11, 40)), 4),
        counts(scene([4, 100], 0.25, shape=(1, 30, 30)), 4)[0],
        100 + np.random.default_rng(0).normal(0, 5, (3, 90, 91)) + 100 * np.arange(3)[:, None, None],
        counts(scene([400, 1600], 0.25), 3) + 2000,
    ],
    ids=["one level", "a faint specimen", "no noise", "too low", "too small", "no shot noise", "dark counts"],
)
def test_a_gain_that_can_not_be_told_is_none(images):
    assert noise_of_level(images) is None


def test_pixels_that_are_nan_are_left_out_of_the_noise():
    image = np.random.default_rng(0).normal(50, 2.0, (120, 121))
    image[::9, ::11] = np.nan
    assert noise_level(image) == pytest.approx(2.0, rel=0.05)
    image[::3, ::3] = np.nan
    assert noise_level(image) is None


# given


def test_the_variance_grows_with_the_light():
    light = torch.tensor([-1.0, 0.0, 2.0])
    assert NoiseModel(0.5, 0.3).variance(light).tolist() == pytest.approx([0.09, 0.09, 1.09])


def test_a_noise_model_may_differ_from_pixel_to_pixel():
    model = NoiseModel(torch.tensor([1.0, 2.0]), torch.tensor([[0.0], [3.0]]))
    assert model.variance(torch.ones(2, 2)).tolist() == [[1, 2], [10, 11]]
    like = model.like(torch.zeros(1, 1, 2, 2, dtype=torch.float64))
    assert like.gain.dtype == like.read.dtype == torch.float64


@pytest.mark.parametrize(
    ("gain", "read", "law"),
    [
        (0.0, 1.0, "gain 0 must be above 0 and finite"),
        (math.nan, 1.0, "gain nan must be above 0"),
        (torch.tensor([1.0, math.inf]), 1.0, "gain inf must be above 0 and finite"),
        (1.0, -2.0, "read noise -2 must be at least 0 and finite"),
        (1.0, torch.tensor([0.0, -0.5]), "read noise -0.5 must be at least 0"),
    ],
)
def test_noise_that_means_nothing_is_refused(gain, read, law):
    with pytest.raises(ValueError, match=law):
        NoiseModel(gain, read)


# which pixels count


def stack(bits=12):
    data = np.full((2, 3, 5, 6), 100, np.uint16)
    data[1, 2, 3, 4] = 4095
    return Stack(data, bits=bits)


def test_saturated_pixels_do_not_count():
    counted = counted_pixels(stack())
    assert counted.sum() == counted.size - 1
    assert not counted[1, 2, 3, 4]
    assert counted_pixels(stack(bits=16)) is None
    assert counted_pixels(Stack(np.ones((1, 1, 4, 4), np.float32))) is None


def test_a_users_mask_adds_to_the_saturated_pixels():
    mask = np.ones((5, 6), bool)
    mask[0, 1] = False
    counted = counted_pixels(stack(), mask)
    assert not counted[..., 0, 1].any()
    assert not counted[1, 2, 3, 4]
    assert counted.sum() == counted.size - 7


def test_masks_that_leave_nothing_or_do_not_fit_are_refused():
    with pytest.raises(StackError, match=r"the mask has shape \(6, 5\), the data \(2, 3, 5, 6\)"):
        counted_pixels(stack(), np.ones((6, 5), bool))
    with pytest.raises(StackError, match="no pixel of prism 1 counts: all are saturated or masked"):
        counted_pixels(stack(), np.arange(2).reshape(2, 1, 1, 1) > 0)
