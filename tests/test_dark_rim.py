"""Apertures above the medium's index: light beyond the index is dark, and one line says so."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from data_synthetic import Bead, GaussianBall
from recon.fit.descent import minimise
from recon.fit.newton.weak_hessian import axial_band
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.report.metrics import volume_error
from recon.run.exact_images import exact_images
from torchdic import (
    Acquisition,
    ApertureWarning,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Layer,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Volume,
    foreseen,
    image,
    image_field,
    plan,
)
from torchdic.instrument.microscope import check_apertures, in_medium, limited
from torchdic.linear import linear_image, transfer_functions

N0 = 1.335
GRID = Grid((4, 24, 26), (0.3, 0.1, 0.1))
ACQUISITION = Acquisition([Prism((0.0, 0.15), 1.2), None], [-0.4, 0.3])
PROPAGATIONS = ("projection", "rays", "wave")
pytestmark = [
    pytest.mark.filterwarnings("ignore::torchdic.ApertureWarning"),
    pytest.mark.filterwarnings("ignore::torchdic.WrapAroundWarning"),
    pytest.mark.filterwarnings("ignore::torchdic.SamplingWarning"),
]


def ball(dtype=torch.float64, grid=GRID, contrast=0.05):
    """So small that it scatters to the pupil's rim."""
    return Volume(grid, GaussianBall(sigma=0.12, contrast=contrast, background=N0).delta(grid, dtype=dtype), N0)


def scope(na, na_c=0.6, **parts):
    return Microscope(0.546, Objective(na, **parts), Condenser(na_c))


def weighed(images):
    """One number that hangs on each pixel in its own way."""
    drawn = torch.randn(images.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    return (images * drawn).sum()


def largest_difference(found, expected):
    contrast = float((expected - expected.mean((-2, -1), keepdim=True)).abs().max())
    return float((found - expected).abs().max()) / contrast


# --- the image -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("propagation", PROPAGATIONS)
def test_an_objective_above_the_index_images_as_one_at_the_index(propagation, dtype):
    fidelity = Fidelity(propagation, sources=8)
    beyond, at = (image(ball(dtype), scope(na), ACQUISITION, fidelity) for na in (1.45, N0))
    assert bool(beyond.isfinite().all())
    assert largest_difference(beyond, at) < 10 * torch.finfo(dtype).eps
    narrower = image(ball(dtype), scope(1.2), ACQUISITION, fidelity)
    assert largest_difference(narrower, at) > 1e-2  # the light between 1.2 and the index is there


@pytest.mark.parametrize("objective", [1.45, 0.8, None])
@pytest.mark.parametrize("propagation", PROPAGATIONS)
def test_a_condenser_above_the_index_lights_as_one_at_the_index(propagation, objective):
    lens = None if objective is None else Objective(objective)
    fidelity, weak = Fidelity(propagation, sources=8), ball(contrast=1e-3)
    beyond, at = (image(weak, Microscope(0.546, lens, Condenser(na)), ACQUISITION, fidelity) for na in (1.4, N0))
    assert bool(beyond.isfinite().all())
    assert torch.equal(beyond, at)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 7, 40, 500])
def test_every_direction_of_a_limited_condenser_runs_in_the_medium(count, dtype):
    for inner in (None, 1.0):
        if inner is not None and count == 1:
            continue
        lit = limited(Microscope(0.546, Objective(0.9), Condenser(1.4, inner_na=inner)), N0, dtype)
        points, weights = lit.sources(count, dtype=dtype)
        assert bool((points.square().sum(1) < N0**2).all())
        assert float(weights.sum()) == pytest.approx(1)


def test_a_dry_condenser_keeps_its_own_aperture():
    dry = scope(1.45, 0.95)
    assert in_medium(dry, N0).condenser.na == 0.95
    assert torch.equal(in_medium(dry, N0).sources(20)[0], dry.sources(20)[0])


@pytest.mark.parametrize("compute", ["image", "image_field"])
def test_the_empty_field_stays_that_of_the_prism(compute):
    microscope, acquisition = scope(1.45, 1.4), Acquisition([Prism((0.0, 0.15), 0.7), None], [0.0])
    if compute == "image":
        found = image(Volume(GRID, torch.zeros(GRID.shape, dtype=torch.float64), N0), microscope, acquisition)
    else:
        flat = torch.ones(GRID.shape[1:], dtype=torch.complex128)
        found = image_field(flat, GRID, microscope, acquisition, background=N0)
    expected = torch.tensor([math.sin(0.35) ** 2, 1.0], dtype=torch.float64)[:, None, None, None]
    torch.testing.assert_close(found, expected.expand_as(found), rtol=0, atol=1e-12)


@pytest.mark.parametrize("parts", [{"aberrations": {4: 0.3, 11: 0.4}}, {"apodisation": "aplanatic"}])
def test_zernike_terms_keep_the_objectives_own_aperture(parts):
    """Defocus and spherical aberration over NA 1.45, as polynomials over the smaller disc of the index: Noll 11 of
    ρ = (n/NA)·ρ' is √5(6a⁴ρ'⁴ − 6a²ρ'² + 1), a = n/NA, which holds some of Noll 4."""
    a, own = N0 / 1.45, parts
    if "aberrations" in parts:
        # √5·(6a⁴ρ⁴ − 6a²ρ²) = a⁴·Z11 + √5·(6a⁴ − 6a²)ρ² + piston, and √3·2ρ² = Z4 + piston
        defocus = 0.3 * a**2 + 0.4 * math.sqrt(5) * (6 * a**4 - 6 * a**2) / (2 * math.sqrt(3))
        own = {"aberrations": {4: defocus, 11: 0.4 * a**4}}
    beyond = image(ball(), scope(1.45, **parts), ACQUISITION, Fidelity(sources=8))
    expected = image(ball(), scope(N0, **own), ACQUISITION, Fidelity(sources=8))
    assert largest_difference(beyond, expected) < 1e-12
    if "aberrations" in parts:
        assert largest_difference(beyond, image(ball(), scope(N0, **parts), ACQUISITION, Fidelity(sources=8))) > 0.05


def test_polarised_lenses_are_finite_up_to_the_rim():
    pupil = JonesPupil({6: (0.2, 0.0), 5: (0.0, 0.2)}, depolarisation=True)
    for dtype in (torch.float32, torch.float64):
        volume = Volume(GRID, ball(dtype).delta.requires_grad_(), N0)
        microscope = replace(scope(1.45, 1.4), polarisation=Polarisation(pupil=pupil))
        images = image(volume, microscope, ACQUISITION, Fidelity(sources=8))
        (gradient,) = torch.autograd.grad(images.square().sum(), volume.delta)
        assert bool(images.isfinite().all())
        assert bool(gradient.isfinite().all())


# --- layers ----------------------------------------------------------------------------------------------------------


def test_an_oil_objectives_mismatch_with_water_is_a_layer():
    """Of no thickness it changes nothing; 5 µm of water in place of oil change the image, and nothing else is dark."""
    images = [
        image(ball(), scope(1.45, layer=layer), ACQUISITION, Fidelity(sources=8))
        for layer in (None, Layer(0.0, N0, 1.515), Layer(5.0, N0, 1.515))
    ]
    assert largest_difference(images[1], images[0]) < 1e-12
    assert largest_difference(images[2], images[0]) > 0.1
    empty = Volume(GRID, torch.zeros(GRID.shape, dtype=torch.float64), N0)
    bright = image(empty, scope(1.45, 1.0, layer=Layer(5.0, N0, 1.515)), ACQUISITION, Fidelity(sources=8))[1]
    torch.testing.assert_close(bright, torch.ones_like(bright))


def test_light_beyond_a_layers_index_is_dark():
    """A specimen in glass behind water: the objective sees it as one whose aperture is water's index."""
    glass = Volume(GRID, ball().delta, 1.5)
    behind, at = (
        image(glass, scope(na, layer=layer), ACQUISITION, Fidelity(sources=8))
        for na, layer in ((1.45, Layer(0.0, N0, 1.515)), (N0, None))
    )
    assert largest_difference(behind, at) < 1e-12
    with pytest.warns(ApertureWarning, match=r"objective NA 1\.45 exceeds the layer's index 1\.335: .* dark$"):
        in_medium(scope(1.45, layer=Layer(0.0, N0, 1.515)), 1.5)


# --- gradients -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("propagation", PROPAGATIONS)
def test_gradients_are_finite_up_to_the_rim(propagation, dtype):
    values = [torch.tensor(v, dtype=dtype, requires_grad=True) for v in (0.1, 2.0, N0, N0, 0.2)]
    coefficient, thickness, index, background, focus = values
    lens = {"aberrations": {4: coefficient}, "apodisation": "aplanatic", "layer": Layer(thickness, index, 1.515)}
    delta = ball(dtype).delta.requires_grad_()
    volume = Volume(GRID, delta, background)
    images = image(volume, scope(1.45, **lens), Acquisition([Prism((0.0, 0.15), 1.2)], [focus]), Fidelity(propagation))
    gradients = torch.autograd.grad(images.square().sum(), [delta, *values])
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)
    assert all(float(gradient.abs().max()) > 0 for gradient in gradients)


@pytest.mark.parametrize("name", ["coefficient", "thickness", "background", "focus", "contrast"])
def test_gradients_are_central_differences(name):
    start = {"coefficient": 0.2, "thickness": 2.0, "background": N0, "focus": 0.2, "contrast": 1.0}

    def of(**values):
        lens = {"aberrations": {11: values["coefficient"]}, "apodisation": "aplanatic"}
        layer = Layer(values["thickness"], 1.34, 1.515)
        volume = Volume(GRID, ball().delta * values["contrast"], values["background"])
        acquisition = Acquisition([Prism((0.0, 0.15), 1.2)], [values["focus"]])
        images = image(volume, scope(1.45, layer=layer, **lens), acquisition, Fidelity(sources=6))
        return weighed(images)

    value = torch.tensor(start[name], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(of(**start | {name: value}), value)
    step = 1e-5
    at = [float(of(**start | {name: start[name] + i * step})) for i in (-2, -1, 1, 2)]
    expected = (8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * step)
    assert abs(expected) > 1e-3
    assert float(gradient) == pytest.approx(expected, rel=1e-5)


# --- what else reads the aperture ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_transfer_functions_end_at_the_index(dtype):
    beyond, at = (
        transfer_functions(GRID, scope(na, na_c), ACQUISITION, N0, dtype=dtype) for na, na_c in ((1.45, 1.4), (N0, N0))
    )
    assert torch.equal(beyond, at)
    assert bool(torch.view_as_real(beyond).isfinite().all())


def test_gradients_of_a_limited_condenser_are_central_differences():
    def of(contrast):
        volume = Volume(GRID, ball(contrast=1e-2).delta * contrast, N0)
        images = image(volume, scope(1.45, 1.4), ACQUISITION, Fidelity(sources=12))
        return weighed(images)

    value = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(of(value), value)
    expected = (float(of(1 + 1e-4)) - float(of(1 - 1e-4))) / 2e-4
    assert abs(expected) > 1e-3
    assert float(gradient) == pytest.approx(expected, rel=1e-6)


def test_the_linear_image_is_that_of_a_weak_specimen():
    volumes = ball(contrast=1e-3), ball(contrast=1e-4)
    fidelity = Fidelity("wave", sources=8)
    errors = []
    for volume in volumes:
        scene = volume, scope(1.45), ACQUISITION, fidelity
        errors.append(largest_difference(linear_image(*scene), image(*scene)))
    assert errors[1] < 0.2 * errors[0]


def test_the_exact_images_of_a_bead_agree_with_the_waves():
    bead, grid = Bead(0.4, 0.02, N0), Grid((16, 24, 24), (0.1, 0.1, 0.1))
    fidelity = Fidelity("wave", sources=6, padding=12)
    microscope = scope(1.45, 0.5)
    exact = exact_images(bead, grid, microscope, ACQUISITION, fidelity)
    found = image(Volume(grid, bead.delta(grid), N0), microscope, ACQUISITION, fidelity)
    assert float((exact - found)[0].square().mean().sqrt()) < 0.05 * float(exact[0].std())


def test_the_plan_of_an_objective_above_the_index_is_that_of_one_at_the_index():
    volume = ball(torch.float32, Grid((4, 16, 16), (0.3, 0.15, 0.15)))
    acquisition = Acquisition([Prism((0.0, 0.15), 1.2)], [0.0])
    beyond, at = (plan(volume, scope(na, 0.4), acquisition, 0.2) for na in (1.45, N0))
    assert beyond.fidelity == at.fidelity
    assert beyond.error == pytest.approx(at.error, rel=1e-3)


def test_memory_is_foreseen_for_the_limited_apertures():
    beyond, at = (foreseen(ball(), scope(na, na_c), ACQUISITION) for na, na_c in ((1.45, 1.4), (N0, N0)))
    assert beyond == at


def test_newton_and_its_hessian_work_above_the_index():
    truth = ball(torch.float32)
    setup = Setup(truth, scope(1.45, 1.4), ACQUISITION)
    assert axial_band(setup) == axial_band(replace(setup, microscope=scope(N0, N0)))
    with torch.no_grad():
        data = setup.images(Fidelity(sources=6))
    start = replace(setup, volume=empty_medium(GRID, N0, data))
    problem = Problem.from_recipe(data, start, Fidelity(sources=6), Recipe(steps=6), noise=[1e-3, 1e-3])
    steps = list(minimise(problem))
    assert all(math.isfinite(step.loss) for step in steps)
    assert volume_error(steps[-1].delta, truth.delta) < 0.9


# --- what it says ----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("default::torchdic.ApertureWarning")
def test_one_line_names_both_numbers_and_the_layer():
    cases = {
        (1.45, 0.6): "objective NA 1.45 exceeds the medium's index 1.335: light beyond the index is dark",
        (0.8, 1.4): "condenser NA 1.4 exceeds the medium's index 1.335: light beyond the index is dark",
        (1.45, 1.4): "objective NA 1.45 exceeds the medium's index 1.335 and condenser NA 1.4 exceeds",
        (N0, N0): None,
        (N0 + 1e-8, N0 + 1e-8): None,
        (1.3, 0.9): None,
    }
    for (na, na_c), line in cases.items():
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always", ApertureWarning)
            image(ball(), scope(na, na_c), ACQUISITION, Fidelity(sources=4))
        found = [str(w.message) for w in seen if w.category is ApertureWarning]
        assert len(found) == (line is not None)
        if line is not None:
            assert found[0].startswith(line)
            assert ("(Layer)" in found[0]) == (na > N0)
            assert "\n" not in found[0]


@pytest.mark.parametrize(
    ("microscope", "message"),
    [
        (scope(1.9), r"objective NA 1\.9 must be at most 1\.8"),
        (scope(1.4, 2.0), r"condenser NA 2 must be at most 1\.8"),
        (Microscope(0.546, None, Condenser(1.4, inner_na=1.35)), r"inner NA 1\.35 must stay below .* 1\.335: no light"),
        (Microscope(0.546, None, Condenser(N0, inner_na=N0)), r"inner NA 1\.335 must stay below .* 1\.335: no light"),
    ],
)
def test_apertures_that_cannot_be_are_errors(microscope, message):
    for dtype in (torch.float32, torch.float64):
        with pytest.raises(ValueError, match=message):
            check_apertures(microscope, N0, dtype)
    with pytest.raises(ValueError, match=message):
        image(ball(), microscope, ACQUISITION)


def test_a_denser_medium_permits_a_larger_aperture():
    check_apertures(scope(2.0, 2.0), 2.2)
