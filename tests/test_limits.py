"""Partial coherence after Cogswell and Sheppard: the sum over sources is their bilinear transfer, with its two limits.

C. J. Cogswell and C. J. R. Sheppard, J. Microsc. 165, 81 (1992): a thin object of spectrum T has the image
    I(x) = Σ_{f1, f2} C(f1, f2)·T(f1)·conj(T(f2))·exp(2πi(f1 − f2)·x),
    C(f1, f2) = Σ_s w_s·D(f1)·conj(D(f2))·P(f1 + f_s)·conj(P(f2 + f_s)),
C the transmission cross-coefficient with the prism. Written out here in numpy, a pair of frequencies at a time, with
its own pupil, defocus, aberration and prism: nothing of the model takes part.
"""

import numpy as np
import pytest
import torch

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, image, image_field
from torchdic.linear import transfer_function
from torchdic.specimen.volume import Volume

N0, WAVELENGTH = 1.5, 0.546
PRISMS = (Prism((0.05, 0.21), 1.1), None, Prism((0.17, -0.04), -0.7))


def lattice(grid):
    """The frequencies (y x, 2) in 1/µm and pixel centres (y x, 2) in µm of a grid."""
    fy, fx = (np.fft.fftfreq(grid.shape[a], grid.spacing[a]) for a in (1, 2))
    y, x = ((np.arange(grid.shape[a]) - (grid.shape[a] - 1) / 2) * grid.spacing[a] for a in (1, 2))
    return tuple(np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2) for axes in ((fy, fx), (y, x)))


def pupil(momentum, na, focus, astigmatism=0.0):
    """Aperture, exact defocus and Noll's sixth aberration (√6·ρ²·cos2θ, θ from +x) at momenta (…, 2)."""
    squared = (momentum**2).sum(-1)
    y, x = momentum[..., 0] / na, momentum[..., 1] / na
    pz = np.sqrt(np.maximum(N0**2 - squared, 0))
    phase = 2 * np.pi / WAVELENGTH * focus * pz + astigmatism * np.sqrt(6) * (x**2 - y**2)
    return (squared <= na**2 * (1 + 1e-12)) * np.exp(1j * phase)


def beams(frequencies, prism):
    """D(f): the two beams' difference, or 1 without a prism."""
    if prism is None:
        return np.ones(len(frequencies))
    return 1j * np.sin(np.pi * frequencies @ np.array(prism.shear) + prism.bias / 2)


def cross_coefficient(frequencies, points, weights, na, focus, prism, astigmatism=0.0):
    """C(f1, f2), an array (f1, f2)."""
    D = beams(frequencies, prism)
    C = np.zeros((len(frequencies),) * 2, dtype=complex)
    for point, weight in zip(points, weights / weights.sum(), strict=True):
        seen = D * pupil(WAVELENGTH * frequencies + point, na, focus, astigmatism)
        C += weight * np.outer(seen, seen.conj())
    return C


def bilinear_image(C, transmission, frequencies, pixels, first):
    """I(x) of the module's docstring, summed over every pair of frequencies; `first` is the first pixel's centre."""
    T = np.fft.fft2(transmission, norm="forward").ravel()
    pairs = C * np.outer(T, T.conj())
    return np.array(
        [(pairs * np.outer(wave, wave.conj())).sum() for wave in np.exp(2j * np.pi * (pixels - first) @ frequencies.T)]
    )


def rough_transmission(shape):
    """A strong thin object: phases over two cycles, a third of the light absorbed."""
    rng = np.random.default_rng(3)
    return rng.uniform(0.5, 1, shape) * np.exp(1j * rng.uniform(-6, 6, shape))


@pytest.mark.parametrize("shape", [(7, 9), (8, 10), (6, 11)])
def test_sum_over_sources_is_the_bilinear_transmission_cross_coefficient(shape):
    na, foci, astigmatism = 0.75, (0.0, 0.8), 0.3
    grid = Grid((1, *shape), (1.0, 0.2, 0.23))
    rng = np.random.default_rng(5)
    points, weights = 0.4 * rng.uniform(-1, 1, (5, 2)), rng.uniform(0.5, 1, 5)
    points[0] = (0.9, 0.0)  # a direction that misses the pupil: dark field
    transmission = rough_transmission(shape)
    microscope = Microscope(
        WAVELENGTH,
        Objective(na, {6: astigmatism}),
        Condenser(0.4, torch.from_numpy(points), torch.from_numpy(weights)),
    )
    found = image_field(torch.from_numpy(transmission), grid, microscope, Acquisition(PRISMS, foci), background=N0)
    frequencies, pixels = lattice(grid)
    for i, prism in enumerate(PRISMS):
        for j, focus in enumerate(foci):
            C = cross_coefficient(frequencies, points, weights, na, focus, prism, astigmatism)
            expected = bilinear_image(C, transmission, frequencies, pixels, pixels[0])
            assert np.abs(expected.imag).max() < 1e-13
            assert np.abs(found[i, j].numpy().ravel() - expected.real).max() < 1e-12


def test_cross_coefficient_is_hermitian_and_has_a_rank_for_each_source():
    grid, rng = Grid((1, 7, 8), (1.0, 0.2, 0.23)), np.random.default_rng(5)
    frequencies, _ = lattice(grid)
    for count in (1, 3):
        C = cross_coefficient(frequencies, 0.4 * rng.uniform(-1, 1, (count, 2)), np.ones(count), 0.75, 0.8, PRISMS[0])
        assert np.allclose(C, C.conj().T, rtol=0, atol=1e-15)
        assert np.linalg.matrix_rank(C) == count
        assert np.linalg.eigvalsh(C).min() > -1e-14


def test_axial_light_images_coherently():
    """One source: the intensity of the object's field convolved with an amplitude, interference included."""
    na, focus, grid = 0.75, 0.8, Grid((1, 12, 15), (1.0, 0.2, 0.23))
    transmission, (frequencies, _) = rough_transmission((12, 15)), lattice(grid)
    microscope = Microscope(WAVELENGTH, Objective(na))
    field = torch.from_numpy(transmission)
    found = image_field(field, grid, microscope, Acquisition(PRISMS, (focus,)), background=N0)[:, 0]
    for prism, seen in zip(PRISMS, found, strict=True):
        amplitude = (beams(frequencies, prism) * pupil(WAVELENGTH * frequencies, na, focus)).reshape(12, 15)
        # linear in amplitude: a circular convolution with its point response, pixel by pixel
        response = np.fft.ifft2(amplitude)
        expected = np.zeros((12, 15), dtype=complex)
        for y, x in np.ndindex(12, 15):
            expected += transmission[y, x] * np.roll(response, (y, x), (0, 1))
        assert np.abs(seen.numpy() - np.abs(expected) ** 2).max() < 1e-12


def test_small_condenser_approaches_coherent_images_at_second_order():
    grid, prism = Grid((1, 24, 27), (1.0, 0.3, 0.32)), PRISMS[0]
    field = torch.from_numpy(rough_transmission((24, 27)))

    def seen(na):
        # without an edge, of a pupil or of what propagates: a source that crosses one changes the image at first order
        microscope = Microscope(WAVELENGTH, None, Condenser(na))
        return image_field(field, grid, microscope, Acquisition((prism,), (1.5,)), background=N0)

    errors = [float((seen(na) - seen(0.0)).norm()) for na in (0.04, 0.02, 0.01)]
    orders = np.log2(errors[:-1]) - np.log2(errors[1:])
    assert np.abs(orders - 2).max() < 0.1, orders


@pytest.mark.parametrize("focus", [0.0, 1.2])
@pytest.mark.filterwarnings("ignore::torchdic.SamplingWarning")
def test_wide_condenser_images_incoherently(focus):
    """Where the condenser fills every place that the object's light can come from, intensities add:

    the image is |beam 1 − beam 2|² at the object, convolved with the objective's intensity point response. The two
    beams of one point interfere still, which no narrower condenser improves on.
    """
    na, size, d = 0.3, 30, 0.4
    grid, (frequencies, _) = Grid((1, size, size), (1.0, d, d)), lattice(Grid((1, size, size), (1.0, d, d)))
    # an object of frequencies within 0.25/λ, and sources on the array's own lattice as far as they matter
    band = (WAVELENGTH * np.hypot(*frequencies.T) <= 0.25).reshape(size, size)
    transmission = np.fft.ifft2(np.fft.fft2(rough_transmission((size, size))) * band)
    points = WAVELENGTH * frequencies[WAVELENGTH * np.hypot(*frequencies.T) <= na + 0.25 + 1e-9]
    microscope = Microscope(WAVELENGTH, Objective(na), Condenser(0.3, torch.from_numpy(points)))
    field = torch.from_numpy(transmission)
    found = image_field(field, grid, microscope, Acquisition(PRISMS, (focus,)), background=N0)[:, 0]
    response = np.abs(np.fft.ifft2(pupil(WAVELENGTH * frequencies, na, focus).reshape(size, size))) ** 2
    for prism, seen in zip(PRISMS, found, strict=True):
        D = beams(frequencies, prism).reshape(size, size)
        glow = np.abs(np.fft.ifft2(D * np.fft.fft2(transmission))) ** 2
        expected = np.fft.ifft2(np.fft.fft2(glow) * np.fft.fft2(response)).real
        expected *= size**2 / len(points)  # Parseval: the response's sum is the pupil's share of the array
        assert np.abs(seen.numpy() - expected).max() < 1e-12 * expected.max()


def test_weak_limit_of_the_cross_coefficient_is_the_linear_transfer_function():
    """C(f, 0) and C(0, −f) alone carry a weak thin object; a slice's has the obliquity n0/p_z besides."""
    na, focus = 0.75, 0.8
    grid, thickness = Grid((1, 9, 12), (0.5, 0.2, 0.23)), 0.5
    frequencies, _ = lattice(grid)
    points, weights = np.array([[0.0, 0.3], [0.25, -0.1], [-0.2, -0.2]]), np.array([1.0, 2.0, 1.5])
    microscope = Microscope(
        WAVELENGTH, Objective(na), Condenser(0.4, torch.from_numpy(points), torch.from_numpy(weights))
    )
    k0 = 2 * np.pi / WAVELENGTH
    for prism in PRISMS:
        D = beams(frequencies, prism)
        M = np.zeros(len(frequencies), dtype=complex)
        for point, weight in zip(points, weights / weights.sum(), strict=True):
            waves = WAVELENGTH * frequencies + point
            pz = np.sqrt(np.maximum(N0**2 - (waves**2).sum(-1), 0.01))
            C = D * pupil(waves, na, focus) * np.conj(D[0] * pupil(point, na, focus))
            M += weight * C * 1j * k0 * thickness * N0 / pz
        M = M.reshape(9, 12)
        mirrored = np.roll(M[::-1, ::-1], (1, 1), (0, 1))
        found = transfer_function(grid, microscope, prism, N0, focus=focus, dtype=torch.float64)[0].numpy()
        assert np.abs(found - M - mirrored.conj()).max() < 1e-12 * np.abs(found).max()


def test_thin_slice_s_image_is_that_of_its_transmission_as_it_gets_thinner():
    """A slice of index and its thin transmission differ by the light's obliquity: at second order in the angles."""
    prism, errors = Prism((0.0, 0.3), 1.1), []
    for period in (4.0, 8.0, 16.0):
        grid = Grid((1, 4, 40), (0.1, period / 40, period / 40))
        x = grid.coordinates(2, dtype=torch.float64)
        phase = 0.01 * torch.cos(2 * torch.pi * x / period).expand(4, 40)
        volume = Volume(grid, phase[None] / (2 * torch.pi / WAVELENGTH * 0.1), N0)
        acquisition = Acquisition((prism,), (0.0,))
        slice_ = image(volume, Microscope(WAVELENGTH), acquisition, Fidelity("wave"))
        thin = image_field(
            torch.polar(torch.ones_like(phase), phase), grid, Microscope(WAVELENGTH), acquisition, background=N0
        )
        contrast = float((thin - thin.mean()).norm())
        errors.append(float((slice_ - thin).norm()) / contrast)
    orders = -np.diff(np.log2(errors))
    assert np.abs(orders - 2).max() < 0.1, (errors, orders)
