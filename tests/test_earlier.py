"""Earlier models invert their own images: the weak specimen, and the thin phase object of each section."""

import math
from dataclasses import replace

import pytest
import torch
from distant import Device, bring, send

from data_synthetic import CellPhantom, GaussianBall
from recon.earlier.path_length import Integration, path_length, spread
from recon.earlier.phase_difference import phase_differences
from recon.earlier.tikhonov import FREE, LinearModel, tikhonov
from recon.earlier.weight import Components, choose_weight, cross_validated
from recon.fit.bounds import Bounds
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.background import noise_level
from recon.report.metrics import volume_error
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Volume,
    image,
    image_field,
)
from torchdic.instrument.polarised_lenses import JonesPupil
from torchdic.linear import linear_image, transfer_functions, two_beam_image

N0 = 1.5
GRID = Grid((6, 24, 21), (0.5, 0.2, 0.19))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
PRISMS = (Prism((0.03, 0.2), 1.3), Prism((0.2, 0.0), -1.1))
FOCUS = (-1.5, -0.75, 0.0, 0.75, 1.5)
SOURCES = 18


def setup_of(data, grid=GRID, prisms=PRISMS, focus=FOCUS, microscope=MICROSCOPE):
    return Setup(empty_medium(grid, N0, data), microscope, Acquisition(prisms, focus))


def two_balls(grid=GRID, contrast=2e-3, dtype=torch.float64):
    """Unequal balls off the centre along every axis: no swapped or mirrored axis leaves them alike."""
    one = GaussianBall(0.45, contrast, N0, (0.5, -0.9, 0.7))
    other = GaussianBall(0.35, contrast / 2, N0, (-0.75, 1.1, -0.8))
    return one.delta(grid, dtype=dtype) + other.delta(grid, dtype=dtype)


def linear_data(delta, noise=0.0, grid=GRID, prisms=PRISMS, focus=FOCUS, microscope=MICROSCOPE):
    """Linear images of Δn with noise, and their setup."""
    fidelity = Fidelity("wave", sources=SOURCES)
    images = linear_image(Volume(grid, delta, N0), microscope, Acquisition(prisms, focus), fidelity)
    data = images + noise * torch.randn(images.shape, dtype=images.dtype)
    return data, setup_of(data, grid, prisms, focus, microscope)


def contrast_of(data):
    return float(GaussianMisfit(data).variance.mean().sqrt())


def dense(components_of, weight):
    """The components of a small random problem, and the residual and fitted numbers that matrices give."""
    A, d = components_of
    s, V = torch.linalg.eigh(A.T @ A)
    energies = (V.T @ A.T @ d).square() / s
    components = Components.of(s, energies, torch.ones_like(s), float(d @ d), len(d))
    influence = A @ torch.linalg.solve(A.T @ A + weight * torch.eye(A.shape[1], dtype=A.dtype), A.T)
    return components, float((d - influence @ d).square().sum()), float(influence.trace())


# --- the weight ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weight", [1e-3, 0.3, 40.0])
def test_residual_and_fitted_numbers_of_a_weight_are_those_of_the_matrices(weight):
    problem = torch.randn(9, 4, dtype=torch.float64), torch.randn(9, dtype=torch.float64)
    components, residual, fitted = dense(problem, weight)
    assert components.residual(weight) == pytest.approx(residual, rel=1e-10)
    assert components.fitted(weight) == pytest.approx(fitted, rel=1e-10)
    assert components.noise(weight) == pytest.approx(residual / (9 - fitted), rel=1e-10)


def test_cross_validation_finds_a_weight_near_the_best_one_for_the_prediction():
    A = torch.randn(400, 100, dtype=torch.float64) * torch.logspace(1, -3, 100, dtype=torch.float64)
    truth = torch.randn(100, dtype=torch.float64)
    d = A @ truth + torch.randn(400, dtype=torch.float64)
    components, _, _ = dense((A, d), 1.0)

    def risk(weight):
        found = torch.linalg.solve(A.T @ A + weight * torch.eye(100, dtype=A.dtype), A.T @ d)
        return float((A @ (found - truth)).square().sum())

    weight = cross_validated(components)
    assert risk(weight) < 1.3 * min(risk(10**t) for t in torch.linspace(-3, 5, 33).tolist())
    # the noise's variance is 1, and 300 to 400 numbers tell it to a standard deviation of 8 %
    assert components.noise(weight) == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize("counted", [False, True])
def test_the_noise_s_variance_is_met_or_left_to_cross_validation(counted):
    A, truth = torch.randn(50, 20, dtype=torch.float64), torch.randn(20, dtype=torch.float64)
    d = A @ truth + torch.randn(50, dtype=torch.float64)
    components, _, _ = dense((A, d), 1.0)
    variance = 1.5  # more than the noise has, so that some weight reaches it
    weight, rule = choose_weight(components, variance, counted=counted)
    left = 50 - (components.fitted(weight) if counted else 0)
    assert rule == "discrepancy"
    assert components.residual(weight) == pytest.approx(variance * left, rel=1e-4)
    validated = cross_validated(components), "cross-validation"
    assert choose_weight(components, 1e-3, counted=counted) == validated
    assert choose_weight(components, None, counted=counted) == validated
    assert choose_weight(components, float(d @ d) / 50, counted=counted) == (math.inf, "discrepancy")


def test_robust_cross_validation_weighs_more_than_the_plain_one():
    A, truth = torch.randn(50, 20, dtype=torch.float64), torch.randn(20, dtype=torch.float64)
    components, _, _ = dense((A, A @ truth + torch.randn(50, dtype=torch.float64)), 1.0)
    assert cross_validated(components, 0.1) > cross_validated(components, 0.3) > cross_validated(components)


# --- the weak specimen -----------------------------------------------------------------------------------------------


def model_of(data, setup):
    volume, microscope, acquisition = setup.volume, setup.microscope, setup.acquisition
    fidelity = Fidelity("wave", sources=SOURCES)
    T = transfer_functions(volume.grid, microscope, acquisition, N0, fidelity, dtype=data.dtype)
    scale = GaussianMisfit(data).variance.rsqrt()
    half = (scale[..., None] * T)[..., : volume.grid.shape[2] // 2 + 1].flatten(0, 1)
    empty = linear_image(volume, microscope, acquisition, fidelity)
    return LinearModel(volume.grid, half), (scale * (data - empty)).flatten(0, 1)


@pytest.mark.parametrize("shape", [(3, 10, 12), (3, 9, 12), (2, 10, 11), (4, 7, 9)])
def test_the_model_is_the_linear_image_and_its_adjoint_fits(shape):
    grid = Grid(shape, (0.5, 0.2, 0.21))
    delta = 0.1 * torch.randn(shape, dtype=torch.float64)
    data, setup = linear_data(delta, grid=grid, prisms=(*PRISMS, None))
    model, d = model_of(data, setup)
    # to rounding
    assert torch.allclose(model.images(delta), d, rtol=0, atol=1e-11 * float(d.abs().max()))
    other = torch.randn_like(d)
    assert float((model.images(delta) * other).sum()) == pytest.approx(float((delta * model.adjoint(other)).sum()))


@pytest.mark.parametrize("noise", [0.05, 0.2, 0.6])
def test_the_misfit_of_the_linear_images_is_the_noise_s(noise):
    data, setup = linear_data(two_balls())
    sigma = noise * contrast_of(data)
    data = data + sigma * torch.randn_like(data)
    result = tikhonov(data, setup, sigma, sources=SOURCES)
    assert result.rule == "discrepancy"
    expected = GaussianMisfit(data).of_noise([sigma] * len(PRISMS))
    assert result.misfit == pytest.approx(expected, rel=1e-3)
    images = linear_image(
        Volume(GRID, result.delta, N0), setup.microscope, setup.acquisition, Fidelity(sources=SOURCES)
    )
    assert float(GaussianMisfit(data)(images)) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("known", [True, False])
def test_the_weight_grows_with_the_noise(known):
    clean, setup = linear_data(two_balls())
    pattern = torch.randn_like(clean)
    weights = []
    for level in (0.03, 0.1, 0.3):
        sigma = level * contrast_of(clean)
        weights.append(tikhonov(clean + sigma * pattern, setup, sigma if known else None, sources=SOURCES).weight)
    assert weights[0] < weights[1] < weights[2]


@pytest.mark.parametrize("shape", [(6, 24, 20), (6, 23, 21)])
def test_a_weak_specimen_s_images_are_told_from_their_noise(shape):
    grid = Grid(shape, GRID.spacing)
    truth = two_balls(grid)
    clean, setup = linear_data(truth, grid=grid)
    sigma = 0.2 * contrast_of(clean)
    found = tikhonov(clean + sigma * torch.randn_like(clean), setup, sigma, sources=SOURCES).delta
    images = linear_image(Volume(grid, found, N0), setup.microscope, setup.acquisition, Fidelity(sources=SOURCES))
    # 10 images of 6 slices: the noise has at least 4/10 of its numbers outside, and the prior holds more of them back
    assert float((images - clean).square().mean().sqrt()) < 0.6 * sigma
    visible = truth - truth.mean((1, 2), keepdim=True)
    assert float((found * visible).sum() / (found.norm() * visible.norm())) > 0.8
    for axis in range(3):
        assert volume_error(found.flip(axis), truth) > 1.2 * volume_error(found, truth)


def test_one_frequency_s_answer_is_the_closed_form():
    grid, focus = Grid((1, 12, 16), (0.5, 0.2, 0.2)), (-0.4, 0.3)
    y, x = torch.arange(12, dtype=torch.float64)[:, None], torch.arange(16, dtype=torch.float64)
    phase = 2 * math.pi * (2 * y / 12 + 3 * x / 16)
    data, setup = linear_data(1e-3 * torch.cos(phase + 0.4)[None], grid=grid, focus=focus)
    sigma = 0.1 * contrast_of(data)
    result = tikhonov(data, setup, sigma, sources=SOURCES)
    fidelity = Fidelity("wave", sources=SOURCES)
    T = transfer_functions(grid, MICROSCOPE, setup.acquisition, N0, fidelity, dtype=torch.float64)[..., 0, 2, 3]
    v = GaussianMisfit(data).variance[:, 0, 0]
    D = torch.fft.fft2(data)[..., 2, 3]
    value = (T.conj() * D / v).sum() / ((T.abs().square() / v).sum() + result.weight)
    expected = 2 / phase.numel() * (value.real * phase.cos() - value.imag * phase.sin())
    assert torch.allclose(result.delta[0], expected, rtol=0, atol=1e-9 * float(expected.abs().max()))


def test_without_bounds_the_sum_has_no_slope():
    data, setup = linear_data(two_balls(), 1e-4)
    result = tikhonov(data, setup, 1e-4, sources=SOURCES)
    model, d = model_of(data, setup)
    slope = model.adjoint(model.images(result.delta) - d) + result.weight * result.delta
    assert float(slope.norm()) < 1e-9 * float(model.adjoint(d).norm())
    # and it is the same when rows of frequencies are solved one by one
    apart = tikhonov(data, setup, 1e-4, sources=SOURCES, memory=1)
    assert torch.allclose(apart.delta, result.delta, rtol=0, atol=1e-9 * float(result.delta.abs().max()))


@pytest.mark.parametrize("bounds", [Bounds(0.0, None), Bounds(None, 5e-4), Bounds(-1e-4, 1e-3)])
def test_within_bounds_the_sum_falls_nowhere_and_is_below_that_of_clipping(bounds):
    data, setup = linear_data(two_balls(), 1e-3)
    free = tikhonov(data, setup, 1e-3, sources=SOURCES)
    result = tikhonov(data, setup, 1e-3, bounds, SOURCES)
    model, d = model_of(data, setup)

    def total(delta):
        return float((model.images(delta) - d).square().sum() + free.weight * delta.square().sum())

    low, high = (
        -math.inf if bounds.lower is None else bounds.lower,
        math.inf if bounds.upper is None else bounds.upper,
    )
    assert result.weight == free.weight
    assert low <= float(result.delta.min())
    assert float(result.delta.max()) <= high
    assert total(free.delta) < total(result.delta) < total(free.delta.clamp(low, high))
    slope = model.adjoint(model.images(result.delta) - d) + free.weight * result.delta
    inside = (result.delta > low) & (result.delta < high)
    start = float(model.adjoint(d).norm())
    # the descent ends where a step changes Δn by 1e-4 of itself
    assert float(slope[inside].norm()) < 3e-3 * start
    for at, sign in ((result.delta <= low, 1), (result.delta >= high, -1)):
        assert float((sign * slope[at]).clamp_max(0).norm()) < 3e-3 * start


def test_a_bound_finds_the_mean_that_the_images_do_not_show():
    truth = two_balls()
    data, setup = linear_data(truth, 2e-4)
    free = tikhonov(data, setup, 2e-4, sources=SOURCES).delta
    bounded = tikhonov(data, setup, 2e-4, Bounds(0.0, None), SOURCES).delta
    assert float(free.mean((1, 2)).abs().max()) < 1e-6 * float(truth.max())
    assert volume_error(bounded, truth) < min(volume_error(free, truth), volume_error(free.clamp_min(0), truth))


def test_a_strong_specimen_s_misfit_stays_above_its_noise_and_cross_validation_decides():
    truth = two_balls(contrast=0.05)
    acquisition = Acquisition(PRISMS, FOCUS)
    with torch.no_grad():
        data = image(Volume(GRID, truth, N0), MICROSCOPE, acquisition, Fidelity("wave", sources=SOURCES))
    data = data + 1e-3 * torch.randn_like(data)
    result = tikhonov(data, setup_of(data), 1e-3, sources=SOURCES)
    assert result.rule == "cross-validation"
    assert result.misfit > GaussianMisfit(data).of_noise([1e-3, 1e-3])
    assert volume_error(result.delta, truth) < 1


def test_what_is_below_the_noise_is_no_specimen():
    data, setup = linear_data(two_balls(), 1e-4)
    result = tikhonov(data, setup, 1.0, sources=SOURCES)
    assert (result.weight, result.rule) == (math.inf, "discrepancy")
    assert float(result.delta.abs().max()) == 0
    assert float(tikhonov(data, setup, 1.0, Bounds(0.0, None), SOURCES).delta.abs().max()) == 0


def test_each_prism_s_noise_counts_by_itself():
    data, setup = linear_data(two_balls())
    sigma = [0.1 * float(v.sqrt()) for v in GaussianMisfit(data).variance.flatten()]
    data = data + torch.tensor(sigma)[:, None, None, None] * torch.randn_like(data)
    result = tikhonov(data, setup, sigma, sources=SOURCES)
    assert result.misfit == pytest.approx(GaussianMisfit(data).of_noise(sigma), rel=1e-3)


def test_float32_finds_what_float64_finds():
    data, setup = linear_data(two_balls(), 3e-4)
    double = tikhonov(data, setup, 3e-4, sources=SOURCES)
    single = tikhonov(data.float(), setup_of(data.float()), 3e-4, sources=SOURCES)
    assert single.delta.dtype == torch.float32
    # data of size 0.3 are rounded by 2e-8, a ten-thousandth of the noise
    assert volume_error(single.delta.double(), double.delta) < 1e-3


def test_rolled_images_give_the_rolled_specimen():
    data, setup = linear_data(two_balls(), 3e-4)
    result = tikhonov(data, setup, 3e-4, sources=SOURCES)
    rolled = tikhonov(data.roll((3, -4), (2, 3)), setup, 3e-4, sources=SOURCES)
    assert volume_error(rolled.delta, result.delta.roll((3, -4), (1, 2))) < 1e-6


def test_a_weak_specimen_is_not_sought_where_there_is_no_linear_response():
    data, setup = linear_data(two_balls(), 1e-4)
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.5), condenser_prism=False)
    with pytest.raises(ValueError, match="it needs a condenser prism"):
        tikhonov(data, replace(setup, microscope=microscope), 1e-4)
    strained = Polarisation(pupil=JonesPupil(retardance={4: (0.3, 0.0)}))
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.5), polarisation=strained)
    with pytest.raises(ValueError, match="can't hold a polarisation pupil"):
        tikhonov(data, replace(setup, microscope=microscope), 1e-4)
    unbiased = Acquisition((PRISMS[0], Prism((0.2, 0.0), 2 * math.pi)), FOCUS)
    with pytest.raises(ValueError, match=r"prism 2 \(bias 6.28319\) has no linear response"):
        tikhonov(data, replace(setup, acquisition=unbiased), 1e-4)


@pytest.mark.parametrize("method", [tikhonov, path_length])
def test_bad_input_is_refused_in_one_line(method):
    data, setup = linear_data(two_balls(), 1e-4)
    with pytest.raises(ValueError, match=r"the data have shape \(2, 5, 24, 20\), the acquisition and grid ask for"):
        method(data[..., :20], setup, None)
    with pytest.raises(ValueError, match="noise has 3 values for 2 prisms"):
        method(data, setup, [1e-4] * 3)
    for noise in (-0.1, math.nan):
        with pytest.raises(ValueError, match=f"noise {noise} must be a standard deviation of at least 0"):
            method(data, setup, noise)
    camera = Microscope(0.546, Objective(0.8), Condenser(0.5), Camera(pixel_size=0.2))
    with pytest.raises(ValueError, match=r"camera.pixel_size 0.2 µm: the model's pixels are its volume's voxels"):
        method(data, replace(setup, microscope=camera), 1e-4)
    for name, value in (("brightness", torch.ones(2, 5)), ("drift", torch.zeros(2, 5, 2)), ("margin", 2)):
        with pytest.raises(ValueError, match=f"the setup has a {name}, of which the earlier models know nothing"):
            method(data, replace(setup, **{name: value}), 1e-4)


# --- the thin phase object -------------------------------------------------------------------------------------------

THIN = Grid((5, 40, 45), (0.4, 0.2, 0.2))
HALF = math.pi / 2
PAIRS = tuple(Prism(shear, bias) for shear in ((0.0, 0.2), (0.2, 0.0)) for bias in (HALF, -HALF))


def bumps(grid=THIN, peak=1.0):
    """A phase of two unequal, elongated bumps, asymmetric along both axes; at the border below 1e-3 of the peak."""
    y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    y = y[:, None]
    one = torch.exp(-(((y + 0.8) / 0.9) ** 2) - ((x - 1.0) / 1.3) ** 2)
    return peak * (one + 0.6 * torch.exp(-(((y - 1.4) / 0.6) ** 2) - ((x + 1.5) / 0.8) ** 2))


def thin_images(phase, prisms, grid=THIN, noise=0.0):
    """Images (prism, 1, y, x) of a thin phase, with noise."""
    images = torch.stack([two_beam_image(phase, grid, prism) for prism in prisms])[:, None]
    return images + noise * torch.randn(images.shape, dtype=images.dtype)


def thin_setup(data, prisms, grid=THIN, focus=(0.0,)):
    return setup_of(data, grid, prisms, focus)


def error_of(opl, phase):
    """Relative error of a section's path length; the light's wavelength is the microscope's."""
    truth = phase * MICROSCOPE.wavelength / (2 * math.pi)
    return float((opl - truth).norm() / truth.norm())


def difference_of(phase, prism):
    """Phase difference along a prism's shear, from its image at a bias of 90° by the sine."""
    return torch.asin(2 * two_beam_image(phase, THIN, Prism(prism.shear, HALF)) - 1)


@pytest.mark.parametrize(
    "biases", [(1.1, -1.1), (2.2, -2.2), (0.9,), (-2.0,), (0.0, HALF, math.pi, -HALF), (0.3, 1.4, -0.8)]
)
@pytest.mark.parametrize("shear", [(0.0, 0.2), (0.2, -0.1), (0.0, -0.3)])
def test_images_of_a_thin_object_give_its_phase_differences_exactly(biases, shear):
    prisms = [Prism(shear, bias) for bias in biases]
    phase = bumps()
    (found,) = phase_differences(thin_images(phase, prisms), prisms)
    sign = 1 if found.shear == shear else -1
    assert found.shear == (sign * shear[0], sign * shear[1])
    # the inverse of the sine doubles the digits that are lost where I is near 0 or 1
    assert torch.allclose(found.phase[0], sign * difference_of(phase, prisms[0]), rtol=0, atol=1e-7)


def test_reversed_shear_with_reversed_bias_is_the_same_image_and_makes_a_pair():
    prisms = (Prism((0.0, 0.2), 1.2), Prism((0.0, -0.2), 1.2))
    (found,) = phase_differences(thin_images(bumps(), prisms), prisms)
    assert torch.allclose(found.phase[0], difference_of(bumps(), prisms[0]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("biases", [(1.1, -1.1), (0.3, 1.4, -0.8)])
def test_absorption_leaves_pairs_and_steps_of_phase_alone(biases):
    prisms = [Prism((0.1, 0.2), bias) for bias in biases]
    through = 0.5 + 0.5 * torch.rand(THIN.shape[1:], dtype=torch.float64)
    (found,) = phase_differences(through * thin_images(bumps(), prisms), prisms)
    assert torch.allclose(found.phase[0], difference_of(bumps(), prisms[0]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("biases", [(1.1, -1.1), (0.9,), (0.0, HALF, math.pi, -HALF)])
def test_the_stated_variance_is_that_of_noise_on_a_small_phase(biases):
    prisms, sigma = [Prism((0.0, 0.2), bias) for bias in biases], 1e-3
    flat = torch.zeros(THIN.shape[1:], dtype=torch.float64)
    (found,) = phase_differences(thin_images(flat, prisms, noise=sigma), prisms)
    # 1800 pixels tell a variance to 3 %
    assert float(found.phase.square().mean()) / sigma**2 == pytest.approx(found.variance, rel=0.12)


def integration(prisms=PAIRS, noise=0.0):
    return Integration(THIN, phase_differences(thin_images(bumps(), prisms, noise=noise), prisms))


def test_the_integration_s_right_hand_side_is_the_adjoint_of_the_differences():
    """A shear of two pixels is a difference of rolled arrays."""
    prisms = tuple(Prism(shear, bias) for shear in ((0.0, 0.4), (0.4, 0.0)) for bias in (HALF, -HALF))
    problem = integration(prisms)
    other = torch.randn(THIN.shape[1:], dtype=torch.float64)
    expected = 0.0
    for d, axis in zip(problem.differences, (1, 0), strict=True):
        rolled = other.roll(-1, axis) - other.roll(1, axis)
        expected += float((rolled * d.phase[0]).sum()) / d.variance
    found = float((other * torch.fft.ifft2(problem.right())[0].real).sum())
    assert found == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("shape", [(40, 45), (41, 44), (40, 40)])
def test_two_shear_axes_give_a_thin_object_s_path_length(shape):
    grid = Grid((5, *shape), THIN.spacing)
    phase = bumps(grid)
    data = thin_images(phase, PAIRS, grid)
    result = path_length(data, thin_setup(data, PAIRS, grid), None)
    assert result.opl.shape == (1, *shape)
    assert error_of(result.opl[0], phase) < 0.01
    for axis in range(2):
        assert error_of(result.opl[0].flip(axis), phase) > 0.5
    assert error_of(-result.opl[0], phase) > 1


@pytest.mark.parametrize(
    ("prisms", "most"), [(PAIRS, 0.05), (PAIRS[::2], 0.06), (PAIRS[:2], 0.4), ((Prism((0.15, 0.15), 1.0),), 0.25)]
)
def test_a_noisy_object_s_path_length_is_found(prisms, most):
    data = thin_images(bumps(), prisms, noise=0.005)
    for noise in (0.005, None):
        result = path_length(data, thin_setup(data, prisms), noise)
        assert result.rule == ("discrepancy" if noise else "cross-validation")
        assert error_of(result.opl[0], bumps()) < most


def test_the_differences_keep_the_noise_s_variance_but_for_what_is_fitted():
    problem, sigma = integration(noise=0.01), 0.01
    components = problem.components()
    weight, rule = choose_weight(components, sigma**2, counted=True)
    assert rule == "discrepancy"
    spectrum = problem.right()[0] / (problem.seen + weight * problem.curvature).clamp_min(1e-300)
    spectrum[0, 0] = 0
    phase = torch.fft.ifft2(spectrum).real
    left = 0.0
    for d, transfer in zip(problem.differences, problem.transfers, strict=True):
        model = torch.fft.ifft2(transfer * torch.fft.fft2(phase)).real
        left += float((d.phase[0] - d.phase[0].mean() - model).square().sum()) / d.variance
    # two differences in each pixel, whose means no phase has
    freedom = 2 * (phase.numel() - 1)
    passed = problem.seen / (problem.seen + weight * problem.curvature).clamp_min(1e-300)
    assert left == pytest.approx(sigma**2 * (freedom - float(passed.sum())), rel=1e-4)


@pytest.mark.parametrize("known", [True, False])
def test_the_weight_of_smoothness_grows_with_the_noise(known):
    weights = []
    pattern = torch.randn(4, 1, *THIN.shape[1:], dtype=torch.float64)
    for sigma in (1e-3, 1e-2, 5e-2):
        data = thin_images(bumps(), PAIRS) + sigma * pattern
        weights.append(path_length(data, thin_setup(data, PAIRS), sigma if known else None).weight)
    assert weights[0] < weights[1] < weights[2]


def test_one_axis_leaves_smaller_streaks_than_a_sum_along_it():
    prisms = (Prism((0.0, 0.2), HALF), Prism((0.0, 0.2), -HALF))
    data = thin_images(bumps(), prisms, noise=0.03)
    (measured,) = phase_differences(data, prisms)
    summed = measured.phase[0].cumsum(1)  # one pixel is the shear
    summed = (summed - summed[:, :1]) * MICROSCOPE.wavelength / (2 * math.pi)
    found = path_length(data, thin_setup(data, prisms), 0.03).opl[0]
    truth = bumps() * MICROSCOPE.wavelength / (2 * math.pi)

    def streaks(opl):
        """The error that a row has in common, without what neighbouring rows share."""
        return float((opl - truth).mean(1).diff().std())

    assert streaks(found) < streaks(summed) / 5
    assert error_of(found, bumps()) < error_of(summed, bumps()) / 2


def test_a_specimen_that_reaches_the_border_is_not_flattened():
    phase = bumps().roll(14, 1)
    data = thin_images(phase, PAIRS, noise=0.005)
    found = path_length(data, thin_setup(data, PAIRS), 0.005).opl[0]
    truth = phase * MICROSCOPE.wavelength / (2 * math.pi)
    # the border's median is no longer the medium's
    assert float((found - truth).std() / truth.std()) < 0.1


def test_each_section_is_found_alone_and_the_volume_has_their_path_length():
    phases = [bumps(), -0.5 * bumps().flip(1), 0.3 * bumps().flip(0)]
    focus = (0.7, -0.9, -0.1)  # in no order
    data = torch.cat([thin_images(phase, PAIRS) for phase in phases], 1)
    result = path_length(data, thin_setup(data, PAIRS, focus=focus), 1e-4)
    for opl, phase in zip(result.opl, phases, strict=True):
        assert error_of(opl, phase) < 0.02
    assert result.delta.shape == THIN.shape
    assert torch.equal(result.delta, spread(result.opl, focus, THIN))


def test_a_volume_s_sections_are_interpolated_and_its_projection_is_their_path():
    opl = torch.rand(2, *THIN.shape[1:], dtype=torch.float64)
    delta = spread(opl, (0.4, -0.4), THIN)  # slices at −0.8, −0.4, 0, 0.4, 0.8
    depth = THIN.extent[0]
    for z, expected in enumerate((opl[1], opl[1], (opl[0] + opl[1]) / 2, opl[0], opl[0])):
        assert torch.allclose(delta[z] * depth, expected, rtol=0, atol=1e-14)
    alone = spread(opl[:1], (3.0,), THIN)
    assert torch.allclose(alone.sum(0) * THIN.spacing[0], opl[0], rtol=0, atol=1e-14)
    twice = spread(torch.stack((opl[0], opl[0])), (0.0, 0.0), THIN)
    assert torch.allclose(twice.sum(0) * THIN.spacing[0], opl[0], rtol=0, atol=1e-14)


def test_a_thin_slice_under_axial_light_has_its_path_length():
    """The full model's image in focus; the pupil takes little of so smooth a phase."""
    data = image_field(
        torch.polar(torch.ones_like(bumps()), bumps()),
        THIN,
        Microscope(0.546, Objective(1.2)),
        Acquisition(PAIRS),
        background=N0,
    )
    result = path_length(data, thin_setup(data, PAIRS), None)
    assert error_of(result.opl[0], bumps()) < 0.03


def test_images_said_to_hold_no_noise_are_left_to_cross_validation():
    data = thin_images(bumps(), PAIRS[::2], noise=0.003)
    told, unknown = (path_length(data, thin_setup(data, PAIRS[::2]), noise) for noise in (0.0, None))
    assert told.rule == "cross-validation"
    assert torch.equal(told.opl, unknown.opl)


def test_nothing_but_noise_is_a_flat_section():
    flat = torch.zeros(THIN.shape[1:], dtype=torch.float64)
    data = thin_images(flat, PAIRS, noise=0.01)
    result = path_length(data, thin_setup(data, PAIRS), 0.02)
    assert (result.weight, result.rule) == (math.inf, "discrepancy")
    assert float(result.opl.abs().max()) == 0


def test_path_lengths_follow_the_data_s_dtype():
    data = thin_images(bumps(), PAIRS, noise=0.01)
    double = path_length(data, thin_setup(data, PAIRS), 0.01)
    single = path_length(data.float(), thin_setup(data.float(), PAIRS), 0.01)
    assert single.opl.dtype == single.delta.dtype == torch.float32
    assert float((single.opl - double.opl).norm() / double.opl.norm()) < 1e-4


@pytest.mark.parametrize(
    ("prisms", "law"),
    [
        ((None, None), "opl needs an image with a sheared prism: bright field in focus shows no phase"),
        ((Prism((0.0, 0.0), 1.0), None), r"shear \(0, 0\) µm shows no phase"),
        ((Prism((0.0, 0.2), 0.0), None), "bias 0 rad alone shows no sign of a phase difference"),
        ((Prism((0.0, 0.2), math.pi), PAIRS[2]), "bias 3.14159 rad alone shows no sign of a phase difference"),
    ],
)
def test_images_that_show_no_phase_are_refused(prisms, law):
    data = thin_images(bumps(), PAIRS[:2])
    with pytest.raises(ValueError, match=law):
        path_length(data, thin_setup(data, prisms), None)


def test_a_shear_across_a_single_line_of_pixels_is_refused():
    grid, prisms = Grid((1, 1, 32), THIN.spacing), (Prism((0.2, 0.0), 1.0),)
    data = torch.rand(1, 1, 1, 32, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"shear \(0.2, 0\) µm shows no phase in a field of 1 × 32 pixels"):
        path_length(data, thin_setup(data, prisms, grid), None)


# --- both ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [PAIRS, tuple(Prism((0.0, 0.2), bias) for bias in (0.3, 1.4, -0.8))])
def test_path_lengths_are_the_same_on_another_device(steps):
    data = thin_images(bumps(), steps, noise=0.01)
    here = path_length(data, thin_setup(data, steps), 0.01)
    with Device():
        sent = send(data)
        there = path_length(sent, thin_setup(sent, steps), 0.01)
    for found, expected in ((there.opl, here.opl), (there.delta, here.delta)):
        assert torch.allclose(bring(found), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bounds", [FREE, Bounds(0.0, None)])
def test_a_weak_specimen_is_the_same_on_another_device(bounds):
    data, setup = linear_data(two_balls(), 1e-3)
    here = tikhonov(data, setup, 1e-3, bounds, SOURCES)
    with Device():
        sent = send(data)
        there = tikhonov(sent, setup_of(sent), 1e-3, bounds, SOURCES)
    assert torch.allclose(bring(there.delta), here.delta, rtol=0, atol=1e-9 * float(here.delta.abs().max()))


# --- both on a cell --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_cell_s_path_length_and_volume_are_found_from_full_images():
    """Images of a finer wave with other directions, pixels that integrate, and 4000 photons."""
    cell, fine, grid = CellPhantom(), Grid((60, 128, 128), (0.4 / 3, 0.1, 0.1)), Grid((20, 64, 64), (0.4, 0.2, 0.2))
    focus = tuple(float(z) for z in range(-4, 5))
    camera = Camera(photons=4000, pixel_size=0.2)
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.7), camera)
    volume = Volume(fine, cell.delta(fine, torch.float32), cell.background)
    with torch.no_grad():
        clean = image(volume, microscope, Acquisition(PAIRS, focus), Fidelity("wave", sources=112, order=1))
    data = camera.record(clean, torch.Generator().manual_seed(1))
    noise = [noise_level(images.numpy()) for images in data]
    seen = Microscope(0.546, Objective(0.9), Condenser(0.7))
    setup = Setup(empty_medium(grid, cell.background, data), seen, Acquisition(PAIRS, focus))
    truth = cell.delta(grid, torch.float32)
    path = truth.sum(0) * grid.spacing[0]
    sections = path_length(data, setup, noise)
    assert float((sections.opl[4] - path).norm() / path.norm()) < 0.12
    assert volume_error(sections.delta, truth) < 0.7
    free, bounded = (tikhonov(data, setup, noise, bounds) for bounds in (FREE, Bounds(0.0, None)))
    assert free.rule == "discrepancy"
    assert volume_error(bounded.delta, truth) < 0.52 < volume_error(free.delta, truth) < 0.75
