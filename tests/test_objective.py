"""The pupil: an aperture whose edge counts as inside, and Zernike aberrations by Noll's index."""

import math

import numpy as np
import pytest
import torch

from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    Layer,
    Microscope,
    Objective,
    Prism,
    ThinLens,
    Volume,
    image,
    image_field,
    thin_lens,
)
from torchdic.imaging.pupil import Pupil, Waves
from torchdic.instrument.objective import apodise
from torchdic.instrument.zernike import zernike
from torchdic.linear import linear_image

# Noll's table, as published, with unit rms over the disc; θ from +x towards +y
NOLL = {
    1: lambda r, t: torch.ones_like(r),
    2: lambda r, t: 2 * r * torch.cos(t),
    3: lambda r, t: 2 * r * torch.sin(t),
    4: lambda r, t: math.sqrt(3) * (2 * r**2 - 1),
    5: lambda r, t: math.sqrt(6) * r**2 * torch.sin(2 * t),
    6: lambda r, t: math.sqrt(6) * r**2 * torch.cos(2 * t),
    7: lambda r, t: math.sqrt(8) * (3 * r**3 - 2 * r) * torch.sin(t),
    8: lambda r, t: math.sqrt(8) * (3 * r**3 - 2 * r) * torch.cos(t),
    9: lambda r, t: math.sqrt(8) * r**3 * torch.sin(3 * t),
    10: lambda r, t: math.sqrt(8) * r**3 * torch.cos(3 * t),
    11: lambda r, t: math.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
    12: lambda r, t: math.sqrt(10) * (4 * r**4 - 3 * r**2) * torch.cos(2 * t),
    13: lambda r, t: math.sqrt(10) * (4 * r**4 - 3 * r**2) * torch.sin(2 * t),
    14: lambda r, t: math.sqrt(10) * r**4 * torch.cos(4 * t),
    15: lambda r, t: math.sqrt(10) * r**4 * torch.sin(4 * t),
    22: lambda r, t: math.sqrt(7) * (20 * r**6 - 30 * r**4 + 12 * r**2 - 1),
}


@pytest.mark.parametrize("index", NOLL)
def test_zernike_is_nolls_table(index):
    rho, theta = torch.rand(100, dtype=torch.float64), 2 * math.pi * torch.rand(100, dtype=torch.float64)
    torch.testing.assert_close(zernike(index, rho, theta), NOLL[index](rho, theta), rtol=0, atol=1e-12)


def test_zernikes_are_orthonormal_over_the_disc():
    """Gauss nodes in r² and even azimuths integrate all products of degree up to 14 exactly."""
    nodes, weights = np.polynomial.legendre.leggauss(9)
    rho = torch.from_numpy(np.sqrt((1 + nodes) / 2))[:, None].expand(9, 40)
    theta = (2 * math.pi * torch.arange(40, dtype=torch.float64) / 40).expand(9, 40)
    share = torch.from_numpy(weights / 2 / 40)[:, None].expand(9, 40)
    terms = torch.stack([zernike(j, rho, theta) for j in range(1, 37)])
    gram = torch.einsum("aij,bij,ij->ab", terms, terms, share)
    torch.testing.assert_close(gram, torch.eye(36, dtype=torch.float64), rtol=0, atol=1e-12)


def test_edge_of_the_pupil_counts_as_inside(dtype):
    edge = 0.75
    around = torch.tensor([edge, math.nextafter(edge, 0), edge * (1 + 1e-5), 0.0, 0.6], dtype=dtype)
    other = torch.tensor([0.0, 0.0, 0.0, -edge, 0.45], dtype=dtype)
    momentum = torch.stack((around, other))[None, :, None, :]
    assert Objective(edge).aperture(momentum)[0, 0].tolist() == [True, True, False, True, True]


def test_aberration_is_the_sum_of_its_terms_scaled_to_the_pupil():
    momentum = torch.randn(2, 2, 4, 5, dtype=torch.float64)
    y, x = (momentum / 0.8).unbind(1)
    phase = Objective(0.8, {3: 0.2, 6: -0.5, 4: torch.tensor(0.1)}).phase(momentum)
    expected = 0.2 * 2 * y - 0.5 * math.sqrt(6) * (x**2 - y**2)
    expected = expected + float(torch.tensor(0.1)) * math.sqrt(3) * (2 * (x**2 + y**2) - 1)
    torch.testing.assert_close(phase, expected)


def test_perfect_lens_has_no_phase_at_all():
    momentum = torch.zeros(1, 2, 3, 3)
    assert Objective(0.8).phase(momentum) is None
    assert Objective(0.8, {}).phase(momentum) is None
    assert Objective(0.8, {4: 0.0}).phase(momentum) is not None


def test_tilt_aberration_moves_the_image():
    """Phase c·2ρ_x over the pupil is exp(2πi f·d) with d = c·λ/(π·NA): it takes U(x) to U(x + d), here whole pixels."""
    grid = Grid((1, 24, 26), (0.5, 0.2, 0.2))
    absorption = torch.zeros(grid.shape, dtype=torch.float64)
    absorption[0, 9, 11], absorption[0, 12, 8] = 0.05, 0.1
    volume = Volume(grid, torch.zeros_like(absorption), 1.36, absorption)
    tilt = 3 * 0.2 * math.pi * 0.8 / 0.546

    def of(**aberrations):
        microscope = Microscope(0.546, Objective(0.8, aberrations.get("terms")))
        return image(volume, microscope, Acquisition([None]))[0, 0]

    plain = of()
    torch.testing.assert_close(of(terms={2: tilt}), plain.roll(-3, 1), rtol=0, atol=1e-13)
    torch.testing.assert_close(of(terms={3: tilt}), plain.roll(-3, 0), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), r"objective NA 0\.0 must be above 0"),
        ((-0.3,), r"objective NA -0\.3 must be above 0"),
        ((0.8, {0: 0.1}), r"aberration 0: a Noll index is a whole number from 1"),
        ((0.8, {4: math.nan}), r"aberration 4: nan rad must be a finite number"),
    ],
)
def test_errors_state_the_number_and_the_law(arguments, message):
    with pytest.raises(ValueError, match=message):
        Objective(*arguments)


# --- lens law ------------------------------------------------------------------------------------------------------

LENGTHS = ("focal_length", "object_distance", "image_distance", "magnification")


@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("second", range(4))
def test_any_two_lengths_give_the_lens(first, second):
    """f 4.5 mm and M 40: a = f(1 + 1/M), b = f(1 + M)."""
    lens = {"focal_length": 4500.0, "object_distance": 4612.5, "image_distance": 184500.0, "magnification": 40.0}
    given = {LENGTHS[i]: lens[LENGTHS[i]] for i in {first, second}}
    if first == second:
        with pytest.raises(ValueError, match=r"needs two of .*; 1 given"):
            thin_lens(**given)
        return
    found = thin_lens(**given)
    assert vars(found) == pytest.approx(lens)
    assert 1 / found.focal_length == pytest.approx(1 / found.object_distance + 1 / found.image_distance)
    assert found.magnification == pytest.approx(found.image_distance / found.object_distance)
    assert thin_lens(**lens) == ThinLens(**lens)


@pytest.mark.parametrize(
    ("given", "law"),
    [
        ({}, "needs two of .*; 0 given"),
        ({"focal_length": 4.0, "object_distance": 3.0}, "object_distance 3 must be above the focal length 4: 1/f"),
        ({"focal_length": 4.0, "image_distance": 4.0}, "image_distance 4 must be above the focal length 4: 1/f"),
        ({"focal_length": -4.0, "image_distance": 5.0}, "focal_length -4 must be above 0"),
        ({"magnification": math.nan, "image_distance": 5.0}, "magnification nan must be above 0"),
        ({"focal_length": 2.0, "object_distance": 3.0, "image_distance": 7.0}, r"1/2 isn't 1/3 \+ 1/7, .* f 2\.1"),
        ({"object_distance": 3.0, "image_distance": 6.0, "magnification": 3.0}, "M = b/a: 3 isn't 6/3 = 2"),
    ],
)
def test_lengths_that_form_no_image_or_contradict_each_other_are_errors(given, law):
    with pytest.raises(ValueError, match=law):
        thin_lens(**given)


# --- apodisation and layer -----------------------------------------------------------------------------------------

N0 = 1.36
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.17, 0.24]], dtype=torch.float64)


def test_aplanatic_amplitude_is_root_cosine_over_that_of_the_direct_light(dtype):
    cosines = torch.tensor([[1.0, 0.5], [0.64, 0.25]], dtype=dtype)
    sines = 1.5 * (1 - cosines.square()).sqrt()
    momentum = torch.stack((0.6 * sines, -0.8 * sines), 0)[None]
    direct = torch.tensor([[0.0, 1.5 * math.sqrt(1 - 0.81**2)]], dtype=dtype)
    found = apodise(momentum, direct, torch.tensor(1.5, dtype=dtype))[0]
    torch.testing.assert_close(found, (cosines / 0.81).sqrt())
    assert float(apodise(2 * momentum, direct, torch.tensor(1.5, dtype=dtype))[0, 1, 1]) == 0


@pytest.mark.filterwarnings("ignore::torchdic.SamplingWarning")  # its voxels cut off what a pupil would
def test_flux_through_an_aplanatic_objective_is_that_through_the_plane_of_focus():
    """Behind the lens Σ|A'|² is what Σ|A|²·cosθ/cosθ0 was in front of it, all of whose waves the pupil takes in."""
    grid = Grid((1, 15, 16), (0.5, 0.4, 0.4))
    t = torch.randn(15, 16, dtype=torch.complex128)
    found = image_field(
        t,
        grid,
        Microscope(0.546, Objective(N0, apodisation="aplanatic"), Condenser(0.4, POINTS[1:2])),
        Acquisition(),
        background=N0,
    )
    waves = POINTS[1, :, None, None] + 0.546 * grid.frequencies(dtype=torch.float64)
    pz2 = N0**2 - waves.square().sum(0)
    flux = torch.fft.fft2(t, norm="forward").abs().square() * pz2.clamp_min(0).sqrt()
    expected = float(flux.sum()) / math.sqrt(N0**2 - float(POINTS[1].square().sum()))
    assert float(found.mean()) == pytest.approx(expected)


@pytest.mark.parametrize("points", [None, POINTS], ids=["disc", "points"])
def test_empty_field_is_sin2_half_bias_through_any_pupil(points, propagation):
    grid = Grid((2, 9, 10), (0.5, 0.2, 0.2))
    objective = Objective(0.75, {4: 0.3}, "aplanatic", Layer(20.0, 1.36, 1.515))
    scope = Microscope(0.546, objective, Condenser(0.4, points))
    volume = Volume(grid, torch.zeros(grid.shape, dtype=torch.float64), N0)
    images = image(volume, scope, Acquisition([None, Prism((0.1, 0.2), 1.1)], [0.4]), Fidelity(propagation))
    expected = torch.tensor([1.0, math.sin(0.55) ** 2], dtype=torch.float64)
    torch.testing.assert_close(images, expected[:, None, None, None].expand_as(images), rtol=0, atol=1e-12)


def test_layer_retards_by_its_thickness_times_the_difference_of_axial_momenta(dtype):
    momentum = 0.5 * torch.randn(2, 2, 4, 5, dtype=dtype)
    found = Layer(12.5, 1.45, 1.515).phase(momentum, 0.5)
    p2 = momentum.double().square().sum(1)
    expected = 2 * math.pi / 0.5 * 12.5 * ((1.45**2 - p2).sqrt() - (1.515**2 - p2).sqrt())
    # relative, though each of the two paths is 450 rad
    torch.testing.assert_close(
        found.double(), torch.where(p2 < 1.45**2, expected, 0), rtol=20 * torch.finfo(dtype).eps, atol=0
    )


def test_layers_of_the_designs_index_or_no_thickness_do_nothing_but_are_values():
    momentum = 0.5 * torch.randn(2, 2, 4, 5, dtype=torch.float64)
    for layer in (Layer(0.0, 1.36, 1.515), Layer(12.5, 1.515, 1.515)):
        assert float(layer.phase(momentum, 0.5).abs().max()) == 0
        assert Objective(0.8, layer=layer).transfer(momentum, POINTS[:2], 0.5, torch.tensor(N0)) is not None
    assert Objective(0.8).transfer(momentum, POINTS[:2], 0.5, torch.tensor(N0)) is None


def test_thin_layers_defocus_is_kept():
    """In a narrow pupil the layer makes the plane z_f + t·n0·(1/n − 1/n_d) sharp, and does nothing else."""
    grid = Grid((1, 40, 42), (0.5, 1.2, 1.2))
    t = 1 + 0.3 * torch.randn(40, 42, dtype=torch.float64) + 0j

    def of(focus, layer=None):
        scope = Microscope(0.546, Objective(0.12, layer=layer))
        return image_field(t, grid, scope, Acquisition(focus=[focus]), background=N0)

    shift = 60 * N0 * (1 / 1.36 - 1 / 1.515)
    shifted, plain = of(5.0, Layer(60.0, 1.36, 1.515)), of(5.0 + shift)
    assert float((shifted - plain).abs().max()) < 0.01 * float((of(5.0) - plain).abs().max())


def test_compensating_layers_cancel():
    momentum = 0.5 * torch.randn(2, 2, 4, 5, dtype=torch.float64)
    there, back = Layer(12.5, 1.45, 1.515), Layer(12.5, 1.515, 1.45)
    torch.testing.assert_close(there.phase(momentum, 0.5), -back.phase(momentum, 0.5))
    torch.testing.assert_close(there.phase(momentum, 0.5), -Layer(-12.5, 1.45, 1.515).phase(momentum, 0.5))


@pytest.mark.parametrize("objective", [None, Objective(0.75), Objective(1.3, {4: 0.3}, "aplanatic")])
def test_pupil_passes_the_waves_that_propagate_within_the_aperture(objective):
    """Whether f is the whole array's or a few frequencies of each source; what is stopped is exactly 0."""
    grid, n0 = Grid((1, 10, 13), (1.0, 0.13, 0.15)), torch.tensor(1.36, dtype=torch.float64)
    every = grid.frequencies(dtype=torch.float64)
    for frequencies in (every, every[:, 2:5, 1:8].expand(len(POINTS), -1, -1, -1)):
        waves = Waves(grid, 0.546, n0, POINTS, frequencies)
        momentum = POINTS[:, :, None, None] + 0.546 * frequencies
        length = momentum.norm(dim=1)
        pupil = Pupil.of(objective, waves)
        passes = length < 1.36 if objective is None else length <= objective.na
        assert torch.equal(pupil.passes, passes)
        assert 0 < int(passes.sum()) < passes.numel() or frequencies is not every
        factor = None if objective is None else objective.transfer(momentum, POINTS, 0.546, n0)
        spectrum = torch.ones(len(POINTS), 2, *frequencies.shape[-2:], dtype=torch.complex128)
        behind = spectrum if factor is None else factor[:, None] * spectrum
        assert torch.equal(pupil.through(spectrum), torch.where(passes[:, None], behind, 0))
        root = torch.where(length < 1.36, 1.36**2 - length**2, 0).sqrt()
        torch.testing.assert_close(pupil.pz, root)
        difference = root - (1.36**2 - POINTS.square().sum(1)).sqrt()[:, None, None]
        torch.testing.assert_close(pupil.difference[passes], difference[passes], rtol=0, atol=1e-14)
        paraxial = -(length**2 - POINTS.square().sum(1)[:, None, None]) / (2 * 1.36)
        torch.testing.assert_close(Pupil.of(objective, waves, "paraxial").difference, paraxial, rtol=0, atol=1e-13)


def test_weak_specimen_is_seen_through_the_same_pupil(smooth_field):
    """The linear image tends to that of the wave rung with apodisation and layer too: ten times weaker, a hundredth."""
    grid = Grid((3, 12, 14), (0.5, 0.2, 0.2))
    scope = Microscope(0.546, Objective(0.75, {7: 0.2}, "aplanatic", Layer(20.0, 1.36, 1.515)), Condenser(0.4, POINTS))
    acquisition, errors = Acquisition([Prism((0.1, 0.2), 1.1), None], [0.4]), []
    for contrast in (1e-3, 1e-4):
        volume = Volume(grid, smooth_field(grid, contrast), N0)
        exact, linear = image(volume, scope, acquisition, Fidelity("wave")), linear_image(volume, scope, acquisition)
        errors.append(float((exact - linear).abs().max()))
    assert errors[1] == pytest.approx(errors[0] / 100, rel=0.1)


@pytest.mark.parametrize("name", ["thickness", "index", "design_index", "coefficient", "background"])
@pytest.mark.parametrize("at_zero", [False, True])
def test_gradients_are_central_differences(name, at_zero, smooth_field):
    grid = Grid((2, 8, 9), (0.5, 0.22, 0.2))
    delta = smooth_field(grid, 0.04)
    values = {"thickness": 12.0, "index": 1.37, "design_index": 1.515, "coefficient": 0.2, "background": 1.36}
    if at_zero:
        values |= {"thickness": 0.0, "coefficient": 0.0}

    def of(**values):
        layer = Layer(values["thickness"], values["index"], values["design_index"])
        objective = Objective(0.8, {5: values["coefficient"]}, "aplanatic", layer)
        volume = Volume(grid, delta, values["background"])
        scope = Microscope(0.546, objective, Condenser(0.4, POINTS))
        images = image(volume, scope, Acquisition([Prism((0.1, 0.2), 0.8)], [0.4]), Fidelity("wave"))
        return (images * torch.linspace(0.2, 1, images.numel(), dtype=torch.float64).reshape(images.shape)).sum()

    value = torch.tensor(values[name], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(of(**{**values, name: value}), value)
    step = 1e-4
    at = [float(of(**{**values, name: values[name] + i * step})) for i in (-2, -1, 1, 2)]
    expected = (8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * step)
    assert float(gradient) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert abs(expected) > 1e-4 or (at_zero and name in {"index", "design_index"})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Layer(math.inf, 1.5, 1.5), r"layer thickness inf µm must be a finite number"),
        (lambda: Layer(1.0, 0.9, 1.5), r"layer index 0\.9 must be a refractive index of at least 1"),
        (lambda: Layer(1.0, 1.5, math.nan), r"layer design_index nan must be"),
        (lambda: Objective(1.4, layer=Layer(1.0, 1.515, 1.33)), r"objective NA 1\.4 exceeds .* design_index 1\.33"),
    ],
)
def test_impossible_layers_are_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()
