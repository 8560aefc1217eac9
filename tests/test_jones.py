"""Polarised light: Jones's algebra, its laws, and what imperfect polarising optics make of an image."""

import math
from dataclasses import fields, replace

import pytest
import torch

from recon.config.conversion import dump
from recon.config.reading import load
from recon.config.schema import ConfigError
from torchdic import (
    Acquisition,
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
from torchdic.instrument import jones
from torchdic.linear import linear_image

F64 = torch.float64
ANGLES = torch.linspace(-2.0, 2.2, 9, dtype=F64)
GRID = Grid((1, 12, 15), (1.0, 0.2, 0.21))
PRISM = Prism((0.13, 0.27), 0.8)
ERRORS = {
    "polariser_extinction": 0.03,
    "analyser_extinction": 0.02,
    "analyser_error": -0.07,
    "retardance_error": 0.11,
}


def close(found, expected, atol=1e-14):
    expected = torch.as_tensor(expected, dtype=found.dtype)
    torch.testing.assert_close(found, expected.expand_as(found), rtol=0, atol=atol)


def transmission():
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=F64) for a in (1, 2)), indexing="ij")
    phase = 0.7 * torch.exp(-((y - 0.2) ** 2) / 0.3 - (x + 0.3) ** 2 / 0.2) + 0.2 * torch.sin(2 * y + x)
    return torch.polar(1 - 0.2 * torch.exp(-((x - 0.5) ** 2) - y**2), phase)


def seen(polarisation=None, prisms=(PRISM,), **options):
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4), polarisation=polarisation, **options)
    return image_field(
        transmission(), GRID, scope, Acquisition(prisms, [0.4, -0.3]), background=1.36, fidelity=Fidelity(sources=5)
    )


# --- the algebra ---------------------------------------------------------------------------------------------------


def test_malus():
    """Behind two polarisers at an angle α the intensity is cos²α."""
    light = jones.apply(jones.train(jones.polariser(0.3), jones.polariser(0.3 + ANGLES)), jones.linear(0.3))
    close(jones.intensity(light), ANGLES.cos().square())


def test_crossed_polarisers_are_dark_and_a_third_between_them_brightens():
    crossed = jones.train(jones.polariser(0.4), jones.polariser(0.4 + math.pi / 2))
    close(crossed, 0.0)
    between = jones.train(jones.polariser(0.4), jones.polariser(0.4 + ANGLES), jones.polariser(0.4 + math.pi / 2))
    close(jones.intensity(jones.apply(between, jones.linear(0.4))), (2 * ANGLES).sin().square() / 4)


def test_polariser_is_a_projection_and_rotation_turns_every_element():
    P, R = jones.polariser(ANGLES), jones.rotation(ANGLES)
    close(P @ P, P)
    close(R @ jones.polariser(0.0) @ R.mT, P)
    close(jones.apply(R, jones.linear(0.2)), jones.linear(0.2 + ANGLES))
    plate = jones.retarder(0.9, 0.2)
    close(R.to(plate.dtype) @ plate @ R.mT.to(plate.dtype), jones.retarder(0.9, 0.2 + ANGLES))


def test_slow_axis_gains_phase():
    plate = jones.retarder(0.9, 0.0)
    close(plate, torch.polar(torch.eye(2, dtype=F64), torch.tensor([[0.45, 0.0], [0.0, -0.45]], dtype=F64)))


def test_half_wave_plate_mirrors_the_plane_of_polarisation_and_quarter_wave_plate_makes_circular_light():
    mirrored = jones.apply(jones.half_wave_plate(ANGLES), jones.linear(0.3))
    close(mirrored, 1j * jones.linear(2 * ANGLES - 0.3))
    circular = jones.apply(jones.quarter_wave_plate(math.pi / 4), jones.linear(0.0))
    close(jones.intensity(jones.apply(jones.polariser(ANGLES), circular)), 0.5)
    twice = jones.train(jones.quarter_wave_plate(0.7), jones.quarter_wave_plate(0.7))
    close(twice, jones.half_wave_plate(0.7))


def test_train_is_in_the_order_in_which_light_meets_its_elements():
    first, second, third = jones.polariser(0.1), jones.retarder(0.7, 0.5), jones.rotation(0.9)
    close(jones.train(first, second, third), third.to(second.dtype) @ second @ first.to(second.dtype))
    with pytest.raises(ValueError, match="at least 1 element, not 0"):
        jones.train()


def test_retarders_and_rotations_conserve_energy():
    for element in (jones.retarder(ANGLES, 0.3), jones.retarder(1.1, ANGLES), jones.rotation(ANGLES)):
        close(element @ element.mH, torch.eye(2))
    light = torch.randn(2, dtype=torch.complex128)
    plates = jones.train(jones.retarder(ANGLES, 0.3), jones.rotation(ANGLES), jones.quarter_wave_plate(0.2))
    close(jones.intensity(jones.apply(plates, light)), jones.intensity(light))


def test_parallel_and_crossed_analyser_share_all_light():
    light = torch.randn(2, dtype=torch.complex128)
    both = sum(jones.intensity(jones.apply(jones.polariser(ANGLES + turn), light)) for turn in (0.0, math.pi / 2))
    close(both, jones.intensity(light))


def test_leaky_polariser_is_two_crossed_ones_and_their_intensities():
    light, r = torch.randn(2, dtype=torch.complex128), 0.04
    matrix = torch.tensor([[1.0, 0.0], [0.0, math.sqrt(r)]], dtype=F64)
    turned = jones.train(jones.rotation(-0.6), matrix, jones.rotation(0.6))
    W = jones.leaky(0.6, r)
    close(turned.mT @ turned, W)
    passed = (light.conj() @ W.to(light.dtype) @ light).real
    close(jones.intensity(jones.apply(turned, light)), passed)
    assert torch.equal(jones.leaky(0.6, None), jones.polariser(0.6))


@pytest.mark.parametrize("start", [0.0, 0.4])
def test_gradients_of_angles_and_retardances_are_those_of_finite_differences(start):
    def elements(angle, retardance, extinction):
        light = jones.train(
            jones.polariser(angle + 0.3),
            jones.retarder(retardance, angle),
            jones.quarter_wave_plate(2 * angle),
            jones.half_wave_plate(angle - 1.0),
            jones.rotation(retardance),
        )
        return torch.view_as_real(light), jones.linear(angle), jones.leaky(angle, extinction)

    inputs = [torch.full((), start, dtype=F64, requires_grad=True) for _ in range(3)]
    assert torch.autograd.gradcheck(elements, inputs)


def test_elements_keep_dtype_and_batch(dtype):
    angle = torch.linspace(0, 1, 6, dtype=dtype).reshape(2, 3)
    assert jones.polariser(angle).dtype == dtype
    assert jones.leaky(angle, 0.1).dtype == dtype
    assert jones.leaky(0.1, angle).shape == (2, 3, 2, 2)
    for plate in (jones.retarder(0.5, angle), jones.retarder(angle, 0.5), jones.quarter_wave_plate(angle)):
        assert plate.dtype == dtype.to_complex()
        assert plate.shape == (2, 3, 2, 2)
    assert jones.apply(jones.polariser(angle), jones.linear(angle)).shape == (2, 3, 2)
    assert jones.polariser(0.3).dtype == F64


# --- the microscope's optics ---------------------------------------------------------------------------------------


def behind_the_analyser(half_difference, angle=0.0, polariser=None, plate=None, analyser=0.0):
    """The amplitude behind the analyser by Jones's algebra: the prism is a retarder of 2ϑ, slow for beam 1."""
    optics = [] if plate is None else [jones.retarder(plate, math.pi / 4)]
    optics += [jones.retarder(2 * half_difference, 0.0), jones.polariser(analyser - math.pi / 4)]
    light = jones.linear(math.pi / 4 + angle) if polariser is None else polariser
    light = jones.apply(jones.train(*optics), light.expand(*half_difference.shape, 2))
    return (light * jones.linear(analyser - math.pi / 4)).sum(-1)


def test_senarmonts_bias_is_twice_the_polarisers_angle():
    """Polariser at 45° + t, quarter-wave plate with its slow axis at 45°, analyser at −45°: the bias is +2t."""
    for t in (-0.7, 0.0, 0.3, 1.2):
        with_plate = behind_the_analyser(ANGLES, angle=t, plate=math.pi / 2)
        by_prism = behind_the_analyser(ANGLES + t)
        close(with_plate.abs(), by_prism.abs())
        close(by_prism, 1j * torch.sin(ANGLES + t))
        # one phase for all ϑ: nothing but the bias differs
        close(with_plate * by_prism.conj(), complex(math.cos(math.pi / 4), math.sin(math.pi / 4)) * by_prism.abs() ** 2)
    assert Prism.senarmont((0.1, 0.2), 0.35).bias == 0.7


def test_analyser_off_by_an_angle_mixes_in_the_parallel_image():
    e = 0.2
    close(
        behind_the_analyser(ANGLES, analyser=e),
        1j * ANGLES.sin() * math.cos(e) + ANGLES.cos() * math.sin(e),
    )


def test_plate_that_is_no_quarter_wave_unbalances_the_beams_but_not_the_empty_field():
    """Retardance π/2 + δ: beam intensities 1 ± sin 2t·sin δ, interference cos 2t + i·sin 2t·cos δ."""
    t, delta = 0.4, 0.15
    light = jones.apply(jones.retarder(math.pi / 2 + delta, math.pi / 4), jones.linear(math.pi / 4 + t))
    beams = light.abs().square() * 2
    close(beams, 1 + math.sin(2 * t) * math.sin(delta) * torch.tensor([1.0, -1.0], dtype=F64))
    close(2 * light[0] * light[1].conj(), complex(math.cos(2 * t), math.sin(2 * t) * math.cos(delta)))
    empty = behind_the_analyser(torch.zeros(1, dtype=F64), angle=t, plate=math.pi / 2 + delta)
    close(empty.abs(), math.sin(t))


def quadratic(polarisation, half_difference, bias):
    a, b, c = polarisation.form(bias)
    S, C = half_difference.sin(), half_difference.cos()
    return a * S**2 + b * C**2 + (c * C * S).real


@pytest.mark.parametrize("declared", [*ERRORS, "all"])
def test_intensity_is_that_of_jones_algebra(declared):
    """Unpolarised light as two crossed halves, each imperfect polariser as two crossed perfect ones."""
    errors = ERRORS if declared == "all" else {declared: ERRORS[declared]}
    polarisation, bias = Polarisation(**errors), 0.8
    plate = None if "retardance_error" not in errors else math.pi / 2 + errors["retardance_error"]
    t = 0.0 if plate is None else bias / 2
    inside = ANGLES if plate is not None else ANGLES + bias / 2
    expected = torch.zeros_like(ANGLES)
    for turn, share in ((0.0, 1.0), (math.pi / 2, errors.get("polariser_extinction", 0.0))):
        for other, passed in ((0.0, 1.0), (math.pi / 2, errors.get("analyser_extinction", 0.0))):
            amplitude = behind_the_analyser(
                inside,
                polariser=jones.linear(math.pi / 4 + t + turn),
                plate=plate,
                analyser=errors.get("analyser_error", 0.0) + other,
            )
            expected = expected + share * passed * amplitude.abs().square()
    close(quadratic(polarisation, ANGLES + bias / 2, bias), expected)


def test_finite_extinction_adds_the_sum_of_the_beams():
    """(r_pol + r_an)·|½(U1 + U2)|², and r_pol·r_an of the image itself for what passes both crossed."""
    r_pol, r_an = ERRORS["polariser_extinction"], ERRORS["analyser_extinction"]
    polarisation = Polarisation(polariser_extinction=r_pol, analyser_extinction=r_an)
    found = seen(polarisation)
    parallel = seen(prisms=[replace(PRISM, bias=PRISM.bias + math.pi)])
    close(found, (1 + r_pol * r_an) * seen() + (r_pol + r_an) * parallel, atol=1e-13)


def test_extinction_of_the_empty_field_is_the_sum_of_both_leaks():
    """An empty field without bias: r_pol + r_an of the parallel polarisers' light, and sin² e of a misaligned one."""
    grid = Grid((1, 4, 4), (1.0, 0.2, 0.2))
    for errors, expected in (
        ({"polariser_extinction": 1e-3, "analyser_extinction": 2e-3}, 3e-3),
        ({"analyser_error": 0.1}, math.sin(0.1) ** 2),
        ({"retardance_error": 0.1}, 0.0),
    ):
        scope = Microscope(0.546, Objective(0.75), Condenser(0.4), polarisation=Polarisation(**errors))
        images = image(
            Volume(grid, torch.zeros(grid.shape, dtype=F64), 1.36), scope, Acquisition([Prism((0.1, 0.2), 0.0)])
        )
        close(images, expected)


def test_misaligned_analyser_is_a_coherent_mixture_of_two_fields():
    """cos e of the crossed field and sin e of the parallel one, against a hand-made transfer of complex values."""
    e, axial = 0.2, Microscope(0.2, polarisation=Polarisation(analyser_error=0.2))
    field = transmission()
    frequencies = GRID.frequencies(dtype=F64)
    transfer = 1j * PRISM.transfer(frequencies) * math.cos(e) + PRISM.parallel(frequencies) * math.sin(e)
    expected = torch.fft.ifft2(torch.fft.fft2(field) * transfer).abs().square()
    found = image_field(field, GRID, axial, Acquisition([PRISM]), background=1.36)[0, 0]
    close(found, expected, atol=1e-13)


def test_unequal_beams_of_a_plate_are_seen_in_an_image():
    """|U1·j1 − U2·j2|²/4 with the beams' amplitudes of a plate of retardance π/2 + δ."""
    delta = 0.3
    axial = Microscope(0.2, polarisation=Polarisation(retardance_error=delta))
    light = jones.apply(jones.retarder(math.pi / 2 + delta, math.pi / 4), jones.linear(math.pi / 4 + PRISM.bias / 2))
    f = GRID.frequencies(dtype=F64)
    displaced = torch.exp(1j * math.pi * (f[0] * PRISM.shear[0] + f[1] * PRISM.shear[1]))
    spectrum = torch.fft.fft2(transmission())
    one, two = (torch.fft.ifft2(spectrum * d) for d in (displaced, displaced.conj()))
    expected = (light[0] * one - light[1] * two).abs().square() / 2
    found = image_field(transmission(), GRID, axial, Acquisition([PRISM]), background=1.36)[0, 0]
    close(found, expected, atol=1e-13)


# --- absent, and zero ----------------------------------------------------------------------------------------------


@pytest.fixture
def transforms(monkeypatch):
    """How often each Fourier transform has been called."""
    counts = []
    for name in ("fft2", "ifft2"):
        original = getattr(torch.fft, name)
        monkeypatch.setattr(torch.fft, name, lambda *a, _f=original, **k: (counts.append(1), _f(*a, **k))[1])
    return counts


def test_what_is_absent_costs_nothing_and_changes_no_bit(transforms):
    prisms = [PRISM, None, Prism((0.2, 0.0), -1.0)]
    plain = seen(prisms=prisms)
    cost = len(transforms)
    assert cost == 1 + 2 * 3  # the specimen's spectrum, and one for each focus and prism
    assert torch.equal(seen(Polarisation(), prisms=prisms), plain)
    assert len(transforms) == 2 * cost
    seen(Polarisation(analyser_error=0.0), prisms=prisms)
    assert len(transforms) == 3 * cost + 2 * 2  # the parallel field of each focus and prism, none for bright field
    seen(prisms=prisms, condenser_prism=False)
    assert len(transforms) == 4 * cost + 2 * 2


def test_ideal_optics_never_ask_for_the_polarisations_form(monkeypatch):
    monkeypatch.setattr(Polarisation, "form", lambda *_: pytest.fail("the scalar pair has no polarisation"))
    seen(Polarisation())


def test_zero_errors_are_the_scalar_pair_to_rounding_and_bright_field_has_no_polarisers():
    prisms = [PRISM, None, Prism((0.2, 0.0), -1.0)]
    expected = seen(prisms=prisms)
    close(seen(Polarisation(0.0, 0.0, 0.0, 0.0), prisms=prisms), expected, atol=2e-15)
    assert torch.equal(seen(Polarisation(**ERRORS), prisms=prisms)[1], expected[1])


@pytest.mark.parametrize("condenser_prism", [True, False])
@pytest.mark.parametrize("start", [dict.fromkeys(ERRORS, 0.0), ERRORS], ids=["zero", "errors"])
def test_gradient_of_each_error_is_that_of_finite_differences(start, condenser_prism):
    weights = torch.randn(1, 2, *GRID.shape[1:], dtype=F64)

    def score(values, bias):
        prism = Prism(PRISM.shear, bias)
        polarisation = Polarisation(**dict(zip(start, values, strict=True)))
        return (weights * seen(polarisation, [prism], condenser_prism=condenser_prism)).sum()

    values = [torch.tensor(v, dtype=F64, requires_grad=True) for v in start.values()]
    bias = torch.tensor(0.8, dtype=F64, requires_grad=True)
    gradients = torch.autograd.grad(score(values, bias), [*values, bias])
    point, h = [*start.values(), 0.8], 1e-4
    for i, (gradient, name) in enumerate(zip(gradients, [*start, "bias"], strict=True)):
        steps = [0.0, h, 2 * h] if "extinction" in name else [-h, h]
        there = [
            float(score(list(moved[:-1]), moved[-1]))
            for moved in ([*point[:i], point[i] + step, *point[i + 1 :]] for step in steps)
        ]
        # an extinction can't be negative: the image is linear in it, so that any difference is exact
        slope = (there[1] - there[0]) / h if len(there) == 3 else (there[1] - there[0]) / (2 * h)
        assert float(gradient) == pytest.approx(slope, abs=1e-6)
        assert gradient.abs() > 1e-4


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
def test_images_keep_their_dtype(kind):
    grid = Grid((2, 6, 7), (0.4, 0.2, 0.2))
    scope = Microscope(0.546, Objective(0.75), polarisation=Polarisation(**ERRORS), condenser_prism=False)
    images = image(Volume(grid, torch.zeros(grid.shape, dtype=kind), 1.36), scope, Acquisition([PRISM]))
    assert images.dtype == kind


def test_linear_transfer_knows_the_polarisation(smooth_field):
    """What is left over falls as the square of the contrast."""
    grid = Grid((3, 10, 12), (0.4, 0.2, 0.2))
    scope = Microscope(0.546, Objective(0.75), Condenser(0.4), polarisation=Polarisation(**ERRORS))
    acquisition, fidelity = Acquisition([PRISM, None], [0.3]), Fidelity("wave", sources=4)
    shape = smooth_field(grid)

    def error(contrast):
        volume = Volume(grid, contrast * shape, 1.36)
        return (
            (image(volume, scope, acquisition, fidelity) - linear_image(volume, scope, acquisition, fidelity))
            .abs()
            .max()
        )

    assert float(error(0.0)) < 1e-14
    assert float(error(1e-3) / error(5e-4)) == pytest.approx(4, abs=0.1)
    with pytest.raises(ValueError, match="needs a condenser prism"):
        linear_image(Volume(grid, shape, 1.36), replace(scope, condenser_prism=False), acquisition, fidelity)


@pytest.mark.parametrize(
    ("errors", "message"),
    [
        ({"polariser_extinction": -0.1}, r"polariser_extinction -0\.1 must be at least 0 and below 1"),
        ({"analyser_extinction": 1.0}, r"analyser_extinction 1\.0 must be at least 0 and below 1"),
        ({"analyser_error": math.nan}, "analyser_error nan must be a finite number"),
        ({"retardance_error": torch.tensor(math.inf)}, "retardance_error inf must be a finite number"),
    ],
)
def test_errors_state_the_number(errors, message):
    with pytest.raises(ValueError, match=message):
        Polarisation(**errors)


# --- configuration -------------------------------------------------------------------------------------------------

CONFIG = """
[volume]
shape = [2, 8, 8]
spacing = [0.4, 0.2, 0.2]
background = 1.36
[microscope]
wavelength = 0.546
condenser_prism = false
polarisation = {{ polariser_extinction = 1e-3, analyser_error = 0{more} }}
[acquisition]
prisms = [{{ shear = [0.0, 0.24], bias = 1.5708 }}]
"""


def test_polarisation_loads_from_toml_and_is_dumped_again(tmp_path):
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.format(more=""))
    microscope = load(path).microscope
    assert not microscope.condenser_prism
    assert microscope.polarisation is not None
    declared = [getattr(microscope.polarisation, field.name) for field in fields(Polarisation)]
    assert declared == [1e-3, None, 0.0, None, None]
    path.write_text(dump(load(path)))
    again = load(path).microscope
    assert not again.condenser_prism
    assert [getattr(again.polarisation, field.name) for field in fields(Polarisation)] == declared


def test_unphysical_polarisation_in_toml_is_an_error_that_names_the_key(tmp_path):
    path = tmp_path / "config.toml"
    for more, message in (
        (", analyser_extinction = 2", "analyser_extinction 2.0 must be at least 0 and below 1"),
        (", analyser_eror = 2", "unknown key microscope.polarisation.analyser_eror"),
        (", retardance_error = true", "retardance_error: True must be a number"),
    ):
        path.write_text(CONFIG.format(more=more))
        with pytest.raises(ConfigError, match=message):
            load(path)


def test_prisms_in_toml_may_be_given_by_polariser_or_wedge_and_are_dumped_resolved(tmp_path):
    path = tmp_path / "config.toml"
    prisms = """prisms = [
    { shear = [0.1, 0.2], polariser = 0.35 },
    { wedge = 0.01, focal_length = 1800, wavelength = 0.546, material = "quartz", offset = 25, direction = [3, 4] },
    { wedge = 0.01, focal_length = 1800, wavelength = 0.546, indices = [1.5, 1.51] },
    ]"""
    start = CONFIG.format(more="")
    start = start[: start.index("prisms =")]
    path.write_text(start + prisms)
    expected = [
        Prism.senarmont((0.1, 0.2), 0.35),
        Prism.from_wedge(0.01, 1800.0, 0.546, material="quartz", offset=25.0, direction=(3.0, 4.0)),
        Prism.from_wedge(0.01, 1800.0, 0.546, indices=(1.5, 1.51)),
    ]
    for _ in range(2):
        found = load(path).acquisition.prisms
        assert [(p.shear, p.bias) for p in found] == [(p.shear, p.bias) for p in expected]
        path.write_text(dump(load(path)))


@pytest.mark.parametrize(
    ("prism", "message"),
    [
        ("{ shear = [0.1, 0.2], polariser = 0.3, bias = 0.6 }", r"unknown key acquisition\.prisms\[0\]\.bias"),
        (
            "{ wedge = 0.01, focal_length = 1800, wavelength = 0.546 }",
            r"prisms\[0\]: a wedge needs either its material",
        ),
        ("{ wedge = 0.01, wavelength = 0.546 }", r"missing key acquisition\.prisms\[0\]\.focal_length"),
        (
            '{ wedge = 0.01, focal_length = 1800, wavelength = 0.546, material = "glass" }',
            r"prisms\[0\]\.material: 'glass' must be one of 'quartz', 'calcite'",
        ),
    ],
)
def test_errors_of_such_prisms_name_the_key(tmp_path, prism, message):
    path = tmp_path / "config.toml"
    start = CONFIG.format(more="")
    path.write_text(start[: start.index("prisms =")] + f"prisms = [{prism}]")
    with pytest.raises(ConfigError, match=message):
        load(path)
