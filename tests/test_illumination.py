"""Light of several wavelengths; and that what a scene does not have costs nothing."""

import math

import pytest
import torch
from through import propagate

from data_synthetic import Bead
from recon.config.conversion import dump
from recon.config.reading import load
from recon.config.schema import ConfigError
from recon.run.exact_images import exact_images
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    Layer,
    Microscope,
    Objective,
    Prism,
    SamplingWarning,
    Spectrum,
    Volume,
    image,
    image_field,
)
from torchdic.linear import linear_image
from torchdic.plane_waves import axial_difference, exp_i, to_field

N0 = 1.36
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.17, 0.24]], dtype=torch.float64)


@pytest.fixture
def volume(small, smooth_field):
    return Volume(small, smooth_field(small, 0.03), N0)


def of(wavelength, spectrum=None, objective=None):
    condenser = Condenser(0.4, POINTS)
    return Microscope(wavelength, objective or Objective(0.75, {4: 0.2}), condenser, spectrum=spectrum)


# --- several wavelengths -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weights", [None, (3.0,)])
def test_spectrum_of_one_wavelength_is_that_wavelength_exactly(volume, acquisition, propagation, weights):
    plain = image(volume, of(0.546), acquisition, Fidelity(propagation))
    assert torch.equal(image(volume, of(0.546, Spectrum((0.546,), weights)), acquisition, Fidelity(propagation)), plain)


def test_image_of_two_wavelengths_is_the_weighted_mean_of_their_images(volume, acquisition, propagation):
    fidelity = Fidelity(propagation)
    red, blue = image(volume, of(0.65), acquisition, fidelity), image(volume, of(0.49), acquisition, fidelity)
    both = image(volume, of(0.55, Spectrum([0.65, 0.49], [1.0, 3.0])), acquisition, fidelity)
    torch.testing.assert_close(both, (red + 3 * blue) / 4, rtol=0, atol=1e-14)
    assert float((red - blue).abs().max()) > 0.01


def test_empty_field_is_sin2_half_bias_in_light_of_any_colours(small, propagation):
    """The bias is a phase at each wavelength."""
    empty = Volume(small, torch.zeros(small.shape, dtype=torch.float64), N0)
    scope = of(0.55, Spectrum((0.49, 0.55, 0.62), (0.2, 1.0, 0.0)))
    images = image(empty, scope, Acquisition([None, Prism((0.1, 0.2), 1.1)], [0.7]), Fidelity(propagation))
    expected = torch.tensor([1.0, math.sin(0.55) ** 2], dtype=torch.float64)
    torch.testing.assert_close(images, expected[:, None, None, None].expand_as(images), rtol=0, atol=1e-14)


def test_layers_phase_goes_with_the_wavelength():
    momentum = 0.5 * torch.randn(1, 2, 4, 5, dtype=torch.float64)
    layer = Layer(12.0, 1.4, 1.515)
    torch.testing.assert_close(2 * layer.phase(momentum, 0.8), layer.phase(momentum, 0.4))


def test_colours_share_the_sources_directions():
    scope = of(0.55, Spectrum((0.5, 0.6)))
    assert [part.wavelength for part, _ in scope.colours()] == [0.5, 0.6]
    assert sum(share for _, share in scope.colours()) == 1
    assert all(part.spectrum is None for part, _ in scope.colours())
    for part, _ in scope.colours():
        assert torch.equal(part.sources(40, dtype=torch.float64)[0], POINTS)


def test_weak_specimen_is_linear_in_each_colour(volume, acquisition):
    scope = of(0.55, Spectrum((0.5, 0.6), (1.0, 2.0)))
    found = linear_image(volume, scope, acquisition)
    parts = [linear_image(volume, of(wavelength), acquisition) for wavelength in (0.5, 0.6)]
    torch.testing.assert_close(found, (parts[0] + 2 * parts[1]) / 3, rtol=0, atol=1e-14)


def test_exact_field_has_colours_too():
    grid = Grid((4, 16, 18), (0.4, 0.2, 0.2))
    bead, acquisition = Bead(0.6, 0.02, N0), Acquisition([Prism((0.1, 0.2), 1.1)])
    found = exact_images(bead, grid, of(0.55, Spectrum((0.55, 0.6))), acquisition, Fidelity("wave"))
    parts = [exact_images(bead, grid, of(w), acquisition, Fidelity("wave")) for w in (0.55, 0.6)]
    torch.testing.assert_close(found, (parts[0] + parts[1]) / 2, rtol=0, atol=1e-14)


@pytest.mark.parametrize("absent", [False, True])
def test_gradient_is_the_sum_over_the_colours(small, smooth_field, acquisition, absent):
    delta = smooth_field(small, 0.0 if absent else 0.03)

    def gradient(*scopes):
        value = delta.clone().requires_grad_()
        total = sum(image(Volume(small, value, N0), s, acquisition, Fidelity("wave")).square().sum() for s in scopes)
        return torch.autograd.grad(total, value)[0]

    found = gradient(of(0.55, Spectrum((0.55, 0.55))))
    torch.testing.assert_close(found, gradient(of(0.55)), rtol=1e-10, atol=1e-14)
    assert float(found.abs().max()) > 0


def test_sampling_is_judged_by_the_shortest_wavelength_and_reported_once(volume, acquisition):
    coarse = Grid(volume.grid.shape, (0.5, 0.2, 0.235))
    with pytest.warns(SamplingWarning, match="0.235 µm are coarser .* = 0.217 µm") as seen:
        image(Volume(coarse, volume.delta, N0), of(0.546, Spectrum((0.546, 0.5, 0.6))), acquisition)
    assert len(seen) == 1


def test_transmission_of_several_wavelengths_is_an_error():
    grid = Grid((1, 8, 9), (0.5, 0.2, 0.2))
    with pytest.raises(ValueError, match="a transmission belongs to one wavelength, the spectrum has 2"):
        image_field(torch.ones(8, 9), grid, of(0.55, Spectrum((0.5, 0.6))), Acquisition(), background=N0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((),), "needs at least one wavelength"),
        (((0.5, 0.0),), r"wavelength 0\.0 µm of the spectrum must be above 0"),
        (((0.5, math.nan),), r"wavelength nan µm"),
        (((0.5, 0.6), (1.0,)), r"2 wavelengths and 1 weights"),
        (((0.5, 0.6), (1.0, -1.0)), r"weights must be at least 0"),
        (((0.5, 0.6), (0.0, 0.0)), r"positive finite sum"),
    ],
)
def test_impossible_spectra_are_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        Spectrum(*arguments)


def test_nominal_wavelength_lies_in_the_spectrum():
    with pytest.raises(ValueError, match=r"wavelength 0\.7 µm lies outside its spectrum, 0\.5 to 0\.6 µm"):
        Microscope(0.7, spectrum=Spectrum((0.5, 0.6)))


# --- configuration -------------------------------------------------------------------------------------------------

TOML = """
[volume]
shape = [4, 12, 14]
spacing = [0.4, 0.2, 0.2]
background = 1.36
[microscope]
wavelength = 0.55
objective = { na = 0.8, apodisation = "aplanatic", layer = { thickness = 20, index = 1.36, design_index = 1.515 } }
condenser = { na = 0.5, inner_na = 0.3 }
spectrum = { wavelengths = [0.5, 0.55, 0.6], weights = [1, 2, 1] }
[acquisition]
focus = [0.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }]
"""


def test_illumination_and_objective_load_and_are_dumped_again(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text(TOML, encoding="utf-8")
    scope = load(path).microscope
    assert scope.spectrum == Spectrum((0.5, 0.55, 0.6), (1.0, 2.0, 1.0))
    assert scope.condenser.inner_na == 0.3
    assert scope.objective.apodisation == "aplanatic"
    layer = scope.objective.layer
    assert (layer.thickness, layer.index, layer.design_index) == (20.0, 1.36, 1.515)
    again = tmp_path / "again.toml"
    again.write_text(dump(load(path)), encoding="utf-8")
    assert dump(load(again)) == dump(load(path))
    for name in ("inner_na", "apodisation", "layer", "spectrum", "weights"):
        assert name in dump(load(path))


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ('"aplanatic"', '"gaussian"', "'gaussian' must be one of 'aplanatic'"),
        ("inner_na = 0.3", "inner_na = 0.6", "inner NA 0.6 must be from 0 to its NA 0.5"),
        ("[0.5, 0.55, 0.6]", "[0.5, 0.6]", "2 wavelengths and 3 weights"),
        ("thickness = 20", 'thickness = "20"', "'20' must be a number"),
        ("index = 1.36,", "indx = 1.36,", "did you mean 'index'"),
    ],
)
def test_impossible_values_in_a_file_are_named(tmp_path, before, after, problem):
    path = tmp_path / "config.toml"
    path.write_text(TOML.replace(before, after), encoding="utf-8")
    with pytest.raises(ConfigError, match="microscope") as caught:
        load(path)
    assert problem in str(caught.value)


# --- absent effects cost nothing -----------------------------------------------------------------------------------


@pytest.fixture
def transforms(monkeypatch):
    """How many Fourier transforms a call takes."""
    calls = []
    for name in ("fft2", "ifft2", "fft", "ifft", "rfft2", "irfft2", "fftn", "ifftn"):
        plain = getattr(torch.fft, name)
        monkeypatch.setattr(torch.fft, name, lambda *a, _plain=plain, **k: calls.append(1) or _plain(*a, **k))

    def count(function):
        calls.clear()
        function()
        return len(calls)

    return count


@pytest.mark.parametrize(
    ("parts", "factor"),
    [
        ({}, 1),
        ({"objective": Objective(0.75, apodisation="aplanatic")}, 1),
        ({"objective": Objective(0.75, layer=Layer(20.0, 1.36, 1.515))}, 1),
        ({"condenser": Condenser(0.4, inner_na=0.2)}, 1),
        ({"camera": Camera(500, bits=12, pixel_size=0.4)}, 1),
        ({"spectrum": Spectrum((0.546,))}, 1),
        ({"spectrum": Spectrum((0.5, 0.546, 0.6))}, 3),
    ],
    ids=["plain", "apodised", "layer", "annulus", "camera", "one-colour", "three-colours"],
)
def test_transforms_are_those_of_propagation_and_of_each_prism_and_focus(
    volume, acquisition, transforms, parts, factor
):
    """Four to each of four slabs, and one to each of 3 prisms and 2 planes, for all sources at once."""
    scope = Microscope(0.546, **({"objective": Objective(0.75), "condenser": Condenser(0.4)} | parts))
    assert transforms(lambda: image(volume, scope, acquisition, Fidelity("wave", order=2))) == factor * (16 + 6)
    assert transforms(lambda: image(volume, scope, acquisition, Fidelity("projection"))) == factor * (1 + 6)


def test_absent_effects_leave_the_image_to_its_rounding(volume, acquisition, propagation, dtype):
    """Written out on the whole array without any of them: aperture, aberrations, exact defocus, shear and bias."""
    volume = Volume(volume.grid, volume.delta.to(dtype), N0)
    scope, fidelity = Microscope(0.546, Objective(0.75, {4: 0.3, 7: -0.2}), Condenser(0.4)), Fidelity(propagation)
    momentum, weights = scope.sources(fidelity.sources, dtype=dtype)
    plane = volume.grid.extent[0] / 2 if propagation == "wave" else volume.mean_plane()
    spectrum = propagate(volume, 0.546, momentum, plane, fidelity)
    frequencies = volume.grid.frequencies(dtype=dtype)
    difference, pz = axial_difference(volume.grid, 0.546, volume.background, momentum)
    waves = momentum[:, :, None, None] + 0.546 * frequencies
    spectrum = spectrum * exp_i(scope.objective.phase(waves))
    spectrum = torch.where((pz > 0) & scope.objective.aperture(waves), spectrum, 0)
    found = image(volume, scope, acquisition, fidelity)
    for f, focus in enumerate(acquisition.focus):
        sharp = spectrum * exp_i(2 * math.pi / 0.546 * (torch.tensor(focus, dtype=dtype) - plane) * difference)
        for p, prism in enumerate(acquisition.prisms):
            field = to_field(sharp if prism is None else sharp * prism.transfer(frequencies))
            expected = torch.tensordot(weights, torch.view_as_real(field).square(), 1).sum(-1)
            # images of about 1, each a sum over 40 sources of transforms in another order
            torch.testing.assert_close(found[p, f], expected, rtol=0, atol=16 * torch.finfo(dtype).eps)
