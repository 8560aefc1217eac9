"""Two beams, displaced by the shear and out of phase by the bias."""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field
from torchdic.instrument.prism import MATERIALS

GRID = Grid((1, 8, 9), (1.0, 0.2, 0.3))


def test_transfer_is_the_difference_of_two_displaced_beams():
    """½[U(x + s/2)·e^{ib/2} − U(x − s/2)·e^{−ib/2}] = i·D·U: displacement by s is a factor exp(2πi f·s)."""
    frequencies = GRID.frequencies(dtype=torch.float64)
    shear, bias = (0.17, -0.31), 0.9
    displacement = torch.exp(2j * math.pi * (frequencies[0] * shear[0] + frequencies[1] * shear[1]) / 2)
    lead = complex(math.cos(bias / 2), math.sin(bias / 2))
    expected = (displacement * lead - displacement.conj() * lead.conjugate()) / 2
    found = 1j * Prism(shear, bias).transfer(frequencies)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)


def test_numbers_and_tensors_are_the_same_prism(dtype):
    frequencies = GRID.frequencies(dtype=dtype)
    expected = Prism((0.17, -0.31), 0.9).transfer(frequencies)
    assert expected.dtype == dtype
    pair = torch.tensor([0.17, -0.31], dtype=torch.float64)
    bias = torch.tensor(0.9, dtype=torch.float64)
    for shear in (pair, (pair[0], pair[1]), (0.17, pair[1])):
        assert torch.equal(Prism(shear, bias).transfer(frequencies), expected)


def test_gradient_reaches_shear_and_bias_from_zero():
    shear, bias = torch.zeros(2, dtype=torch.float64, requires_grad=True), torch.zeros((), requires_grad=True)
    Prism(shear, bias).transfer(GRID.frequencies(dtype=torch.float64)).square().sum().backward()
    assert shear.grad is not None
    assert bias.grad is not None
    assert torch.equal(shear.grad, torch.zeros(2, dtype=torch.float64))  # sin² is flat at 0: a gradient, and it is 0


@pytest.mark.parametrize(
    ("shear", "bias", "message"),
    [
        ((0.1, math.nan), 0.2, "shear x nan must be a finite number"),
        ((math.inf, 0.1), 0.2, "shear y inf must be a finite number"),
        ((0.1, 0.1), math.inf, "bias inf must be a finite number"),
        ((0.1, 0.1), torch.tensor(math.nan), "bias nan must be a finite number"),
    ],
)
def test_errors_state_the_number(shear, bias, message):
    with pytest.raises(ValueError, match=message):
        Prism(shear, bias)


# --- the wedge -----------------------------------------------------------------------------------------------------


def crossed_wedges(position, wedge, ordinary, extraordinary, height, wavelength):
    """Phases in rad of beam 1 and 2 where a plane wave along z leaves two cemented wedges, traced exactly.

    Both are `height` µm thick at position 0, where they are cemented along z = x·tanψ; the optic axis of the first lies
    along y, that of the second along x. Beam 1, polarised along y, is extraordinary in the first and ordinary in the
    second; beam 2 the other way round. Refraction keeps the wave vector along the interface (Snell); the extraordinary
    ray of an axis along x lies on the ellipse kx²/n_o² + kz²/n_e² = 1.
    """
    along = np.array([math.cos(wedge), math.sin(wedge)])  # (x, z)
    normal = np.array([-math.sin(wedge), math.cos(wedge)])
    phases = []
    for before, after in ((extraordinary, (ordinary, ordinary)), (ordinary, (ordinary, extraordinary))):
        tangential = before * along[1]  # of (0, before), the wave in the first wedge
        # tangential·along + q·normal on the ellipse: a quadratic equation in q, its forward root
        scale = np.array(after) ** -2.0
        a, b, c = (normal**2) @ scale, tangential * (along * normal) @ scale, tangential**2 * (along**2) @ scale - 1
        k = tangential * along + (math.sqrt(b * b - a * c) - b) / a * normal
        # the phase is continuous at x = z = 0; the faces are z = ±height
        phases.append(2 * math.pi / wavelength * (before * height + k[0] * position + k[1] * height))
    return phases


def test_wedge_splits_as_birefringent_refraction_does():
    """2(n_e − n_o)·tanψ, its sign and the bias of an offset.

    To first order in the birefringence B they are exact, and the wedges' symmetry removes the second: relative to
    them what is left falls as B², 1e-7 for 4e-3 and a wedge of 17°.
    """
    wedge, f_obj, wavelength, offset, height = 0.3, 1800.0, 0.546, 40.0, 500.0
    frequency, wrong = 0.7, []
    for birefringence in (4e-3, 2e-3, -2e-3, 1e-3):
        n_o, n_e = 1.5462, 1.5462 + birefringence
        prism = Prism.from_wedge(wedge, f_obj, wavelength, indices=(n_o, n_e), offset=offset)
        # light of a frequency crosses the focal plane at λ·f_obj·f; the prism's centre stands at the offset
        positions = [wavelength * f_obj * f - offset for f in (frequency, 0.0, offset / wavelength / f_obj)]
        leads = [one - two for one, two in (crossed_wedges(x, wedge, n_o, n_e, height, wavelength) for x in positions)]
        by_shear = leads[0] - leads[1]
        by_offset = leads[1] - leads[2]
        expected = 2 * math.pi * frequency * float(prism.shear[1])
        wrong.append((by_shear / expected - 1, by_offset / float(prism.bias) - 1))
        assert prism.shear[0] == 0
        assert abs(leads[2]) < 1e-5  # no lead where the wedges are equally thick
    wrong = np.array(wrong)
    assert np.abs(wrong).max() < 2e-7
    np.testing.assert_allclose(wrong[0] / wrong[1], 4, rtol=0.01)
    np.testing.assert_allclose(wrong[2] / wrong[1], 1, rtol=0.01)
    np.testing.assert_allclose(wrong[1] / wrong[3], 4, rtol=0.01)


def test_materials_are_their_indices_and_the_direction_is_that_of_the_shear():
    assert MATERIALS["quartz"][1] - MATERIALS["quartz"][0] == pytest.approx(0.0092, abs=5e-5)
    for material, indices in MATERIALS.items():
        named = Prism.from_wedge(0.01, 1800.0, 0.546, material=material, offset=30.0, direction=(3.0, -4.0))
        given = Prism.from_wedge(0.01, 1800.0, 0.546, indices=indices, offset=30.0, direction=(0.6, -0.8))
        length = 2 * (indices[1] - indices[0]) * math.tan(0.01) * 1800
        for prism in (named, given):
            assert prism.shear == pytest.approx((0.6 * length, -0.8 * length), rel=1e-14)
            assert prism.bias == pytest.approx(-2 * math.pi * length * 30 / (0.546 * 1800), rel=1e-14)


def test_wedge_may_be_learned_from_zero():
    wedge, offset = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.0, 0.0))
    prism = Prism.from_wedge(wedge, 1800.0, 0.546, material="quartz", offset=offset)
    prism.transfer(GRID.frequencies(dtype=torch.float64))[2, 3].backward()
    assert wedge.grad is not None
    slope = math.pi * float(GRID.frequencies(dtype=torch.float64)[1, 2, 3]) * 2 * (1.55531 - 1.54614) * 1800
    assert float(wedge.grad) == pytest.approx(slope)
    assert torch.equal(offset.grad, torch.zeros_like(offset))  # no wedge, no shear: the offset does nothing yet


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "either its material or its indices"),
        ({"material": "quartz", "indices": (1.5, 1.6)}, "either its material or its indices"),
        ({"material": "quartz", "focal_length": 0.0}, r"focal length 0\.0 µm must be above 0"),
        ({"material": "quartz", "wavelength": -1.0}, r"wavelength -1\.0 µm must be above 0"),
        ({"material": "quartz", "angle": 1.6}, r"wedge angle 1\.6 rad must lie between"),
        ({"material": "quartz", "direction": (0.0, 0.0)}, "must have a length above 0"),
    ],
)
def test_wedge_errors_state_the_number_and_the_law(arguments, message):
    with pytest.raises(ValueError, match=message):
        Prism.from_wedge(**{"angle": 0.01, "focal_length": 1800.0, "wavelength": 0.546} | arguments)


def test_senarmonts_polariser_sets_twice_its_angle_and_may_be_learned():
    t = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    prism = Prism.senarmont((0.1, 0.2), t)
    prism.transfer(GRID.frequencies(dtype=torch.float64))[0, 0].backward()
    assert t.grad == 1  # d sin(bias/2)/dt at 0
    assert Prism.senarmont((0.1, 0.2), 0.35).bias == 0.7


# --- no condenser prism --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shear", "aperture"), [((0.0, 0.24), 0.4), ((0.3, -0.2), 0.5), ((0.2, 0.4), 0.7)])
@pytest.mark.parametrize("bias", [0.0, 1.1, math.pi / 2])
def test_empty_field_without_a_condenser_prism_loses_contrast(shear, aperture, bias):
    """½(1 − cos(bias)·2J1(a)/a), a = 2π|s|NA_c/λ: extinction is lost, in which a bias of π/2 has no part."""
    grid = Grid((1, 4, 5), (1.0, 0.15, 0.15))
    a = 2 * math.pi * math.hypot(*shear) * aperture / 0.546
    for condenser_prism, contrast in ((True, 1.0), (False, 2 * j1(a) / a)):
        scope = Microscope(0.546, Objective(0.75), Condenser(aperture), condenser_prism=condenser_prism)
        volume = Volume(grid, torch.zeros(grid.shape, dtype=torch.float64), 1.36)
        images = image(volume, scope, Acquisition([Prism(shear, bias)]), Fidelity(sources=200))
        expected = torch.full_like(images, (1 - math.cos(bias) * contrast) / 2)
        torch.testing.assert_close(images, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("aperture", [0.1, 0.3, 0.5])
def test_weak_grating_without_a_condenser_prism_fades_with_the_aperture(aperture):
    """A bias of π/2 makes DIC linear in the phase: the grating's contrast falls by 2J1(a)/a to first order in it.

    In focus and with a pupil wide enough to pass both orders of every source only the prism knows the source's tilt.
    """
    grid = Grid((1, 4, 40), (1.0, 0.2, 0.1))
    x = grid.coordinates(2, dtype=torch.float64).expand(4, 40)
    phase = 1e-4 * torch.cos(2 * math.pi * x * 2 / 4.0)
    shear, images = (0.0, 0.3), []
    for condenser_prism in (True, False):
        scope = Microscope(0.546, None, Condenser(aperture), condenser_prism=condenser_prism)
        images.append(
            image_field(
                torch.polar(torch.ones_like(phase), phase),
                grid,
                scope,
                Acquisition([Prism(shear, math.pi / 2)]),
                background=1.36,
                fidelity=Fidelity(sources=128),
            )[0, 0]
        )
    with_prism, without = ((i - i.mean()).abs().max() for i in images)
    a = 2 * math.pi * shear[1] * aperture / 0.546
    assert float(without / with_prism) == pytest.approx(2 * j1(a) / a, abs=1e-3)


def test_axial_light_needs_no_condenser_prism():
    transmission = torch.randn(8, 9, dtype=torch.complex128)
    images = [
        image_field(
            transmission,
            GRID,
            Microscope(0.546, Objective(0.75), condenser_prism=present),
            Acquisition([Prism((0.1, 0.2), 0.9), None], [0.3]),
            background=1.36,
        )
        for present in (True, False)
    ]
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=1e-14)


def test_oblique_light_without_a_condenser_prism_has_a_bias_of_its_own():
    """One source: as a prism whose bias is larger by 2π f_s·s, exactly."""
    grid, transmission = Grid((1, 8, 9), (1.0, 0.2, 0.21)), torch.randn(8, 9, dtype=torch.complex128)
    direction = torch.tensor([[0.12, -0.3]], dtype=torch.float64)
    shear, bias = (0.1, 0.2), 0.9
    own = bias + 2 * math.pi * (0.1 * float(direction[0, 0]) + 0.2 * float(direction[0, 1])) / 0.546
    images = [
        image_field(
            transmission,
            grid,
            Microscope(0.546, Objective(0.75), Condenser(0.4, points=direction), condenser_prism=present),
            Acquisition([Prism(shear, b)], [0.3]),
            background=1.36,
        )
        for present, b in ((True, own), (False, bias))
    ]
    torch.testing.assert_close(images[1], images[0], rtol=0, atol=1e-13)
