"""A pupil of Jones matrices: strain, losses and a high aperture's turn, alone and in images."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import spherical_jn, spherical_yn

from data_synthetic.ball import GaussianBall
from recon.config.conversion import dump
from recon.config.reading import load
from recon.config.schema import ConfigError
from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Volume,
    image,
    image_field,
)
from torchdic.instrument import jones
from torchdic.instrument.polarised_lenses import diattenuating, product, retarding, turn
from torchdic.linear import linear_image

F64 = torch.float64
GRID = Grid((1, 12, 15), (1.0, 0.2, 0.21))
PRISM = Prism((0.13, 0.27), 0.8)
N0 = 1.36
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.17, 0.24]], dtype=F64)
SCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4, POINTS))
ERRORS = {
    "polariser_extinction": 0.03,
    "analyser_extinction": 0.02,
    "analyser_error": -0.07,
    "retardance_error": 0.11,
}
# nothing alike in any two terms, so that a swapped axis or sign shows
STRAIN = {1: (0.3, -0.2), 2: (0.11, 0.07), 3: (-0.05, 0.13), 5: (0.02, 0.15), 6: (0.17, -0.09)}
LOSSES = {1: (-0.06, 0.1), 2: (0.04, -0.07), 3: (0.08, 0.03), 5: (0.05, 0.12), 6: (0.11, 0.02)}
TRIVIAL = JonesPupil(retardance={1: (0.0, 0.0)})


def close(found, expected, atol=1e-14):
    expected = torch.as_tensor(expected, dtype=found.dtype)
    torch.testing.assert_close(found, expected.expand_as(found), rtol=0, atol=atol)


def transmission(kind=F64):
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=F64) for a in (1, 2)), indexing="ij")
    phase = 0.7 * torch.exp(-((y - 0.2) ** 2) / 0.3 - (x + 0.3) ** 2 / 0.2) + 0.2 * torch.sin(2 * y + x)
    return torch.polar(1 - 0.2 * torch.exp(-((x - 0.5) ** 2) - y**2), phase).to(kind.to_complex())


def seen(polarisation=None, prisms=(PRISM,), field=None, scope=SCOPE):
    field = transmission() if field is None else field
    scope = replace(scope, polarisation=polarisation)
    return image_field(field, GRID, scope, Acquisition(prisms, [0.4, -0.3]), background=N0)


def disc(count=21):
    """Points of a pupil of radius 1 as (1, 2, y, x), with ρ and θ of each."""
    axis = torch.linspace(-0.7, 0.7, count, dtype=F64)
    y, x = torch.meshgrid(axis, axis + 0.01, indexing="ij")
    return torch.stack((y, x))[None], torch.hypot(x, y), torch.atan2(y, x)


def matrices(field):
    """(source, 2, 2, y, x) as (source, y, x, 2, 2)."""
    return field.movedim((1, 2), (3, 4))


# --- the lenses' matrices ------------------------------------------------------------------------------------------


def test_retardance_is_a_retarder_at_half_the_angle_of_its_vector():
    gamma = torch.randn(2, 3, 4, 5, dtype=F64) * 2
    found = matrices(retarding(gamma))
    close(found, jones.retarder(gamma.norm(dim=0), torch.atan2(gamma[1], gamma[0]) / 2))
    close(found @ found.mH, torch.eye(2))


def test_diattenuation_passes_one_plus_and_minus_its_tangent():
    d = torch.randn(2, 3, 4, 5, dtype=F64)
    found, size, angle = matrices(diattenuating(d)), d.norm(dim=0), torch.atan2(d[1], d[0]) / 2
    for turned, sign in ((0.0, 1), (math.pi / 2, -1)):
        passed = jones.intensity(jones.apply(found, jones.linear(angle + turned)))
        close(passed, 1 + sign * size.tanh())
    pauli = torch.tensor([[[1, 0], [0, -1]], [[0, 1], [1, 0]]], dtype=F64)
    exponent = torch.einsum("ksyx,kab->syxab", d, pauli) / 2
    close(found, torch.linalg.matrix_exp(exponent) / size.cosh().sqrt()[..., None, None], 1e-13)


@pytest.mark.parametrize("function", [retarding, diattenuating])
def test_matrices_are_smooth_where_nothing_is_there(function):
    """At exactly 0 value and gradient are 1 and half the Pauli matrices; autograd is the central difference."""
    zero = torch.zeros(2, 1, 1, 1, dtype=F64)
    assert torch.equal(matrices(function(zero))[0, 0, 0], torch.eye(2).to(function(zero)))
    slope = torch.autograd.functional.jacobian(lambda v: torch.view_as_real(function(v) + 0j), zero)
    slope = torch.view_as_complex(slope[:, :, :, 0, 0, :, :, 0, 0, 0].movedim(3, -1).contiguous())[0]
    unit = 0.5j if function is retarding else 0.5
    expected = unit * torch.tensor([[[1, 0], [0, -1]], [[0, 1], [1, 0]]], dtype=torch.complex128)
    close(slope.movedim(-1, 0), expected, 0)
    for size in (0.0, 1e-9, 1e-3, 1.0):
        at = (size * torch.randn(2, 1, 2, 2, dtype=F64)).requires_grad_()
        assert torch.autograd.gradcheck(function, at, eps=1e-5, atol=1e-8)


def test_a_lens_strained_about_its_axis_is_slow_along_the_radius():
    pupil, rho, theta = disc()
    found = JonesPupil(retardance={6: (0.4, 0.0), 5: (0.0, 0.4)}).lenses(pupil)
    close(matrices(found)[0], jones.retarder(0.4 * math.sqrt(6) * rho**2, theta))


@pytest.mark.parametrize("angle", [0.0, 0.3])
def test_strained_lens_shows_a_maltese_cross_between_crossed_polarisers(angle):
    """Dark along the polarisers' axes, sin²(Γ/2) at 45° to them."""
    pupil, rho, theta = disc()
    found = JonesPupil(retardance={6: (0.4, 0.0), 5: (0.0, 0.4)}).lenses(pupil)
    behind = jones.train(jones.polariser(angle), matrices(found)[0], jones.polariser(angle + math.pi / 2))
    leak = jones.intensity(jones.apply(behind, jones.linear(angle)))
    gamma = 0.4 * math.sqrt(6) * rho**2
    close(leak, (torch.sin(gamma / 2) * torch.sin(2 * (theta - angle))).square())
    assert float(leak.max()) > 0.05


def test_light_meets_the_losses_before_the_strain():
    pupil = disc()[0]
    both = JonesPupil(STRAIN, LOSSES).lenses(pupil)
    strain, losses = JonesPupil(STRAIN).lenses(pupil), JonesPupil(diattenuation=LOSSES).lenses(pupil)
    close(matrices(both), jones.train(matrices(losses), matrices(strain)))
    assert not torch.allclose(both, product(losses, strain), atol=1e-3)
    # of unpolarised light all passes on the mean, whatever the strain
    close(matrices(both).abs().square().sum((-2, -1)) / 2, 1.0)


# --- the high aperture's turn --------------------------------------------------------------------------------------


def frame(direction):
    """M (3, 2) by the s and p parts: s is kept, p tilted with the wave; direction k (3,) of (x, y, z)."""
    x, y, z = direction
    sine = np.hypot(x, y)
    radial, s = np.array([x, y]) / sine, np.array([-y, x]) / sine
    p = np.array([z * radial[0], z * radial[1], -sine])
    return np.outer(p, radial) + np.outer([*s, 0.0], s)


def direction(theta, phi):
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def turned(k, k0, n=N0):
    """`turn` of single waves whose directions k are (x, y, z)."""
    p, p0 = (torch.tensor([v[1], v[0]], dtype=F64) * n for v in (k, k0))
    return turn(p[None, :, None, None], p0[None], torch.tensor(n, dtype=F64))[0, :, :, 0, 0]


DIRECTIONS = [
    (direction(0.4, 0.3), direction(0.7, 2.0)),
    (direction(1.1, -2.5), direction(0.9, 2.5)),
    (direction(0.8, 0.2), direction(0.6, 0.2 + math.pi / 2)),
    (direction(0.8, 0.2 + math.pi / 2), direction(1e-9, 0.2)),
    (direction(0.5, 1.0), direction(0.5, 1.0 + math.pi)),
]


@pytest.mark.parametrize(("k", "k0"), DIRECTIONS)
def test_lenses_keep_s_and_tilt_p(k, k0):
    close(turned(k, k0), torch.from_numpy(frame(k).T @ frame(k0)), 1e-15 * 10)
    cosine = float(k @ k0)
    found = turned(k, k0)
    # a dipole's radiation: unpolarised light is scattered as Rayleigh's
    assert float(found.square().sum() / 2) == pytest.approx((1 + cosine**2) / 2, abs=1e-14)
    assert float(torch.det(found)) == pytest.approx(cosine, abs=1e-14)


def test_turn_is_the_identity_for_the_direct_wave_and_cosine_for_p_of_axial_light():
    axis = direction(0.0, 0.0)
    for k, _ in DIRECTIONS:
        close(turned(k, k), torch.eye(2))
    assert torch.equal(turned(axis, axis), torch.eye(2, dtype=F64))
    k = direction(0.9, 0.0)
    close(turned(k, axis), torch.diag(torch.tensor([math.cos(0.9), 1.0], dtype=F64)))


def test_turn_is_of_second_order_in_small_angles():
    def size(angle):
        return float((turned(direction(angle, 0.3), direction(0.7 * angle, 1.9)) - torch.eye(2)).abs().max())

    assert size(0.02) / size(0.01) == pytest.approx(4, rel=1e-3)  # the next order is angle² smaller
    assert 0 < size(0.01) < 1e-4


def test_turn_about_an_oblique_wave_is_rytovs():
    """To first order in p − p0 the matrix is a rotation by (p0 × δp)_z/(n(n + p_z)), +x towards +y."""
    k0, n = direction(0.8, 0.4), N0
    for step in (1e-3, 5e-4):
        k = k0 + step * np.array([0.3, -0.8, 0.0])
        k = np.array([k[0], k[1], math.sqrt(1 - k[0] ** 2 - k[1] ** 2)])
        angle = (k0[0] * k[1] - k0[1] * k[0]) / (1 + k0[2])
        error = turned(k, k0, n) - jones.rotation(angle)
        assert float(error.abs().max()) < 2 * step**2
    assert abs(angle) > 1e-4


def test_turn_is_smooth_on_the_axis():
    n = torch.tensor(N0, dtype=F64, requires_grad=True)
    momentum = torch.zeros(1, 2, 1, 1, dtype=F64, requires_grad=True)
    direct = torch.tensor([[0.3, -0.5]], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(turn, (momentum, direct, n))


def mie(size, relative, cosine):
    """S1 and S2 of a sphere of size parameter `size` and relative index, at scattering angles; Bohren & Huffman 4.4."""
    orders = np.arange(1, int(size + 4 * size ** (1 / 3) + 12))

    def riccati(z):
        j, dj = spherical_jn(orders, z), spherical_jn(orders, z, derivative=True)
        return z * j, j + z * dj

    psi, dpsi = riccati(size)
    inner, dinner = riccati(relative * size)
    y, dy = spherical_yn(orders, size), spherical_yn(orders, size, derivative=True)
    xi, dxi = psi + 1j * size * y, dpsi + 1j * (y + size * dy)
    a = (relative * inner * dpsi - psi * dinner) / (relative * inner * dxi - xi * dinner)
    b = (inner * dpsi - relative * psi * dinner) / (inner * dxi - relative * xi * dinner)
    pi, tau, before = [1.0], [cosine], 0.0
    for n in orders[1:]:
        now = ((2 * n - 1) * cosine * pi[-1] - n * before) / (n - 1)
        before = pi[-1]
        pi.append(now)
        tau.append(n * cosine * now - (n + 1) * before)
    pi, tau = np.array(pi), np.array(tau)
    factor = (2 * orders + 1) / (orders * (orders + 1))
    return (factor * (a * pi + b * tau)).sum(), (factor * (a * tau + b * pi)).sum()


@pytest.mark.parametrize(("k", "k0"), DIRECTIONS)
def test_scattering_of_a_weak_sphere_is_mies_as_contrast_vanishes(k, k0):
    """The 2×2 amplitude between the pupils is S1·MᵀM0, S2 = cosγ·S1, up to the order of Δn."""
    across = np.cross(k0, k)
    across = across / np.linalg.norm(across)
    errors = []
    for contrast in (1e-3, 1e-4):
        s1, s2 = mie(3.0, 1 + contrast, float(k @ k0))
        amplitude = s1 * np.outer(across, across) + s2 * np.outer(np.cross(across, k), np.cross(across, k0))
        pupils = frame(k).T @ amplitude @ frame(k0)
        errors.append(np.abs(pupils / s1 - turned(k, k0).numpy()).max())
    assert errors[1] < 1e-3  # 1e-4 times a factor of the sphere's size
    assert errors[0] / errors[1] == pytest.approx(10, rel=0.05)


# --- what does nothing shows nothing -------------------------------------------------------------------------------


@pytest.mark.parametrize("condenser_prism", [True, False])
@pytest.mark.parametrize("declared", ["ideal", *ERRORS, "all"])
@pytest.mark.parametrize("axis", [None, 0.7])
def test_unit_pupil_is_no_pupil(declared, condenser_prism, axis):
    """To rounding, for every other imperfection, and whichever way the prism's polarisation lies."""
    errors = {"ideal": {}, "all": ERRORS}.get(declared) or {k: v for k, v in ERRORS.items() if k == declared}
    prisms = (replace(PRISM, axis=axis), None, Prism((0.0, 0.0), 0.4, axis), Prism((-0.2, 0.1), -0.7, axis))
    scope = replace(SCOPE, condenser_prism=condenser_prism)
    found = seen(Polarisation(**errors, pupil=TRIVIAL), prisms, scope=scope)
    close(found, seen(Polarisation(**errors), prisms, scope=scope), 1e-14)


def test_empty_pupil_is_none(monkeypatch):
    monkeypatch.setattr(Polarisation, "pure_states", None)
    for pupil in (None, JonesPupil(), JonesPupil({}, {}, False)):
        assert torch.equal(seen(Polarisation(pupil=pupil)), seen())
        assert torch.equal(seen(Polarisation(**ERRORS, pupil=pupil)), seen(Polarisation(**ERRORS)))


@pytest.mark.parametrize(
    ("polarisation", "polarisers", "lenses", "turns"),
    [
        (None, False, False, False),
        (Polarisation(), False, False, False),
        (Polarisation(pupil=JonesPupil({}, None, False)), False, False, False),
        (Polarisation(analyser_error=0.0), True, False, False),
        (Polarisation(0.0, pupil=JonesPupil()), True, False, False),
        (Polarisation(pupil=JonesPupil(STRAIN)), False, True, False),
        (Polarisation(pupil=JonesPupil(depolarisation=True)), False, True, True),
        (Polarisation(retardance_error=0.1, pupil=JonesPupil(STRAIN, LOSSES, True)), True, True, True),
    ],
)
def test_microscope_names_what_acts_on_polarisation_and_none_where_nothing_does(
    polarisation, polarisers, lenses, turns
):
    """Zero is a value: what is declared as 0 is there."""
    scope = replace(SCOPE, polarisation=polarisation)
    assert scope.polarisers is (polarisation if polarisers else None)
    assert scope.lenses is (polarisation.pupil if lenses else None)
    assert scope.turns_polarisation is turns


def test_direct_light_is_dark_at_extinction_at_any_aperture(propagation):
    """p = p0: the lenses undo each other's turn, so an empty field of oblique light stays at sin²(bias/2)."""
    grid = Grid((3, 12, 15), (0.5, 0.12, 0.11))
    scope = Microscope(
        0.546, Objective(1.2), Condenser(1.0), polarisation=Polarisation(pupil=JonesPupil(depolarisation=True))
    )
    volume = Volume(grid, torch.zeros(grid.shape, dtype=F64), N0)
    found = image(volume, scope, Acquisition([Prism((0.1, 0.2), 0.0), PRISM, None]), Fidelity(propagation, sources=12))
    assert float(found[0].max()) < 1e-28
    close(found[1], math.sin(PRISM.bias / 2) ** 2)
    close(found[2], 1.0)


# --- known answers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("errors", [{}, ERRORS, {"retardance_error": 0.11}], ids=["ideal", "all", "compensator"])
@pytest.mark.parametrize("axis", [None, 0.9])
def test_uniform_retardance_is_a_plate_in_the_train(errors, axis):
    """The empty field by Jones's algebra; a compensator's bias lies in front of the plate, a prism's behind it."""
    gamma, slow = 0.6, 0.35
    psi = math.atan2(*PRISM.shear) if axis is None else axis
    p, r, e, delta = (errors.get(name) for name in ERRORS)
    strain = jones.retarder(gamma, slow - psi)
    if delta is None:
        elements, angle = [strain, jones.retarder(PRISM.bias, 0.0)], math.pi / 4
    else:
        elements, angle = [jones.retarder(math.pi / 2 + delta, math.pi / 4), strain], math.pi / 4 + PRISM.bias / 2
    expected = 0.0
    for turned_in, share_in in ((0.0, 1.0), (math.pi / 2, p or 0.0)):
        for turned_out, share_out in ((0.0, 1.0), (math.pi / 2, r or 0.0)):
            light = jones.apply(jones.train(*elements), jones.linear(angle + turned_in))
            analyser = jones.polariser((e or 0.0) - math.pi / 4 + turned_out)
            expected += share_in * share_out * float(jones.intensity(jones.apply(analyser, light)))
    pupil = JonesPupil({1: (gamma * math.cos(2 * slow), gamma * math.sin(2 * slow))})
    prism = replace(PRISM, axis=axis)
    # one axial source: oblique light sees the prisms' phases where the plate passes it into the other beam
    scope = replace(SCOPE, condenser=None)
    found = seen(Polarisation(**errors, pupil=pupil), [prism], torch.ones_like(transmission()), scope)
    close(found, expected)


def test_uniform_retardance_leaks_at_extinction():
    """sin²(Γ/2)·sin²2(α − 45°), angles from the prism's axis."""
    gamma, slow, psi = 0.6, 0.35, 0.2
    pupil = JonesPupil({1: (gamma * math.cos(2 * slow), gamma * math.sin(2 * slow))})
    field = torch.ones_like(transmission())
    scope = replace(SCOPE, condenser=None)
    found = seen(Polarisation(pupil=pupil), [Prism((0.1, 0.2), 0.0, psi)], field, scope)
    close(found, (math.sin(gamma / 2) * math.sin(2 * (slow - psi - math.pi / 4))) ** 2)


@pytest.mark.parametrize("axis", [None, 0.9])
def test_retardance_along_the_prisms_axis_is_bias(axis):
    """Each beam stays itself and beam 1, slow, gains phase: a whole image of partially coherent light."""
    psi = math.atan2(*PRISM.shear) if axis is None else axis
    pupil = JonesPupil({1: (0.5 * math.cos(2 * psi), 0.5 * math.sin(2 * psi))})
    found = seen(Polarisation(pupil=pupil), [replace(PRISM, axis=axis)])
    close(found, seen(prisms=[replace(PRISM, bias=PRISM.bias + 0.5)]))


@pytest.mark.parametrize("condenser_prism", [True, False])
def test_half_wave_of_strain_swaps_the_beams_between_the_prisms(condenser_prism):
    """Light that crosses from one beam into the other meets both prisms alike: the tilt counts twice, not never."""
    psi = 0.3
    pupil = JonesPupil({1: (-math.pi * math.sin(2 * psi), math.pi * math.cos(2 * psi))})
    point = torch.tensor([[0.31, -0.12]], dtype=F64)
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4, point), condenser_prism=condenser_prism)
    found = seen(Polarisation(pupil=pupil), [replace(PRISM, axis=psi)], torch.ones_like(transmission()), scope)
    tilt = math.pi * float(point[0] @ torch.tensor(PRISM.shear, dtype=F64)) / 0.546
    close(found, math.sin((2 if condenser_prism else 1) * tilt + PRISM.bias / 2) ** 2)


def test_grating_depolarises_by_the_tilt_of_p():
    """Axial light: orders at θ lose 1 − cosθ of their p part, half of which appears behind crossed polarisers.

    With the grating along x and the polariser at 45° to it, I = [½(1 − cosθ)·ε·cos(2πfx)]².
    """
    x = GRID.coordinates(2, dtype=F64)
    order, contrast = 3, 0.01
    wave = torch.cos(2 * math.pi * order * x / GRID.extent[2])
    field = (1 + contrast * wave).expand(GRID.shape[1:]).to(torch.complex128)
    scope = Microscope(0.546, Objective(1.2), polarisation=Polarisation(pupil=JonesPupil(depolarisation=True)))
    found = image_field(field, GRID, scope, Acquisition([Prism((0.0, 0.0), 0.0, 0.0)]), background=N0)[0, 0]
    cosine = math.sqrt(1 - (0.546 * order / GRID.extent[2] / N0) ** 2)
    expected = ((1 - cosine) / 2 * contrast * wave).square()
    close(found, expected.expand_as(found), 1e-17)
    assert float(expected.max()) > 1e-7


def test_light_turns_between_specimen_and_lens_before_it_meets_the_strain():
    """The grating again, through a plate: the amplitude is w†·J·(1 + ε·cos(2πfx)·T)v."""
    x = GRID.coordinates(2, dtype=F64)
    order, contrast, psi = 3, 0.1, 0.25
    wave = contrast * torch.cos(2 * math.pi * order * x / GRID.extent[2])
    field = (1 + wave).expand(GRID.shape[1:]).to(torch.complex128)
    pupil = JonesPupil({1: (0.7, 0.4)}, depolarisation=True)
    scope = Microscope(0.546, Objective(1.2), polarisation=Polarisation(pupil=pupil))
    found = image_field(field, GRID, scope, Acquisition([Prism((0.0, 0.0), 0.0, psi)]), background=N0)[0, 0]
    cosine = math.sqrt(1 - (0.546 * order / GRID.extent[2] / N0) ** 2)
    tilt = torch.diag(torch.tensor([cosine, 1.0], dtype=F64))
    specimen = torch.eye(2, dtype=F64) + wave[:, None, None] * tilt
    strain = jones.retarder(math.hypot(0.7, 0.4), math.atan2(0.4, 0.7) / 2)
    through = jones.train(specimen, strain, jones.polariser(psi - math.pi / 4))
    expected = jones.intensity(jones.apply(through, jones.linear(psi + math.pi / 4)))
    close(found, expected.expand_as(found))


# --- laws ----------------------------------------------------------------------------------------------------------

EVERYTHING = JonesPupil(STRAIN, LOSSES, depolarisation=True)


def test_strain_moves_no_energy_and_shows_in_no_empty_bright_field():
    plain, strained = (seen(Polarisation(pupil=pupil), [None]) for pupil in (None, JonesPupil(STRAIN)))
    close(strained.mean((-2, -1)), plain.mean((-2, -1)))
    assert float((strained - plain).abs().max()) > 1e-3
    close(seen(Polarisation(pupil=JonesPupil({1: (0.4, -0.7)})), [None]), plain)
    close(seen(Polarisation(pupil=JonesPupil(STRAIN, LOSSES)), [None], torch.ones_like(transmission())), 1.0)


def test_losses_pass_no_more_than_twice_the_mean_and_no_polarisation_gains():
    """Of the light polarised most favourably 1 + tanh|D| passes: relative to that mean, no lens amplifies."""
    d = 0.8
    pupil = JonesPupil(diattenuation={1: (d, 0.0)})
    # two parallel polarisers along x: axis at −45°, the analyser turned by 90°
    field = torch.ones_like(transmission())
    for psi, expected in ((-math.pi / 4, 1 + math.tanh(d)), (math.pi / 4, 1 - math.tanh(d))):
        prism = Prism((0.0, 0.0), 0.0, psi)
        found = seen(
            Polarisation(analyser_error=math.pi / 2, pupil=pupil), [prism], field, replace(SCOPE, condenser=None)
        )
        close(found, expected)


def test_all_polariser_and_analyser_states_together_are_the_bright_field():
    """Without a shear: Σ over both states of each = 2·I, whatever the pupil and the bias."""
    prism = Prism((0.0, 0.0), 0.8, 0.3)
    total = torch.zeros(1, 2, *GRID.shape[1:], dtype=F64)
    for error in (0.2, 0.2 + math.pi / 2):
        one, both = (
            seen(Polarisation(polariser_extinction=r, analyser_error=error, pupil=EVERYTHING), [prism])
            for r in (0.0, 0.5)
        )
        total = total + one + (both - one) / 0.5
    close(total / 2, seen(Polarisation(pupil=EVERYTHING), [None]))


def quarter(coefficients):
    """Pauli–Zernike coefficients of a pupil turned by 90°, +x to +y: Z(θ − 90°), and axes along x are now along y."""
    places = {1: (1, 1), 2: (3, 1), 3: (2, -1), 5: (5, -1), 6: (6, -1)}  # Noll index -> that of Z(θ − 90°), its sign
    return {places[noll][0]: tuple(-places[noll][1] * part for part in pair) for noll, pair in coefficients.items()}


def quarter_vector(yx):
    y, x = yx
    return x, -y  # (x, y) -> (−y, x), stored (y, x)


@pytest.mark.parametrize("errors", [{}, ERRORS], ids=["ideal", "all"])
@pytest.mark.parametrize("axis", [None, 0.4])
@pytest.mark.parametrize("condenser_prism", [True, False])
def test_microscope_and_specimen_turned_together_turn_the_image(errors, axis, condenser_prism):
    def rotated(a):
        return a.transpose(-2, -1).flip(-1)

    prisms = [replace(PRISM, axis=axis), None]
    turned_prisms = [Prism(quarter_vector(PRISM.shear), PRISM.bias, None if axis is None else axis + math.pi / 2), None]
    turned_points = torch.stack((POINTS[:, 1], -POINTS[:, 0]), 1)
    pupil = JonesPupil(quarter(STRAIN), quarter(LOSSES), depolarisation=True)
    scope = replace(SCOPE, condenser_prism=condenser_prism, polarisation=Polarisation(**errors, pupil=EVERYTHING))
    other = replace(scope, condenser=Condenser(0.4, turned_points), polarisation=Polarisation(**errors, pupil=pupil))
    (nz, ny, nx), (dz, dy, dx) = GRID.shape, GRID.spacing
    plain = image_field(transmission(), GRID, scope, Acquisition(prisms, [0.4]), background=N0)
    found = image_field(
        rotated(transmission()),
        Grid((nz, nx, ny), (dz, dx, dy)),
        other,
        Acquisition(turned_prisms, [0.4]),
        background=N0,
    )
    close(found, rotated(plain), 1e-14)


def test_turning_a_beam_pair_by_180_degrees_changes_nothing():
    for psi in (0.3, 0.3 + math.pi):
        found = seen(Polarisation(pupil=EVERYTHING), [replace(PRISM, axis=psi)])
        close(found, seen(Polarisation(pupil=EVERYTHING), [replace(PRISM, axis=0.3)]))


@pytest.mark.parametrize("error", [pytest.param(0.0, marks=pytest.mark.slow), 0.7, -0.7])
@pytest.mark.parametrize(("contrast", "tolerance"), [(0.002, 0.01), pytest.param(0.01, 0.03, marks=pytest.mark.slow)])
def test_rays_carry_the_polarisation_that_the_wave_scatters(contrast, tolerance, error):
    """A smooth ball in oblique light between crossed polarisers, no shear: all that is seen is the turn.

    Rays turn by Rytov's law, the wave's orders by MᵀM0. To first order in the contrast they agree but for what
    diffraction at the ball does, (λ/2πσn0)² ≈ 0.003; beyond it they differ by the deflection √(2π)·Δn/(n0·cosθ0) of
    what they turn by, 0.004 and 0.02. error: the analyser's, in units of the largest turn; it shows the turn's sign.
    """
    grid = Grid((18, 56, 58), (0.45, 0.15, 0.15))
    volume = Volume(grid, GaussianBall(1.25, contrast, N0).delta(grid), N0)
    point = torch.tensor([[0.45, 0.6]], dtype=F64)
    largest = contrast / 3
    polarisation = Polarisation(analyser_error=error * largest, pupil=JonesPupil(depolarisation=True))
    scope = Microscope(0.546, Objective(0.95), Condenser(0.75, point), polarisation=polarisation)
    acquisition = Acquisition([Prism((0.0, 0.0), 0.0, 0.2)])
    rays, wave = (
        image(volume, scope, acquisition, Fidelity(way, interpolation="cubic"))[0, 0] for way in ("rays", "wave")
    )
    seen_turn = wave - math.sin(error * largest) ** 2
    assert float(seen_turn.abs().max()) > 0.5 * largest**2
    assert float((rays - wave).abs().max()) < tolerance * float(seen_turn.abs().max())


# --- gradients, dtypes, errors and files ---------------------------------------------------------------------------

SMALL = Grid((3, 8, 9), (0.6, 0.22, 0.2))
NOLL = (1, 2, 5, 6)


def scalar(value):
    return torch.tensor(value, dtype=F64)


@pytest.fixture
def point(smooth_field):
    """A value of every parameter, none of them 0."""
    return {
        "delta": smooth_field(SMALL, 0.04) + 0.01,
        "background": scalar(1.37),
        "shear": scalar([0.07, -0.19]),
        "bias": scalar(0.8),
        "axis": scalar(0.4),
        "retardance": scalar([[0.3, -0.2], [0.11, 0.07], [-0.05, 0.13], [0.1, 0.2]]),
        "diattenuation": scalar([[-0.1, 0.2], [0.07, 0.11], [0.05, -0.13], [0.2, 0.1]]),
        "errors": scalar(list(ERRORS.values())),
    }


def compute(values, propagation, own_axis=False):
    """A weighted sum of the images, so that every pixel matters and none cancels another."""
    volume = Volume(SMALL, values["delta"], values["background"])
    strain, losses = (
        {n: tuple(pair) for n, pair in zip(NOLL, values[k], strict=True)} for k in ("retardance", "diattenuation")
    )
    errors = dict(zip(ERRORS, values["errors"], strict=True))
    polarisation = Polarisation(**errors, pupil=JonesPupil(strain, losses, depolarisation=True))
    scope = Microscope(0.546, Objective(0.8), Condenser(0.4, POINTS), polarisation=polarisation)
    prisms = [Prism(values["shear"], values["bias"], None if own_axis else values["axis"]), None]
    images = image(volume, scope, Acquisition(prisms, [-0.7, 0.4]), Fidelity(propagation))
    random = torch.Generator().manual_seed(1)
    return (images * torch.rand(images.shape, generator=random, dtype=images.dtype)).sum()


def check_gradient(function, value, step):
    """Every element against the fourth-order central difference, whose own error is step⁴, far below 1e-6."""
    value = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(value), value)
    assert bool(torch.isfinite(gradient).all())
    with torch.no_grad():
        for index in range(value.numel()):
            unit = torch.zeros_like(value).flatten()
            unit[index] = step
            up, up2, down, down2 = (float(function(value + t * unit.reshape(value.shape))) for t in (1, 2, -1, -2))
            expected = (8 * (up - down) - (up2 - down2)) / (12 * step)
            assert float(gradient.flatten()[index]) == pytest.approx(expected, rel=1e-6, abs=1e-8)
    return gradient


# a background of 0 is no medium; what leaks at 0 is tested below
ZERO = ("shear", "bias", "axis", "retardance", "diattenuation")


@pytest.mark.parametrize(
    ("name", "zero"),
    [
        *((name, True) for name in ZERO),
        *(pytest.param(name, False, marks=pytest.mark.slow) for name in ZERO),
        *((name, False) for name in ("background", "errors")),
    ],
)
def test_gradient_is_the_central_difference(point, name, zero):
    value = torch.zeros_like(point[name]) if zero else point[name]
    step = 1e-5 if name == "background" else 1e-4
    gradient = check_gradient(lambda v: compute({**point, name: v}, "wave"), value, step)
    assert bool((gradient != 0).all())


@pytest.mark.parametrize("name", ["retardance", "diattenuation"])
def test_gradient_where_lenses_do_nothing_yet(point, name):
    """All of the pupil at exactly 0, as a calibration begins."""
    point |= {k: torch.zeros_like(point[k]) for k in ("retardance", "diattenuation")}
    gradient = check_gradient(lambda v: compute({**point, name: v}, "wave"), point[name], 1e-4)
    assert float(gradient.abs().max()) > 1e-3


def test_shear_turns_the_prisms_axis_along(point):
    """The polarisation of the beams follows a learned shear, and the gradient knows; there is none where it is 0."""
    followed = check_gradient(lambda v: compute({**point, "shear": v}, "wave", own_axis=True), point["shear"], 1e-4)
    axis = torch.atan2(*point["shear"])
    fixed = check_gradient(lambda v: compute({**point, "shear": v, "axis": axis}, "wave"), point["shear"], 1e-4)
    assert float((followed - fixed).abs().max()) > 1e-3
    zero = torch.zeros(2, dtype=F64, requires_grad=True)
    value = compute({**point, "shear": zero}, "wave", own_axis=True)
    (gradient,) = torch.autograd.grad(value, zero)
    held = compute({**point, "shear": zero, "axis": scalar(0.0)}, "wave")
    assert torch.equal(value, held)
    assert torch.equal(gradient, *torch.autograd.grad(held, zero))


def test_extinction_of_zero_keeps_its_gradient(point):
    """The intensity is linear in each: a one-sided difference is exact."""
    zero = torch.zeros_like(point["errors"]).requires_grad_()
    (gradient,) = torch.autograd.grad(compute({**point, "errors": zero}, "wave"), zero)
    for index in (0, 1):
        step = torch.zeros(4, dtype=F64)
        step[index] = 0.5
        expected = (compute({**point, "errors": step}, "wave") - compute({**point, "errors": 0 * step}, "wave")) / 0.5
        assert float(gradient[index]) == pytest.approx(float(expected), rel=1e-9)


def test_gradient_of_the_specimen_is_the_central_difference(point, propagation):
    """Bent rays are smooth only piece by piece: their step keeps hardly any ray from its piece."""
    direction = torch.randn_like(point["delta"])
    step = 1e-7 if propagation == "rays" else 1e-5
    found = check_gradient(
        lambda t: compute({**point, "delta": point["delta"] + t * direction}, propagation), scalar(0.0), step
    )
    assert abs(float(found)) > 1e-2


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_batches_change_no_image_and_no_gradient(point, propagation):
    """Sources one by one and computed again, turned rays among them."""
    delta = point["delta"].requires_grad_()
    scope = replace(SCOPE, polarisation=Polarisation(**ERRORS, pupil=EVERYTHING))
    found = []
    for memory in (1, 1 << 30):
        images = image(
            Volume(SMALL, delta, N0), scope, Acquisition([PRISM, None], [0.3]), Fidelity(propagation, memory=memory)
        )
        found.append((images.detach(), *torch.autograd.grad(images.square().sum(), delta)))
    close(found[0][0], found[1][0])
    close(found[0][1], found[1][1], 1e-12)


def test_float32_is_close_to_float64():
    pupil = EVERYTHING
    for errors in ({}, ERRORS):
        single, double = (
            seen(Polarisation(**errors, pupil=pupil), [PRISM, None, replace(PRISM, axis=0.3)], transmission(kind))
            for kind in (torch.float32, F64)
        )
        assert single.dtype == torch.float32
        close(single.double(), double, 40 * torch.finfo(torch.float32).eps)


def test_absent_lenses_leave_matrices_real():
    momentum = torch.zeros(1, 2, 3, 4, dtype=torch.float32)
    assert JonesPupil(diattenuation=LOSSES).lenses(momentum).dtype == torch.float32
    assert JonesPupil(STRAIN).lenses(momentum).dtype == torch.complex64
    assert JonesPupil(depolarisation=True).lenses(momentum) is None


@pytest.mark.filterwarnings("ignore:objective NA .* is narrower:torchdic.SamplingWarning")
def test_light_far_outside_the_aperture_spoils_neither_image_nor_gradient():
    """There the losses' exponentials would overflow: NA 0.1 in float32 holds ρ up to 14."""
    size = torch.tensor(0.5, requires_grad=True)
    polarisation = Polarisation(pupil=JonesPupil(STRAIN, {6: (size, 0.0), 5: (0.0, size)}, depolarisation=True))
    scope = Microscope(0.546, Objective(0.1), polarisation=polarisation)
    field = transmission(torch.float32)
    found = image_field(field, GRID, scope, Acquisition([PRISM, None]), background=N0)
    assert bool(torch.isfinite(found).all())
    (gradient,) = torch.autograd.grad(found.sum(), size)
    assert bool(torch.isfinite(gradient))


@pytest.mark.parametrize("kind", ["retardance", "diattenuation"])
@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ({0: (0.1, 0.2)}, "0: a Noll index is a whole number from 1"),
        ({True: (0.1, 0.2)}, "True: a Noll index is a whole number from 1"),
        ({4: (0.1,)}, "4: 1 values, it takes 2"),
        ({4: (0.1, math.nan)}, "4: nan must be a finite number"),
    ],
)
def test_errors_state_the_number(kind, terms, message):
    with pytest.raises(ValueError, match=f"{kind} {message}"):
        JonesPupil(**{kind: terms})


def test_zernike_terms_need_an_objective_and_the_turn_needs_none():
    for pupil in (JonesPupil(STRAIN), JonesPupil(diattenuation=LOSSES), EVERYTHING):
        with pytest.raises(ValueError, match="Zernike terms need the radius of a pupil, and objective is None"):
            Microscope(0.546, polarisation=Polarisation(pupil=pupil))
    scope = Microscope(0.546, polarisation=Polarisation(pupil=JonesPupil(depolarisation=True)))
    assert bool(torch.isfinite(seen(scope.polarisation, scope=replace(scope, polarisation=None))).all())


def test_prism_axis_must_be_finite():
    with pytest.raises(ValueError, match="axis nan must be a finite number"):
        Prism((0.1, 0.2), 0.3, math.nan)
    assert Prism.senarmont((0.1, 0.2), 0.3, axis=0.7).axis == 0.7
    assert Prism.from_wedge(0.01, 2000.0, 0.546, material="quartz", axis=0.7).axis == 0.7


def test_linear_transfer_refuses_a_pupil_of_matrices():
    """Its prism's factor is one for all waves; a pupil that is empty is none."""
    volume = Volume(SMALL, torch.zeros(SMALL.shape, dtype=F64), N0)
    for prism in (PRISM, None):
        with pytest.raises(ValueError, match="polarisation pupil"):
            linear_image(volume, replace(SCOPE, polarisation=Polarisation(pupil=TRIVIAL)), Acquisition([prism]))
    empty = linear_image(volume, replace(SCOPE, polarisation=Polarisation(pupil=JonesPupil())), Acquisition([PRISM]))
    assert torch.equal(empty, linear_image(volume, SCOPE, Acquisition([PRISM])))


CONFIG = """
[volume]
shape = [2, 8, 8]
spacing = [0.4, 0.2, 0.2]
background = 1.36
[microscope]
wavelength = 0.546
objective = {{ na = 0.7 }}
[microscope.polarisation]
analyser_error = 0.01
[microscope.polarisation.pupil]
{pupil}
[acquisition]
prisms = [
    {{ shear = [0.0, 0.24], bias = 1.5, axis = 0.2 }},
    {{ shear = [0.0, 0.24], polariser = 0.4, axis = 0.3 }},
    {{ wedge = 0.01, focal_length = 2000.0, wavelength = 0.546, material = "quartz", axis = 0.4 }},
    {{ shear = [0.0, 0.24], bias = 1.5 }},
]
"""


def test_pupil_loads_from_toml_and_is_dumped_again(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.format(pupil="retardance = { 5 = [0.0, 0.1], 6 = [1, 0] }\ndepolarisation = true"))
    for _ in range(2):
        config = load(path)
        polarisation = config.microscope.polarisation
        assert polarisation is not None
        assert polarisation.analyser_error == 0.01
        pupil = polarisation.pupil
        assert isinstance(pupil, JonesPupil)
        assert pupil.retardance == {5: (0.0, 0.1), 6: (1.0, 0.0)}
        assert pupil.diattenuation is None
        assert pupil.depolarisation is True
        assert [prism.axis for prism in config.acquisition.prisms if prism] == [0.2, 0.3, 0.4, None]
        path.write_text(dump(config))


@pytest.mark.parametrize(
    ("pupil", "message"),
    [
        ("retardance = [0.1]", "polarisation.pupil.retardance: .* must be a table of Noll indices"),
        ("retardance = { tilt = [0.1, 0.2] }", "polarisation.pupil.retardance: .* must be a table of Noll indices"),
        ("diattenuation = { 5 = 0.1 }", "polarisation.pupil.diattenuation: 0.1 must be an array of 2 values"),
        ("diattenuation = { 5 = [0.1, 'a'] }", "polarisation.pupil.diattenuation: 'a' must be a number"),
        ("retardance = { 0 = [0.1, 0.2] }", "polarisation.pupil: retardance 0: a Noll index is a whole number from 1"),
        ("depolarisation = 1", "polarisation.pupil.depolarisation: 1 must be true or false"),
        ("retardence = {}", "unknown key microscope.polarisation.pupil.retardence; did you mean 'retardance'"),
    ],
)
def test_bad_pupil_in_toml_is_an_error_that_names_the_key(tmp_path, pupil, message):
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.format(pupil=pupil))
    with pytest.raises(ConfigError, match=message):
        load(path)
