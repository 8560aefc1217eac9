"""The whole path: thin transmissions, errors and warnings; the laws of images are in test_laws."""

import math
import warnings

import pytest
import torch

from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    SamplingWarning,
    Volume,
    image,
    image_field,
)

N0 = 1.36
GRID = Grid((3, 12, 15), (0.4, 0.2, 0.2))
POINTS = torch.tensor([[0.0, 0.0], [0.3, -0.1], [-0.15, 0.35]], dtype=torch.float64)


def microscope(**options):
    return Microscope(0.546, Objective(0.75), Condenser(0.4, points=POINTS), **options)


def empty(grid=GRID, background=N0):
    return Volume(grid, torch.zeros(grid.shape, dtype=torch.float64), background)


def test_image_of_a_thin_slice_is_that_of_its_transmission(smooth_field):
    """One slice so thin that nothing spreads in it, along the axis: t = exp(i·k0·Δn·dz)."""
    grid = Grid((1, 15, 17), (1e-3, 0.2, 0.2))
    delta = smooth_field(grid, 0.2)
    axial = Microscope(0.546, Objective(0.75, {4: 0.2, 7: 0.1}))
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0), None], [0.4, -0.7])
    phase = 2 * math.pi / 0.546 * delta[0] * 1e-3
    expected = image_field(torch.polar(torch.ones_like(phase), phase), grid, axial, acquisition, background=N0)
    signal = float((expected - expected.mean((-1, -2), keepdim=True)).abs().max())
    for propagation in ("projection", "wave"):
        found = image(Volume(grid, delta, N0), axial, acquisition, Fidelity(propagation))
        # what is scattered by an angle crosses the slice 1/cosθ longer: a part of the contrast
        assert float((found - expected).abs().max()) < {"projection": 2e-3, "wave": 0.2}[propagation] * signal


def test_one_transmission_for_all_sources_is_the_same_one_for_each():
    transmission = torch.randn(12, 15, dtype=torch.complex128)
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0), None], [0.4, -0.7])
    one = image_field(transmission, GRID, microscope(), acquisition, background=N0)
    each = image_field(transmission.expand(3, 12, 15), GRID, microscope(), acquisition, background=N0)
    assert torch.equal(one, each)


def test_each_source_may_have_its_own_transmission_in_the_order_of_the_sources():
    own = torch.randn(3, 12, 15, dtype=torch.complex128)
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0)], [0.4])
    found = image_field(own, GRID, microscope(), acquisition, background=N0)
    alone = [
        image_field(
            own[i],
            GRID,
            Microscope(0.546, Objective(0.75), Condenser(0.4, points=POINTS[i : i + 1])),
            acquisition,
            background=N0,
        )
        for i in range(3)
    ]
    torch.testing.assert_close(found, sum(alone) / 3)


def test_real_transmission_is_an_absorber():
    real = torch.rand(12, 15, dtype=torch.float64)
    found = image_field(real, GRID, microscope(), Acquisition(), background=N0)
    torch.testing.assert_close(found, image_field(real + 0j, GRID, microscope(), Acquisition(), background=N0))
    # no pupil, axial, in focus: |t|²
    sharp = image_field(real, Grid((1, 12, 15), (1.0, 0.4, 0.4)), Microscope(0.546), Acquisition(), background=N0)
    torch.testing.assert_close(sharp[0, 0], real.square(), rtol=0, atol=1e-13)


def test_transmission_is_padded_with_the_empty_field():
    transmission = torch.randn(12, 15, dtype=torch.complex128)
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0)], [0.4])
    found = image_field(transmission, GRID, microscope(), acquisition, background=N0, fidelity=Fidelity(padding=3))
    wide = torch.nn.functional.pad(transmission, (3, 3, 3, 3), value=1.0)
    by_hand = image_field(wide, Grid((3, 18, 21), GRID.spacing), microscope(), acquisition, background=N0)
    assert torch.equal(found, by_hand[..., 3:-3, 3:-3])


def test_image_of_a_transmission_does_not_depend_on_the_batch_of_sources():
    transmission = torch.randn(12, 15, dtype=torch.complex128)
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0)], [0.4])
    tiny, large = (
        image_field(transmission, GRID, microscope(), acquisition, background=N0, fidelity=Fidelity(memory=m))
        for m in (1, 1 << 30)
    )
    torch.testing.assert_close(tiny, large, rtol=0, atol=1e-13)


def test_defocus_is_the_exact_angular_spectrum():
    """A grating 1 + ε·exp(2πi f·x) at distance z: the first order gains exp(ik0(p_z − n0)z), whatever its angle."""
    grid = Grid((1, 8, 20), (1.0, 0.2, 0.2))
    x = grid.coordinates(2, dtype=torch.float64)
    f, epsilon, focus = 6 / 4.0, 1e-3, 1.7
    transmission = (1 + epsilon * torch.exp(2j * math.pi * f * x)).expand(8, 20)
    found = image_field(transmission, grid, Microscope(0.546), Acquisition(focus=[focus]), background=N0)[0, 0]
    pz = math.sqrt(N0**2 - (0.546 * f) ** 2)
    # the plane z_f is what is seen sharp: the field is carried on to it
    order = torch.exp(1j * (2 * math.pi * f * x + 2 * math.pi / 0.546 * (pz - N0) * focus))
    torch.testing.assert_close(found, ((1 + epsilon * order).abs() ** 2).expand(8, 20), rtol=0, atol=1e-12)


def test_prism_acts_on_the_envelope_and_pupil_on_the_field():
    """An oblique wave, nothing in its way: full transmission inside the NA, and the bias alone whatever the shear."""
    for direction, inside in (([0.0, 0.7], True), ([0.0, 0.76], False)):
        points = torch.tensor([direction], dtype=torch.float64)
        oblique = Microscope(0.546, Objective(0.75), Condenser(0.5, points=points))
        images = image(empty(), oblique, Acquisition([None, Prism((0.0, 0.21), 1.0)]))
        expected = [1.0, math.sin(0.5) ** 2] if inside else [0.0, 0.0]
        for found, value in zip(images[:, 0], expected, strict=True):
            torch.testing.assert_close(found, torch.full_like(found, value), rtol=0, atol=1e-13)


@pytest.mark.parametrize("spacing", [0.23, 0.25])
def test_undersampling_is_reported_once_and_computed(spacing):
    """NA 0.75 + 0.4: voxels of at most 0.546/2.3 = 0.237 µm."""
    grid = Grid((2, 10, 10), (0.5, 0.2, spacing))
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        images = image(empty(grid), microscope(), Acquisition([None, None], [0.0, 1.0]))
    expected = ["0.25 µm are coarser than λ/(2(NA_o + NA_c)) = 0.237 µm"] if spacing > 0.237 else []
    assert len(seen) == len(expected)
    for warning, text in zip(seen, expected, strict=True):
        assert warning.category is SamplingWarning
        assert text in str(warning.message)
    assert images.shape == (2, 2, 10, 10)


def test_points_beyond_the_mediums_index_are_an_error():
    scope = Microscope(0.546, None, Condenser(0.3, points=torch.tensor([[1.0, 1.0]])))
    with pytest.raises(ValueError, match=r"1\.41421 must stay below the medium's index 1\.36"):
        image(empty(), scope, Acquisition())


def test_transmission_of_another_shape_is_an_error():
    with pytest.raises(ValueError, match=r"transmission has shape \(12, 16\), the grid and sources ask for \(12, 15\)"):
        image_field(torch.ones(12, 16), GRID, microscope(), Acquisition(), background=N0)
    with pytest.raises(ValueError, match=r"\(2, 12, 15\), the grid and sources ask for \(3, 12, 15\)"):
        image_field(torch.ones(2, 12, 15), GRID, microscope(), Acquisition(), background=N0)


def test_transmission_that_is_not_finite_is_an_error():
    hole = torch.ones(GRID.shape[1:])
    hole[2, 3] = math.nan
    with pytest.raises(ValueError, match="transmission holds 1 values that are not finite"):
        image_field(hole, GRID, microscope(), Acquisition(), background=N0)


@pytest.mark.parametrize("wavelength", [0.0, -0.5, math.inf, math.nan])
def test_wavelength_must_be_above_zero(wavelength):
    with pytest.raises(ValueError, match=r"wavelength .* must be above 0"):
        Microscope(wavelength)


def test_acquisition_needs_something_to_record():
    for arguments in (((), (0.0,)), ((None,), ())):
        with pytest.raises(ValueError, match="at least one prism"):
            Acquisition(*arguments)
    with pytest.raises(ValueError, match="focus nan must be a finite depth"):
        Acquisition(focus=[0.0, math.nan])


def test_settings_may_be_any_sequence():
    expected = image(empty(), microscope(), Acquisition([Prism((0.1, 0.2), 1.0), None], [0.0, 1.0]))
    found = image(
        empty(), microscope(), Acquisition((Prism(torch.tensor([0.1, 0.2]), 1.0), None), (0.0, torch.tensor(1.0)))
    )
    assert found.shape == expected.shape == (2, 2, 12, 15)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)
