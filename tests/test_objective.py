"""The pupil: an aperture whose edge counts as inside, and Zernike aberrations by Noll's index."""

import math

import numpy as np
import pytest
import torch

from torchdic import Acquisition, Grid, Microscope, Objective, Volume, image
from torchdic.objective import zernike

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
