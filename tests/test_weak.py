"""Earlier models of DIC are limits of this one, reached at the rate that theory gives."""

import math
from dataclasses import replace

import pytest
import torch

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field
from torchdic.linear import linear_image, transfer_function, transfer_functions, two_beam_image

N0 = 1.36
PRISMS = (Prism((0.05, 0.21), 1.1), Prism((0.17, -0.04), -0.7), Prism((0.24, 0.0), math.pi / 2), None)
WAVE = Fidelity("wave", sources=14)


def microscopes():
    aberrations = {4: 0.2, 6: 0.3, 7: -0.4}
    return {
        "coherent": Microscope(0.546, Objective(0.75)),
        "partially coherent": Microscope(0.546, Objective(0.75), Condenser(0.4)),
        "aberrated": Microscope(0.546, Objective(0.75, aberrations), Condenser(0.4)),
        "some light misses the pupil": Microscope(0.546, Objective(0.5), Condenser(0.7)),
        "no pupil": Microscope(0.546, None, Condenser(0.4)),
        "weighted directions": Microscope(
            0.546, Objective(0.75), Condenser(0.5, torch.tensor([[0.3, -0.4], [0.1, 0.2]]), torch.tensor([2.0, 1.0]))
        ),
    }


def derivative(delta, grid, microscope, acquisition, fidelity, absorption=False):
    """The image's slope along δ at an empty volume: a central difference, whose error is (k0·dz·ε·δ)² = 1e-9."""
    empty, epsilon = torch.zeros_like(delta), 1e-5
    if absorption:  # κ is never negative: a one-sided difference of second order
        volumes = [Volume(grid, empty, N0, k * epsilon * delta) for k in (0, 1, 2)]
        f = [image(v, microscope, acquisition, fidelity) for v in volumes]
        return (4 * f[1] - 3 * f[0] - f[2]) / (2 * epsilon)
    f = [image(Volume(grid, e * delta, N0), microscope, acquisition, fidelity) for e in (epsilon, -epsilon)]
    return (f[0] - f[1]) / (2 * epsilon)


def applied(transfers, slices):
    return torch.fft.ifft2((transfers * torch.fft.fft2(slices)).sum(-3))


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", microscopes())
def test_transfer_function_is_the_slope_of_the_image_in_each_slice(small, name, order):
    microscope = microscopes()[name]
    fidelity = replace(WAVE, order=order)
    acquisition = Acquisition(PRISMS, (0.6, -0.9))
    T = transfer_functions(small, microscope, acquisition, N0, fidelity, dtype=torch.float64)
    assert T.shape == (4, 2, *small.shape)
    for z in range(small.shape[0]):
        delta = torch.zeros(small.shape, dtype=torch.float64)
        delta[z] = torch.rand(small.shape[1:], dtype=torch.float64)
        expected = derivative(delta, small, microscope, acquisition, fidelity)
        found = applied(T, delta)
        assert float(found.imag.abs().max()) < 1e-12 * float(found.abs().max())
        assert float((found.real - expected).abs().max()) < 1e-8 * float(expected.abs().max())


@pytest.mark.parametrize("plane", [None, 0.5])
@pytest.mark.parametrize("name", ["projection", "rays"])
def test_light_on_rays_goes_straight_on_to_the_reference_plane(name, plane):
    """Bent rays too, to first order, but for their amplitude."""
    grid, microscope = Grid((4, 24, 24), (0.5, 0.2, 0.2)), microscopes()["partially coherent"]
    fidelity = replace(WAVE, propagation=name, amplitude=False, interpolation="cubic", reference_plane=plane or 0.0)
    acquisition = Acquisition(PRISMS, (0.6, -0.9))
    T = transfer_functions(grid, microscope, acquisition, N0, fidelity, dtype=torch.float64)
    y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    ball = torch.exp(-(y[:, None].square() + x.square()) / (2 * 0.45**2))
    for z in range(4):
        delta = torch.zeros(grid.shape, dtype=torch.float64)
        delta[z] = ball
        expected = derivative(delta, grid, microscope, acquisition, fidelity)
        found = applied(T, delta).real
        assert float((found - expected).abs().max()) < 0.02 * float(expected.abs().max())


@pytest.mark.parametrize("shape", [(3, 10, 12), (3, 9, 10), (2, 7, 9)])
def test_transfer_function_of_absorption_is_the_slope_in_kappa(shape):
    grid, microscope = Grid(shape, (0.5, 0.2, 0.21)), microscopes()["partially coherent"]
    acquisition, kappa = Acquisition(PRISMS, (0.4,)), torch.rand(shape, dtype=torch.float64)
    T = transfer_functions(grid, microscope, acquisition, N0, WAVE, absorption=True, dtype=torch.float64)
    expected = derivative(kappa, grid, microscope, acquisition, WAVE, absorption=True)
    # a one-sided difference errs by 2(k0·Σdz·ε)²/3
    assert float((applied(T, kappa).real - expected).abs().max()) < 1e-7 * float(expected.abs().max())


@pytest.mark.parametrize("steps", [1, 3, 4, 8, 10])
def test_transfer_function_knows_the_wave_s_slabs(small, steps):
    fidelity, microscope = replace(WAVE, steps=steps), microscopes()["partially coherent"]
    acquisition, delta = Acquisition(PRISMS[:1], (0.6,)), torch.rand(small.shape, dtype=torch.float64)
    T = transfer_functions(small, microscope, acquisition, N0, fidelity, dtype=torch.float64)
    expected = derivative(delta, small, microscope, acquisition, fidelity)
    # the whole depth takes part in the difference's error: (k0·2 µm·ε)² = 5e-8
    assert float((applied(T, delta).real - expected).abs().max()) < 5e-8 * float(expected.abs().max())


@pytest.mark.parametrize("prism", PRISMS)
def test_departure_from_the_linear_image_is_quadratic_in_contrast(smooth_field, small, microscope, prism):
    acquisition = Acquisition((prism,), (0.6, -0.9))
    delta, kappa = smooth_field(small), smooth_field(small, seed=1).abs()
    departures = []
    for contrast in (4e-3, 2e-3, 1e-3, 5e-4):
        volume = Volume(small, contrast * delta, N0, contrast * kappa)
        exact = image(volume, microscope, acquisition, WAVE)
        departures.append(float((exact - linear_image(volume, microscope, acquisition, WAVE)).norm()))
    orders = torch.tensor(departures[:-1]).log2() - torch.tensor(departures[1:]).log2()
    assert float((orders - 2).abs().max()) < 0.05, orders


def test_linear_image_is_background_and_transferred_slices(small, smooth_field):
    microscope, acquisition = microscopes()["some light misses the pupil"], Acquisition(PRISMS, (0.6, -0.9))
    volume = Volume(small, 1e-3 * smooth_field(small), N0)
    T = transfer_functions(small, microscope, acquisition, volume.background, WAVE)
    empty = image(Volume(small, torch.zeros_like(volume.delta), N0), microscope, acquisition, WAVE)
    expected = empty + applied(T, volume.delta).real
    assert torch.allclose(linear_image(volume, microscope, acquisition, WAVE), expected, rtol=0, atol=1e-14)


def test_linear_image_pads_as_the_image_does(small, smooth_field, microscope, acquisition):
    volume, fidelity = Volume(small, 1e-6 * smooth_field(small), N0), replace(WAVE, padding=3)
    found, expected = (f(volume, microscope, acquisition, fidelity) for f in (linear_image, image))
    assert found.shape == expected.shape
    # what remains is second order in k0·Σdz·Δn = 3e-5
    assert float((found - expected).abs().max()) < 1e-8
    unpadded = linear_image(volume, microscope, acquisition, WAVE)
    assert float((found - unpadded).abs().max()) > 1e-7


def test_batches_of_sources_change_nothing(small, smooth_field, microscope, acquisition):
    volume = Volume(small, 1e-2 * smooth_field(small), N0)
    whole = linear_image(volume, microscope, acquisition, WAVE)
    batched = linear_image(volume, microscope, acquisition, replace(WAVE, memory=1))
    assert torch.allclose(whole, batched, rtol=0, atol=1e-14)


def test_dic_without_bias_has_no_linear_response(small, microscope):
    T = transfer_function(small, microscope, Prism((0.1, 0.2), 0.0), N0, WAVE)
    assert float(T.abs().max()) == 0


def test_bright_field_shows_no_phase_in_focus_but_absorption(microscope):
    grid = Grid((1, 11, 14), (0.01, 0.2, 0.21))
    coherent = replace(microscope, condenser=None)
    phase, absorption = (
        transfer_function(grid, coherent, None, N0, dtype=torch.float64, absorption=kind) for kind in (False, True)
    )
    assert float(phase.abs().max()) < 1e-15
    # axial light: −2·k0·κ·dz times the obliquity n0/p_z, within the pupil
    assert float(absorption[0, 0, 0].real) == pytest.approx(-2 * 2 * math.pi / 0.546 * 0.01, rel=1e-12)


def test_transfer_depends_on_the_distance_from_focus_alone(microscope):
    grid, prism = Grid((5, 9, 12), (0.4, 0.2, 0.21)), PRISMS[0]
    T = [transfer_function(grid, microscope, prism, N0, WAVE, focus=z, dtype=torch.float64) for z in (0.3, 0.7)]
    assert torch.allclose(T[1][1:], T[0][:-1], rtol=0, atol=1e-13 * float(T[0].abs().max()))


@pytest.mark.parametrize("source", [(0.0, 0.0), (0.25, -0.15)])
def test_transfer_of_one_source_lies_on_its_ewald_sphere(source):
    # Along depth each transverse frequency of M is a single axial one, (p_z − p_z0)/λ.
    dz, wavelength, n = 0.5, 0.546, 64
    grid = Grid((n, 9, 12), (dz, 0.3, 0.31))
    p0 = torch.tensor(source, dtype=torch.float64)
    microscope = Microscope(wavelength, Objective(0.9), Condenser(0.5, p0[None]))
    T = transfer_function(grid, microscope, None, N0, dtype=torch.float64)
    iy, ix = 2, 11
    p = wavelength * grid.frequencies(dtype=torch.float64)[:, iy, ix]
    squared = (p0 + p).square().sum(), (p0 - p).square().sum()
    caps = [((N0**2 - s).sqrt() - (N0**2 - p0 @ p0).sqrt()) / wavelength for s in squared]
    # T's two terms: M(f), and conj(M(−f)), whose axial frequency has the other sign; z enters as z_f − z
    z = grid.coordinates(0, dtype=torch.float64)
    waves = [torch.exp(-2j * math.pi * f * z) for f in (caps[0], -caps[1])]
    basis = torch.stack(waves, 1)
    line = T[:, iy, ix]
    amplitudes = torch.linalg.lstsq(basis, line[:, None]).solution
    assert float((basis @ amplitudes - line[:, None]).abs().max()) < 1e-12 * float(line.abs().max())
    k0 = 2 * math.pi / wavelength
    sizes = [k0 * dz * N0 / (N0**2 - float(s)) ** 0.5 for s in squared]
    assert amplitudes[:, 0].abs().tolist() == pytest.approx(sizes, rel=1e-10)


def test_two_beams_prefer_the_rising_phase():
    grid = Grid((1, 16, 20), (1.0, 0.3, 0.3))
    x = grid.coordinates(2, dtype=torch.float64)
    phase = 0.1 * torch.sin(2 * math.pi * x / 6.0).expand(16, 20)
    seen = two_beam_image(phase, grid, Prism((0.0, 0.25), math.pi / 2))
    slope = 0.1 * 2 * math.pi / 6.0 * torch.cos(2 * math.pi * x / 6.0)
    # sin²(π/4 + ½sφ') = ½ + ½sin(sφ'), and the finite shear takes (πs/6)²/6 off a gradient
    assert torch.allclose(seen[3] - 0.5, 0.5 * torch.sin(0.25 * slope), rtol=0, atol=5e-5)


# Half the shear is whole pixels. Pixels of 0.4 µm hold no wave that is evanescent: √2/(2·0.4) < N0/0.546.
WHOLE_PIXELS = [
    Prism((0.0, 0.8), 1.1),
    Prism((1.6, -0.8), -0.7),
    Prism((0.8, 0.0), 0.0),
    Prism((0.0, 0.0), math.pi / 2),
]


@pytest.mark.parametrize("prism", WHOLE_PIXELS)
@pytest.mark.parametrize("shape", [(12, 16), (11, 14)])
def test_galbraith_s_thin_object_is_the_image_of_axial_light_without_pupil(prism, shape):
    grid = Grid((1, *shape), (0.5, 0.4, 0.4))
    phase = 6 * torch.rand(shape, dtype=torch.float64)  # rough and strong: nothing is small here
    transmission = torch.polar(torch.ones_like(phase), phase)
    volume = Volume(grid, phase[None] / (2 * math.pi / 0.546 * 0.5), N0)  # the same object as a slice of index
    microscope, acquisition = Microscope(0.546), Acquisition((prism,), (0.0,))
    expected = two_beam_image(phase, grid, prism)
    for found in (
        image_field(transmission, grid, microscope, acquisition, background=N0),
        image(volume, microscope, acquisition, Fidelity("projection")),
    ):
        assert float((found[0, 0] - expected).abs().max()) < 1e-13


def test_galbraith_s_shear_of_any_size_is_reached_by_fourier_interpolation():
    grid, prism = Grid((1, 32, 36), (1.0, 0.4, 0.4)), Prism((0.13, -0.24), 0.9)
    y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    phase = 0.4 * (2 * math.pi * (y[:, None] / 12.8 - x / 7.2)).cos()
    transmission = torch.polar(torch.ones_like(phase), phase)
    microscope, acquisition = Microscope(0.546), Acquisition((prism,), (0.0,))
    found = image_field(transmission, grid, microscope, acquisition, background=N0)[0, 0]
    # smooth enough that e^{iφ} is band-limited to rounding: the ninth harmonic is (0.2)⁹/9! = 1e-12
    assert float((found - two_beam_image(phase, grid, prism)).abs().max()) < 1e-11


def test_linear_transfer_of_a_thin_object_is_galbraith_s_to_first_order():
    grid, prism = Grid((1, 12, 16), (0.5, 0.4, 0.4)), Prism((0.8, -0.8), 1.1)
    microscope = Microscope(0.546)
    phase = 1e-6 * torch.rand(12, 16, dtype=torch.float64)
    # the slice's depth is the focus; oblique scattering carries n0/p_z more than a thin phase object knows
    T = transfer_function(grid, microscope, prism, N0, dtype=torch.float64)[0]
    pz = (N0**2 - 0.546**2 * grid.frequencies(dtype=torch.float64).square().sum(0)).sqrt()
    delta = phase / (2 * math.pi / 0.546 * 0.5)
    change = torch.fft.ifft2(T * pz / N0 * torch.fft.fft2(delta)).real
    expected = two_beam_image(phase, grid, prism) - math.sin(0.55) ** 2
    assert float((change - expected).abs().max()) < 2e-6 * float(expected.abs().max())


def test_transfer_function_carries_gradients(small):
    bias, focus = torch.tensor(0.8, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    aberration, n0 = torch.tensor(0.2, dtype=torch.float64), torch.tensor(N0, dtype=torch.float64)

    def strength(bias, focus, aberration, n0):
        microscope = Microscope(0.546, Objective(0.75, {6: aberration}), Condenser(0.4))
        T = transfer_function(small, microscope, Prism((0.1, 0.2), bias), n0, Fidelity(sources=3), focus=focus)
        return T.real, T.imag

    values = tuple(v.requires_grad_() for v in (bias, focus, aberration, n0))
    # along a random direction of what it gives, for each number
    assert torch.autograd.gradcheck(strength, values, fast_mode=True)


def test_dtype_follows_the_background(small, microscope):
    prism = PRISMS[0]
    assert transfer_function(small, microscope, prism, N0).dtype == torch.complex64
    double = torch.tensor(N0, dtype=torch.float64)
    exact = transfer_function(small, microscope, prism, double)
    assert exact.dtype == torch.complex128
    single = transfer_function(small, microscope, prism, double, dtype=torch.float32)
    assert single.dtype == torch.complex64
    assert float((single - exact).abs().max()) < 1e-5 * float(exact.abs().max())


def test_bad_values_are_refused(small, microscope):
    with pytest.raises(ValueError, match=r"phase has shape \(3, 4\), the grid asks for \(11, 14\)"):
        two_beam_image(torch.zeros(3, 4), small, PRISMS[0])
    with pytest.raises(ValueError, match=r"objective NA 1.9 must be at most 1.8"):
        transfer_function(small, Microscope(0.546, Objective(1.9)), None, N0)
    with pytest.raises(ValueError, match="at least one prism"):
        transfer_functions(small, microscope, Acquisition(()), N0)
