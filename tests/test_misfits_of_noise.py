"""Misfits of noise that is known at each pixel, and of pixels that don't belong."""

import math

import pytest
import torch
from absolute import Absolute

from recon.misfit.base import spatial_variance
from recon.misfit.gaussian import GaussianMisfit
from recon.misfit.level import filled, neighbours
from recon.misfit.poisson import PoissonMisfit, expected_deviance
from recon.misfit.robust import RobustMisfit
from recon.recording.noise import NoiseModel

NOISE = NoiseModel(gain=0.02, read=0.01)
MISFITS = {
    "gaussian": lambda data, mask=None: GaussianMisfit(data, None, mask),
    "gaussian of known noise": lambda data, mask=None: GaussianMisfit(data, NOISE, mask),
    "poisson": lambda data, mask=None: PoissonMisfit(data, NOISE, mask),
    "robust": lambda data, mask=None: RobustMisfit(data, torch.tensor([0.1, 0.05]), mask),
    "robust of measured noise": lambda data, mask=None: RobustMisfit(data, None, mask),
    "absolute": lambda data, mask=None: Absolute(data, mask),
}
OF_KNOWN_NOISE = {"gaussian": GaussianMisfit, "poisson": PoissonMisfit}
SHAPES = [(2, 3, 8, 10), (2, 1, 9, 7), (2, 2, 5, 12)]


@pytest.fixture(params=MISFITS.values(), ids=MISFITS)
def make(request):
    return request.param


@pytest.fixture(params=OF_KNOWN_NOISE.values(), ids=OF_KNOWN_NOISE)
def knowing(request):
    return request.param


def specimen(shape, level=0.5, contrast=0.3, dtype=torch.float64):
    """Smooth images of unlike levels that show something."""
    prism, focus, y, x = (torch.arange(n, dtype=dtype) for n in shape)
    wave = torch.sin(0.31 * y[:, None] + 0.17 * x + focus[:, None, None] + 2 * prism[:, None, None, None])
    return level * (1 + 0.5 * prism[:, None, None, None]) * (1 + contrast * wave)


def recorded(truth, gain, read, seed=0):
    random = torch.Generator().manual_seed(seed)
    photons = torch.poisson(truth / gain, generator=random)
    return gain * photons + read * torch.randn(truth.shape, generator=random, dtype=truth.dtype)


def some_mask(shape):
    mask = torch.rand(shape, generator=torch.Generator().manual_seed(3)) > 0.2
    mask[0, 0, :5, :5] = True  # a place where the noise can be measured
    mask[1, 0, -5:, -5:] = True
    return mask


@pytest.mark.parametrize("masked", [False, True])
def test_a_misfit_of_other_images_is_as_if_made_of_them(make, masked):
    """With its own noise, mask and scale. One of measured noise keeps it: the other images are of the same camera."""
    truth = specimen((2, 3, 12, 14))
    mask = some_mask(truth.shape) if masked else None
    first, other = (recorded(truth, 0.02, 0.01, seed) for seed in (0, 1))
    misfit = make(first, mask)
    if isinstance(misfit, Absolute):
        with pytest.raises(NotImplementedError, match=r"of the kind absolute can't be made of other images"):
            misfit.again(other)
        return
    again = misfit.again(other)
    made = RobustMisfit(other, misfit.noise, mask) if isinstance(misfit, RobustMisfit) else make(other, mask)
    assert type(again) is type(misfit)
    assert float(again(truth)) == float(made(truth)) != float(misfit(truth))
    assert torch.equal(again.curvature(truth), made.curvature(truth))


def test_a_misfit_of_ones_own_that_builds_on_another_is_made_again_like_it():
    class Own(GaussianMisfit):
        name = "own"

    data = specimen((2, 3, 8, 10))
    assert type(Own(data, NOISE).again(2 * data)) is Own


def brightness(misfit, truth):
    """The factor of the true images that makes the misfit least, by bisection of its slope."""
    low, high = 0.1, 10.0
    for _ in range(40):
        factor = torch.tensor((low + high) / 2, dtype=truth.dtype, requires_grad=True)
        (slope,) = torch.autograd.grad(misfit(factor * truth), factor)
        low, high = (low, factor.item()) if slope > 0 else (factor.item(), high)
    return low


# value, gradient and curvature


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("masked", [False, True])
def test_the_gradient_is_the_finite_difference(make, shape, masked):
    truth = specimen(shape)
    misfit = make(recorded(truth, 0.02, 0.01), some_mask(shape) if masked else None)
    images = (truth + 0.03 * torch.randn_like(truth)).requires_grad_()
    assert torch.autograd.gradcheck(misfit, images, eps=1e-7, atol=1e-7, rtol=1e-4)


@pytest.mark.parametrize("level", [-0.3, -1e-3, 0.0, 1e-5, 5e-3])
@pytest.mark.parametrize("read", [0.0, 0.01, 0.05])
def test_the_deviance_has_a_gradient_in_the_dark_too(level, read):
    data = recorded(specimen((1, 1, 6, 7), 0.02), 0.02, read)
    misfit = PoissonMisfit(data, NoiseModel(0.02, read))
    images = torch.full_like(data, level + 1e-6, requires_grad=True)
    assert torch.autograd.gradcheck(misfit, images, eps=1e-8, atol=1e-5, rtol=1e-4)
    assert bool((misfit.curvature(images) > 0).all())


@pytest.mark.parametrize("read", [0.0, 0.05])
def test_a_dark_model_is_pulled_to_the_light(read):
    truth = specimen((1, 1, 16, 16), 0.2)
    misfit = PoissonMisfit(recorded(truth, 0.02, read), NoiseModel(0.02, read))
    values = [float(misfit(level * torch.ones_like(truth))) for level in (-1.0, -0.1, 0.0, 0.001, 0.05, 0.2)]
    assert all(math.isfinite(value) for value in values)
    assert values == sorted(values, reverse=True)


@pytest.mark.parametrize("name", ["gaussian", "gaussian of known noise", "poisson", "robust"])
@pytest.mark.parametrize("masked", [False, True])
def test_the_curvature_at_the_data_is_the_second_difference(name, masked):
    """Everywhere for a parabola; where the model meets the data for the deviance, whose information is expected."""
    shape = (2, 2, 6, 7)
    data = recorded(specimen(shape), 0.02, 0.01)
    misfit = MISFITS[name](data, some_mask(shape) if masked else None)
    curvature = misfit.curvature(data).expand(shape)
    step = 1e-4
    for pixel in [(0, 0, 0, 0), (1, 1, 5, 6), (0, 1, 2, 3), (1, 0, 3, 3)]:
        moved = torch.zeros(shape, dtype=data.dtype)
        moved[pixel] = step
        second = (misfit(data + moved) + misfit(data - moved) - 2 * misfit(data)) / step**2
        assert float(curvature[pixel]) == pytest.approx(float(second), rel=1e-3, abs=1e-12)


def test_a_parabola_of_the_robust_curvature_touches_the_loss_and_lies_above_it():
    shape = (2, 2, 8, 9)
    truth = specimen(shape)
    misfit = RobustMisfit(recorded(truth, 0.02, 0.01), torch.tensor([0.1, 0.05]))
    images = (truth + 0.3 * torch.randn_like(truth)).requires_grad_()
    value = misfit(images)
    (gradient,) = torch.autograd.grad(value, images)
    for size in (0.01, 0.1, 1.0):
        step = size * torch.randn_like(truth)
        parabola = value + (gradient * step).sum() + (misfit.curvature(images) * step.square()).sum() / 2
        assert misfit(images + step).item() <= parabola.item() * (1 + 1e-12)


def test_the_curvature_is_never_negative_and_fits_the_images(make):
    truth = specimen((2, 2, 8, 9))
    images = truth + 2 * torch.randn_like(truth)
    for mask in (None, some_mask(truth.shape)):
        curvature = make(recorded(truth, 0.02, 0.01), mask).curvature(images).expand(truth.shape)
        assert bool((curvature >= 0).all())
        assert mask is None or not curvature[~mask].any()


def test_without_a_noise_model_every_prism_is_curved_by_its_own_variance():
    data = specimen((3, 2, 8, 9))
    expected = 2 / (data[0].numel() * 3 * spatial_variance(data))
    assert torch.allclose(GaussianMisfit(data).curvature(data).flatten(), expected)


@pytest.mark.parametrize("name", [name for name in MISFITS if name != "absolute"])
def test_uniform_images_have_a_misfit_of_1(name):
    truth = specimen((2, 2, 24, 25))
    data = recorded(truth, 0.02, 0.01)
    assert float(MISFITS[name](data)(data.mean((2, 3), keepdim=True).expand_as(data))) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("kind", ["gaussian of known noise", "poisson"])
def test_the_unit_of_light_makes_no_difference_with_its_noise(kind):
    truth = specimen((2, 2, 12, 13))
    data = recorded(truth, 0.02, 0.01)
    made = OF_KNOWN_NOISE[kind.split()[0]](100 * data, NOISE.in_unit(0.01))
    assert float(made(100 * truth)) == pytest.approx(float(MISFITS[kind](data)(truth)), rel=1e-10)


def test_single_precision_tells_the_deviance_of_many_photons(knowing):
    truth = specimen((2, 2, 40, 40), 0.5, 0.05)
    data, noise = recorded(truth, 1e-5, 0.0), NoiseModel(1e-5, 0.0)
    expected = float(knowing(data.float().double(), noise)(truth.float().double()))
    assert float(knowing(data.float(), noise)(truth.float())) == pytest.approx(expected, rel=1e-4)


# noise


@pytest.mark.parametrize("photons", [2, 8, 50, 1000, 1e5])
@pytest.mark.parametrize("read", [0.0, 1.5])
@pytest.mark.parametrize("masked", [False, True])
def test_noise_alone_leaves_what_the_misfit_says_at_any_level_of_light(knowing, photons, read, masked):
    """photons: in the darker prism; read noise in photons. A deviance scatters about twice as much as its mean."""
    truth = specimen((2, 4, 100, 101), 1.0, 0.2)
    noise = NoiseModel(1 / photons, read / photons)
    data = recorded(truth, noise.gain, noise.read)
    misfit = knowing(data, noise, some_mask(truth.shape) if masked else None)
    assert misfit.of_noise() == pytest.approx(float(misfit(truth)), rel=5 * math.sqrt(2.5 / truth.numel()))
    assert misfit.of_noise([1.0, 1.0]) == misfit.of_noise()


@pytest.mark.parametrize("given", [False, True])
def test_normal_noise_alone_leaves_what_the_robust_misfit_says(given):
    truth, noise = specimen((2, 4, 100, 101), 1.0, 0.2), torch.tensor([0.05, 0.02], dtype=torch.float64)
    data = truth + noise[:, None, None, None] * torch.randn_like(truth)
    misfit = RobustMisfit(data, noise if given else None)
    assert misfit.of_noise() == pytest.approx(float(misfit(truth)), rel=0.03)
    assert misfit.of_noise(noise.tolist()) == pytest.approx(float(misfit(truth)), rel=0.02)
    wide = RobustMisfit(data, 3 * noise)
    assert wide.of_noise(noise.tolist()) == pytest.approx(float(wide(truth)), rel=0.02)
    assert wide.of_noise([0.0, 0.0]) == 0


def test_without_a_noise_the_gaussian_misfit_knows_nothing_of_it():
    assert GaussianMisfit(specimen((2, 2, 8, 9))).of_noise() is None


@pytest.mark.parametrize("light", [0.0, 0.05, 0.5, 3.0, 20.0, 58.0, 62.0, 400.0])
@pytest.mark.parametrize("read", [0.0, 0.3, 2.0])
def test_the_expected_deviance_is_the_mean_of_many_draws(light, read):
    draws, mean = 400_000, light + read**2
    random = torch.Generator().manual_seed(1)
    photons = torch.poisson(torch.full((draws,), light, dtype=torch.float64), generator=random)
    counts = photons + read**2 + read * torch.randn(draws, generator=random, dtype=torch.float64)
    floor = max(read**2, 0.01)
    positive = counts.clamp_min(0)
    at = max(mean, floor)
    values = 2 * (at - positive + torch.special.xlogy(positive, positive / at))
    values += 2 * (counts - positive).abs() * (1 + math.log(at))
    if mean < floor:
        values += ((mean - counts) ** 2 - (at - counts) ** 2) / floor
    expected = expected_deviance(*(torch.tensor([value], dtype=torch.float64) for value in (light, read)))
    error = 5 * float(values.std()) / math.sqrt(draws)
    assert float(expected) == pytest.approx(float(values.mean()), abs=error + 1e-3)


def test_the_expected_deviance_of_many_photons_is_1():
    many = torch.tensor([1e3, 1e6], dtype=torch.float64)
    for read in (0.0, 5.0):
        expected = expected_deviance(many, torch.full_like(many, read))
        assert torch.allclose(expected, torch.ones_like(expected), atol=1e-3)


# the minimum


@pytest.mark.parametrize(("photons", "read"), [(3, 0.0), (3, 1.5), (30, 2.0), (1000, 5.0)])
def test_the_minimum_has_the_true_brightness(knowing, photons, read):
    truth = specimen((2, 4, 80, 81), 1.0, 0.4)
    noise = NoiseModel(1 / photons, read / photons)
    error = float((truth.square() / noise.variance(truth)).sum()) ** -0.5
    found = [brightness(knowing(recorded(truth, noise.gain, noise.read, seed), noise), truth) for seed in range(3)]
    assert abs(sum(found) / 3 - 1) < 3 * error / math.sqrt(3)


def test_variances_of_the_pixels_themselves_would_bias_the_minimum():
    """Why the neighbours' mean is taken: the harmonic mean of counts lies one below their mean."""
    truth = specimen((2, 4, 80, 81), 1.0, 0.4)
    photons = recorded(20 * truth, 1.0, 0.0).clamp_min(1)
    weights = truth / photons
    assert float((weights * photons).sum() / (weights * truth).sum()) / 20 == pytest.approx(1 - 1 / 25, abs=0.015)


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("height", [2.0, 50.0])
def test_one_hot_pixel_in_a_hundred_moves_the_robust_minimum_less_than_a_tenth(given, height):
    truth, noise = specimen((2, 4, 60, 61), 0.5, 0.3), torch.full((2,), 0.02, dtype=torch.float64)
    data = truth + 0.02 * torch.randn_like(truth)
    hot = torch.where(torch.rand(truth.shape) < 0.01, data + height, data)
    moved = {
        make: abs(brightness(make(hot), truth) - brightness(make(data), truth))
        for make in (GaussianMisfit, lambda stack: RobustMisfit(stack, noise if given else None))
    }
    gaussian, robust = moved.values()
    assert robust < 0.1 * gaussian


def test_a_scale_from_the_residual_is_its_median():
    truth = specimen((2, 4, 60, 61))
    data = truth + 0.02 * torch.randn_like(truth)
    images = truth + torch.tensor([0.3, 0.1], dtype=torch.float64)[:, None, None, None] * torch.randn_like(truth)
    for mask in (None, some_mask(truth.shape)):
        wide = RobustMisfit(data, torch.full((2,), 0.02, dtype=torch.float64), mask).rescaled(images)
        expected = RobustMisfit(data, torch.tensor([0.3007, 0.102], dtype=torch.float64), mask)
        assert float(wide(images)) == pytest.approx(float(expected(images)), rel=0.03)
        assert wide.of_noise() == pytest.approx(expected.of_noise([0.02, 0.02]), rel=0.06)
    with pytest.raises(ValueError, match=r"the residual's median in prism 1 is 0: it gives no scale"):
        RobustMisfit(data).rescaled(data)


# masks


@pytest.mark.parametrize("value", [math.nan, math.inf, -7.0, 1e6])
def test_masked_pixels_have_no_influence_at_all(make, value):
    truth = specimen((2, 3, 12, 13))
    mask = some_mask(truth.shape)
    mask[0, 1] = False  # a whole image
    data = recorded(truth, 0.02, 0.01)
    spoilt = torch.where(mask, data, value)
    one, other = make(data, mask), make(spoilt, mask)
    assert torch.equal(one.data, other.data)
    assert torch.equal(one.curvature(truth), other.curvature(truth))
    assert one.of_noise([0.1, 0.1]) == other.of_noise([0.1, 0.1])
    gradients = []
    for misfit, images in ((one, truth), (other, torch.where(mask, truth, 5.0))):
        learned = images.clone().requires_grad_()
        result = misfit(learned)
        result.backward()
        gradients.append((result.item(), learned.grad))
    assert gradients[0][0] == gradients[1][0]
    assert torch.equal(gradients[0][1], gradients[1][1])
    assert not gradients[0][1][~mask].any()


@pytest.mark.parametrize("name", ["gaussian", "gaussian of known noise", "poisson", "robust"])
def test_a_mask_that_leaves_a_window_is_the_misfit_of_the_window(name):
    """But for the levels along its edge, whose neighbours are the window's own too."""
    data, truth = recorded(specimen((2, 2, 14, 15)), 0.02, 0.01), specimen((2, 2, 14, 15))
    mask = torch.zeros(data.shape, dtype=torch.bool)
    mask[..., 3:12, 2:13] = True
    inside = MISFITS[name](data[..., 3:12, 2:13].contiguous())(truth[..., 3:12, 2:13])
    assert float(MISFITS[name](data, mask)(truth)) == pytest.approx(float(inside), rel=1e-10)


def test_a_mask_of_all_pixels_is_none(make):
    data = recorded(specimen((2, 2, 8, 9)), 0.02, 0.01)
    misfit = make(data, torch.ones(1, 9, dtype=torch.bool))
    assert misfit.mask is None
    assert misfit.data is data


@pytest.mark.parametrize("shape", [(12, 13), (3, 1, 1), (2, 1, 12, 1)])
def test_a_mask_broadcasts_to_the_data(make, shape):
    data = recorded(specimen((2, 3, 12, 13)), 0.02, 0.01)
    mask = torch.ones(shape, dtype=torch.bool)
    mask.view(-1)[:1] = False
    misfit, full = make(data, mask), make(data, mask.expand(data.shape).clone())
    assert misfit.mask.shape == data.shape
    assert float(misfit(data + 0.1)) == float(full(data + 0.1))


def test_a_masked_pixel_holds_the_mean_of_its_neighbours():
    data = specimen((2, 2, 9, 10), 1.0, 0.1)
    mask = torch.rand(data.shape) > 0.1
    mask[0, 0, 2, 3] = False
    mask[1, 0] = False
    found = filled(torch.where(mask, data, math.nan), mask)
    square = data[0, 0, :5, 1:6][mask[0, 0, :5, 1:6]]
    assert float(found[0, 0, 2, 3]) == pytest.approx(float(square.mean()))
    assert torch.allclose(found[1, 0], data[1, 1][mask[1, 1]].mean())
    assert torch.equal(found[mask], data[mask])


def test_a_pixel_is_none_of_its_neighbours():
    data = torch.zeros(1, 1, 7, 8, dtype=torch.float64)
    data[0, 0, 3, 4] = 24.0
    mean, number = neighbours(data)
    assert mean[0, 0, 3, 4] == 0
    assert float(mean[0, 0, 2, 3]) == pytest.approx(1)
    assert number[0, 0, 3, 4] == 24
    assert number[0, 0, 0, 0] == 8
    alone, none = neighbours(data, data > 0)
    assert alone[0, 0, 3, 4] == 24  # the image's mean
    assert none[0, 0, 3, 4] == 0


# bad input

DATA = specimen((2, 2, 8, 9))


def not_finite():
    data = DATA.clone()
    data[0, 0, 2, 3] = math.nan
    return data


def no_pixel():
    mask = torch.ones(2, 1, 1, 1, dtype=torch.bool)
    mask[1] = False
    return mask


@pytest.mark.parametrize(
    ("attempt", "law"),
    [
        (lambda: GaussianMisfit(not_finite()), "1 of 288 pixels are not finite; a mask must leave them out"),
        (lambda: GaussianMisfit(DATA, mask=torch.ones(2, 2, 8, 9)), "the mask holds float32, a mask is boolean"),
        (lambda: GaussianMisfit(DATA, mask=no_pixel()), "the mask leaves no pixel of prism 2: there is nothing to fit"),
        (
            lambda: GaussianMisfit(DATA, mask=torch.ones(3, 9, dtype=torch.bool)),
            r"the mask has shape \(3, 9\), the data \(2, 2, 8, 9\)",
        ),
        (
            lambda: GaussianMisfit(DATA, NoiseModel(torch.ones(3), 0.0)),
            r"the gain has shape \(3,\), the data \(2, 2, 8, 9\)",
        ),
        (
            lambda: PoissonMisfit(DATA, NoiseModel(1.0, torch.ones(5, 1))),
            r"the read noise has shape \(5, 1\), the data \(2, 2, 8, 9\)",
        ),
        (lambda: RobustMisfit(DATA, torch.tensor([0.1, 0.0])), "the noise 0 of prism 2 must be above 0 and finite"),
        (lambda: RobustMisfit(DATA, torch.ones(3)), r"the noise has shape \(3,\), the data have 2 prisms"),
        (lambda: RobustMisfit(DATA[..., :2]), "the noise of prism 1 can't be measured: no 3 × 3 pixels count together"),
    ],
)
def test_bad_input_is_refused_in_one_line(attempt, law):
    with pytest.raises(ValueError, match=law) as caught:
        attempt()
    assert "\n" not in str(caught.value)


def test_uniform_images_are_refused_whatever_the_mask_leaves_out(make):
    data = recorded(specimen((2, 2, 8, 9)), 0.02, 0.01)
    data[1] = 0.5
    data[1, 0, 0, 0] = 3.0
    mask = torch.ones(data.shape, dtype=torch.bool)
    mask[1, 0, 0, 0] = False
    with pytest.raises(ValueError, match=r"the images of prism 2 are uniform"):
        make(data, mask)
