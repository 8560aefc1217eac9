"""Values of a calibration: from levels, from a known specimen and from trials; each within its uncertainty."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import recon.calibration.known_specimen as known
from data_synthetic import Bead
from recon.calibration.beside_volume import Beside, find_angles, find_images, find_length
from recon.calibration.foreknowledge import Foreknowledge, most_probable
from recon.calibration.known_specimen import ModelledSpecimen, calibrate
from recon.calibration.length_and_bias import Shared, shared
from recon.calibration.levels import biases_of_levels
from recon.calibration.optics import (
    Aberrations,
    CondenserAperture,
    Displacement,
    FocusZero,
    ShearOfAxes,
    axes_of,
)
from recon.calibration.part import part_of
from recon.calibration.trials.profile import FREEDOM, least_misfit
from recon.fit.bounds import Bounds
from recon.fit.nuisances.light import Lamp
from recon.fit.problem import Recipe
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.errors import SamplingWarning

pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
rad = math.radians


# --- levels -----------------------------------------------------------------------------------------------------------


def levels(*biases, lamp=3000.0, leak=0.002):
    return [lamp * ((1.0 if b is None else math.sin(rad(b) / 2) ** 2) + leak) for b in biases]


def found_biases(declared, true):
    told = [None if b is None else rad(b) for b in declared]
    return biases_of_levels(told, levels(*true), [0.004] * len(true))


@pytest.mark.parametrize(
    ("declared", "true"),
    [((60, None), (70, None)), ((60, -60, None), (72, -66, None)), ((30, 60, 90), (33, 66, 99))],
)
def test_a_bright_field_or_several_settings_tell_the_biases(declared, true):
    found = found_biases(declared, true)
    for bias, deviation, told, right in zip(found.biases, found.deviations, found.told, true, strict=True):
        if right is None:
            assert bias is None
            continue
        assert told
        assert abs(bias - rad(right)) < 3 * deviation
        assert abs(bias - rad(right)) < rad(2)


def test_a_pair_of_opposite_bias_tells_the_zero_alone():
    found = found_biases((90, -90), (96, -84))
    assert found.told == (False, False)
    assert found.zero == pytest.approx(rad(6), abs=3 * found.zero_deviation)
    assert found.zero_deviation < rad(1.5)


def test_one_setting_tells_nothing():
    found = found_biases((90,), (80,))
    assert found.told == (False,)
    assert found.zero_deviation > rad(10)


def test_unequal_levels_are_refused():
    with pytest.raises(ValueError, match="level 0 must be above 0"):
        biases_of_levels([1.0], [0.0], [0.01])
    with pytest.raises(ValueError, match="2 biases, 1 levels"):
        biases_of_levels([1.0, 2.0], [1.0], [0.01])


# --- trials -----------------------------------------------------------------------------------------------------------


def each(misfits_at):
    """Of several values."""
    return lambda values: map(misfits_at, values)


def test_the_least_of_a_parabola_is_found_wherever_it_lies():
    for true in (-0.3, 0.02, 0.31):
        found = least_misfit(each(lambda v, t=true: np.full(4, 0.1 + (v - t) ** 2)), 0.0, 0.12, 0.1, 1000, (-1, 1))
        assert found.value == pytest.approx(true, abs=1e-9)
        assert found.deviation == pytest.approx(math.sqrt(0.1 / 1000), rel=0.1)  # σ² = noise over curvature and pixels


def test_images_that_disagree_make_the_least_uncertain():
    places = np.array([-0.05, 0.05, 0.02, -0.02])
    found = least_misfit(each(lambda v: 0.1 + (v - places) ** 2), 0.0, 0.12, 0.1, 10**9, (-1, 1))
    assert found.value == pytest.approx(0.0, abs=1e-9)
    assert found.deviation == pytest.approx(places.std(ddof=1) / 2, rel=1e-6)  # the error of a mean of four


def test_a_misfit_without_a_least_within_the_limits_tells_nothing():
    assert least_misfit(each(lambda v: np.array([0.1 + 0.01 * v])), 0.0, 0.12, 0.1, 100, (-1, 1)).deviation == math.inf


def test_noise_that_volumes_absorb_makes_the_least_uncertain():
    """Where the best volume leaves less than the noise, that it leaves still less elsewhere may be freedom alone."""
    absorbed, curvature, pixels = 0.002, 1.0, 1000
    found = least_misfit(each(lambda v: np.full(4, 0.098 + (v - 0.05) ** 2)), 0.0, 0.12, 0.1, pixels, (-1, 1))
    assert found.deviation == pytest.approx(math.sqrt((0.1 / pixels + FREEDOM * absorbed) / curvature), rel=1e-6)
    assert found.absorbed == pytest.approx(absorbed / 0.1)
    assert found.told == pytest.approx(0.098 + 0.05**2)


# --- unknowns ---------------------------------------------------------------------------------------------------------

GRID = Grid((3, 16, 18), (0.5, 0.2, 0.2))
PRISMS = [Prism((0.0, 0.2), 1.2), Prism((0.2, 0.0), 1.2), Prism((0.0, -0.2), 1.0)]


def small_setup():
    z, y, x = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * d for n, d in zip(GRID.shape, GRID.spacing, strict=True)
    )
    delta = 0.02 * torch.exp(-(z[:, None, None] ** 2 + (y[:, None] + 0.3) ** 2 + (x - 0.2) ** 2) / 0.5)
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.5))
    return Setup(Volume(GRID, delta, 1.4), microscope, Acquisition(PRISMS, (-0.4, 0.5)))


UNKNOWNS = [
    ShearOfAxes(axes_of(Acquisition(PRISMS))),
    FocusZero(),
    Displacement(),
    Aberrations((5, 7, 11)),
    Lamp(),
]


@pytest.mark.parametrize("unknown", UNKNOWNS, ids=lambda u: u.name)
def test_gradients_are_those_of_differences(unknown):
    setup, few = small_setup(), Fidelity("wave", sources=3)
    with torch.no_grad():
        data = setup.images(few)
    misfit = GaussianMisfit(data)
    start = unknown.start(setup, misfit)
    random = torch.Generator().manual_seed(3)
    weight = torch.randn(data.shape, generator=random, dtype=torch.float64)
    here = start + 0.3 * unknown.step * torch.randn(start.shape, generator=random, dtype=torch.float64)
    toward = torch.randn(start.shape, generator=random, dtype=torch.float64)

    def value(parameter):
        return (weight * unknown.put(unknown.value(parameter), setup).images(few)).sum()

    leaf = here.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    step = 1e-5
    with torch.no_grad():
        difference = (value(here + step * toward) - value(here - step * toward)) / (2 * step)
    # central differences: relative error of step²
    assert float((gradient * toward).sum()) == pytest.approx(float(difference), rel=1e-5, abs=1e-8)


@pytest.mark.parametrize("unknown", UNKNOWNS[:1] + UNKNOWNS[4:], ids=lambda u: u.name)
def test_an_entry_acts_on_the_images_that_it_says(unknown):
    setup, few = small_setup(), Fidelity("wave", sources=3)
    with torch.no_grad():
        before = setup.images(few)
        start = unknown.start(setup, GaussianMisfit(before))
        acting = unknown.acting(start, (3, 2)).abs().sum(2) > 0
        for entry in range(start.numel()):
            moved = start.clone()
            moved.view(-1)[entry] += unknown.step
            changed = unknown.put(unknown.value(moved), setup).images(few) - before
            seen = changed.abs().amax((2, 3)) > 1e-12
            assert torch.equal(seen, acting[:, :, entry])


def test_prisms_whose_shears_differ_by_their_sign_share_an_axis():
    assert axes_of(Acquisition([None, *PRISMS])) == (0, 0, 1, 0)


def test_a_condenser_never_exceeds_what_the_medium_lets_pass():
    setup = small_setup()
    wide = CondenserAperture(1.4).put(torch.tensor(10.0), setup)
    assert wide.microscope.condenser.na == pytest.approx(1.4)


# --- a known specimen -------------------------------------------------------------------------------------------------


def bead_images(true, photons, seed, bead, field):
    """A bead's images on pixels that integrate, from voxels of half the size and twice as many slabs."""
    fine = Grid((16, 2 * (field[0] + 20), 2 * (field[1] + 20)), (0.2, 0.1, 0.1))
    volume = Volume(fine, bead.delta(fine, dtype=torch.float32), bead.background)
    images = image(volume, Microscope(0.546, Objective(0.8), Condenser(0.5)), true, Fidelity(sources=40))
    pixels = Camera(pixel_size=0.2).integrate(images, (0.1, 0.1), (2 * field[0], 2 * field[1]))
    return Camera(photons=photons).record(pixels, torch.Generator().manual_seed(seed))


def optics_of_bead(seed, rounds, monkeypatch, biases=(75.0, -75.0)):
    monkeypatch.setattr(known, "ROUNDS", rounds)
    bead, place = Bead(1.2, 0.06, 1.4), Bead(1.2, 0.06, 1.4, (0.1, 0.3, -0.4))
    true = Acquisition([Prism((0.06, 0.18), rad(b)) for b in biases], (-1.5, 0.0, 1.5))
    with torch.no_grad():
        data = bead_images(true, 20000.0, seed, place, (32, 30))
    told = Acquisition([Prism((0.04, 0.19), rad(b + math.copysign(6, b))) for b in biases], true.focus)
    return calibrate(data, told_setup(told, data), ModelledSpecimen(bead.delta, 2.4, 2.4)), true


def told_setup(acquisition, data):
    medium = empty_medium(Grid((8, 32, 30), (0.5, 0.2, 0.2)), 1.4, data)
    return Setup(medium, Microscope(0.546, Objective(0.8), Condenser(0.45)), acquisition)


@pytest.mark.slow
def test_a_bead_tells_shear_bias_aperture_and_place(monkeypatch):
    found, true = optics_of_bead(0, ((8, 3), (20, 1)), monkeypatch, (75.0,))
    prism, right = found.setup.acquisition.prisms[0], true.prisms[0]
    length = math.hypot(*map(float, prism.shear)) / math.hypot(*right.shear)
    angle = math.atan2(*map(float, prism.shear)) - math.atan2(*right.shear)
    errors = {
        "bias": (float(prism.bias) - right.bias, float(found.deviations["bias"][0]), rad(6)),
        "length": (math.log(length), float(found.deviations["shear"][0, 0]), 0.08),
        "angle": (angle, float(found.deviations["shear"][0, 1]), rad(3)),
        "focus": (float(found.values["focus_zero"]) + 0.1, float(found.deviations["focus_zero"]), 0.1),
    }
    for name, (error, deviation, most) in errors.items():
        assert abs(error) < most, name
        assert abs(error) < 4 * deviation, name
    assert found.values["drift"].mean((0, 1)).tolist() == pytest.approx([0.3, -0.4], abs=0.03)
    assert found.setup.microscope.condenser.na == pytest.approx(0.5, rel=0.04)
    assert found.misfit < 1.2 * found.noise


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_errors_of_a_bead_are_within_three_deviations(monkeypatch, seed):
    found, true = optics_of_bead(seed, known.ROUNDS, monkeypatch)
    for index, right in enumerate(true.prisms):
        prism = found.setup.acquisition.prisms[index]
        assert abs(float(prism.bias) - right.bias) < min(3 * float(found.deviations["bias"][index]), rad(3))
    length = math.hypot(*map(float, prism.shear)) / math.hypot(*right.shear)
    assert abs(math.log(length)) < min(3 * float(found.deviations["shear"][0, 0]), 0.05)


def test_what_a_calibration_cannot_be_of_is_told():
    bead = Bead(1.2, 0.06, 1.4)
    noise = 1 + 0.01 * torch.randn(1, 2, 32, 30, generator=torch.Generator().manual_seed(0))
    told = told_setup(Acquisition([Prism((0.0, 0.2), 1.4)], (0.0, 1.0)), noise)
    with pytest.raises(ValueError, match="the specimen isn't in the images"):
        calibrate(noise, told, ModelledSpecimen(bead.delta, 2.4, 2.4))
    with pytest.raises(ValueError, match=r"shape \(1, 1, 32, 30\), the acquisition and grid ask for \(1, 2, 32, 30\)"):
        calibrate(noise[:, :1], told, ModelledSpecimen(bead.delta, 2.4, 2.4))
    with pytest.raises(ValueError, match="the noise is given of 2 prisms, the data have 1"):
        calibrate(noise, told, ModelledSpecimen(bead.delta, 2.4, 2.4), [0.01, 0.01])
    bare = replace(told, microscope=Microscope(0.546))
    with pytest.raises(ValueError, match=r"aberrations \[11\] are of an objective, and the microscope has none"):
        calibrate(noise, bare, ModelledSpecimen(bead.delta, 2.4, 2.4), zernike=[11])


def test_a_calibration_takes_seven_planes_and_some_light_around_the_bead(monkeypatch):
    """And the noise that the images show."""

    class TakenError(Exception):
        pass

    def taken(*given):
        raise TakenError(*given)

    monkeypatch.setattr(known, "find_optics", taken)
    data = 1 + 0.01 * torch.randn(1, 9, 70, 70, generator=torch.Generator().manual_seed(0))
    told = Acquisition([Prism((0.0, 0.2), 1.4)], [0.5 * plane for plane in range(9)])
    medium = empty_medium(Grid((8, 70, 70), (0.5, 0.2, 0.2)), 1.4, data)
    mask = torch.ones_like(data, dtype=torch.bool)
    specimen = ModelledSpecimen(Bead(1.2, 0.06, 1.4).delta, 2.4, 2.4)
    with pytest.raises(TakenError) as found:
        calibrate(data, Setup(medium, Microscope(0.546, Objective(0.8)), told), specimen, mask=mask, zernike=(11,))
    part, model, acquisition, noise, zernike = found.value.args
    assert part.planes == (0, 1, 3, 4, 5, 7, 8)
    assert part.data.shape == part.mask.shape == (1, 7, 47, 47)  # 2.4 µm and 3.5 µm on each side, of 0.2 µm
    assert model.volume.grid.shape == (12, 67, 67)  # of 0.2 µm; a fifth wider on each side
    assert acquisition is told
    assert noise == pytest.approx([0.01], rel=0.05)
    assert zernike == (11,)


# --- beside an unknown volume -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_unknown_specimen_tells_the_shears_direction():
    place = Bead(1.2, 0.03, 1.4, (0.1, 0.3, -0.4))
    true = Acquisition([Prism((0.06, 0.18), rad(b)) for b in (75, -75)], (-1.5, -0.5, 0.5, 1.5))
    with torch.no_grad():
        data = bead_images(true, 20000.0, 0, place, (32, 30))
    told = Acquisition([Prism((0.0, 0.19), rad(b)) for b in (75, -75)], true.focus)
    part = part_of(data, None, Grid((8, 32, 30), (0.5, 0.2, 0.2)))
    setup = part.setup(1.4, Microscope(0.546, Objective(0.8), Condenser(0.5)), told)
    (found,) = find_angles(Beside(part, setup, Recipe(), [0.005, 0.005]).held())
    error = found.value - math.atan2(0.06, 0.18)
    assert abs(error) < rad(3)
    assert abs(error) < 3 * max(found.deviation, rad(0.3))


def test_trials_warn_of_no_aperture_of_theirs(recwarn):
    """Voxels that are coarse for a trial's condenser say nothing of the user's."""
    acquisition = Acquisition([Prism((0.0, 0.2), 1.4)], (-0.5, 0.5))
    with torch.no_grad():
        data = bead_images(acquisition, 20000.0, 0, Bead(1.2, 0.03, 1.4), (18, 18))
    setup = part_of(data, None, Grid((4, 18, 18), (0.5, 0.2, 0.2))).setup(
        1.4, Microscope(0.546, Objective(0.9), Condenser(0.8)), acquisition
    )
    Beside(part_of(data, None, setup.field), setup, Recipe(), [0.005], steps=1, sources=2).misfits(setup)
    assert [str(warning.message) for warning in recwarn if warning.category is SamplingWarning] == []


@pytest.mark.slow
@pytest.mark.parametrize(("longer", "more"), [(1.2, 0.0), (1.0, 8.0)], ids=["length", "bias"])
def test_two_settings_tell_the_product_of_length_and_slope(longer, more):
    """The length that makes s·cot(b/2) right, whether it was declared too long or the bias too large."""
    place = Bead(1.2, 0.03, 1.4, (0.1, 0.3, -0.4))
    true = Acquisition([Prism((0.06, 0.18), rad(b)) for b in (75, -75)], (-1.5, -0.5, 0.5, 1.5))
    with torch.no_grad():
        data = bead_images(true, 20000.0, 0, place, (32, 30))
    shear = (0.06 * longer, 0.18 * longer)
    told = Acquisition([Prism(shear, rad(b + math.copysign(more, b))) for b in (75, -75)], true.focus)
    part = part_of(data, None, Grid((8, 32, 30), (0.5, 0.2, 0.2)))
    setup = part.setup(1.4, Microscope(0.546, Objective(0.8), Condenser(0.5)), told)
    found = find_length(Beside(part, setup, Recipe(), [0.005, 0.005]))
    expected = -math.log(longer) + math.log(math.tan(rad(75 + more) / 2) / math.tan(rad(75) / 2))
    assert abs(found.value - expected) < 0.06
    assert abs(found.value - expected) < 3 * math.hypot(found.deviation, found.unexplained)


KNOWN = Foreknowledge.within(0.15, rad(10), rad(10))


@pytest.mark.parametrize("change", [-0.2, 0.1])
@pytest.mark.parametrize("biases", [(1.2, -1.2), (0.5, 2.0), (1.2 + 2 * math.pi, -0.3), (-2.9,)])
def test_length_and_bias_share_what_their_product_changes_by(biases, change):
    found = shared(change, 0.0, biases, KNOWN)
    assert found.change == change
    for before, after in zip(biases, found.biases, strict=True):
        slopes = [1 / math.tan(abs(math.remainder(bias, 2 * math.pi)) / 2) for bias in (before, after)]
        assert found.length + math.log(slopes[1] / slopes[0]) == pytest.approx(change)
        assert abs(after - before) < 0.5  # on the same side of 0, in the same turn
    assert 0 < found.length / change < 1


def test_length_and_bias_are_the_most_probable_ones():
    """No other pair is more probable, to first order in the change of the bias."""
    change, deviation, bias = 0.02, 0.07, rad(65)

    def improbable(length: float, more: float) -> float:
        rest = change - length + more / math.sin(bias)
        return (rest / deviation) ** 2 + (length / KNOWN.length) ** 2 + (more / KNOWN.bias) ** 2

    found = shared(change, deviation, [bias], KNOWN)
    least = improbable(found.length, found.biases[0] - bias)
    for length, more in ((2e-3, 0.0), (-2e-3, 0.0), (0.0, 2e-3), (0.0, -2e-3)):
        assert improbable(found.length + length, found.biases[0] - bias + more) > least
    # and their deviations are what the curvature of it says
    curvature = torch.autograd.functional.hessian(
        lambda x: (
            ((change - x[0] + x[1] / math.sin(bias)) / deviation).square() / 2
            + (x[0] / KNOWN.length).square() / 2
            + (x[1] / KNOWN.bias).square() / 2
        ),
        torch.zeros(2, dtype=torch.float64),
    )
    variances = torch.linalg.inv(curvature).diagonal().sqrt().tolist()
    assert [found.length_deviation, *found.bias_deviations] == pytest.approx(variances)


def test_what_images_tell_is_weighed_against_what_was_known():
    """Halfway where both are known alike; what is known exactly stays, and so does what the images don't tell."""
    assert most_probable(0.2, 0.1, 0.1) == pytest.approx((0.1, 0.1 / math.sqrt(2)))
    assert most_probable(0.2, 0.0, 0.1) == (0.2, 0.0)
    assert most_probable(0.2, 0.1, 0.0) == (0.0, 0.0)
    assert most_probable(0.0, math.inf, 0.1) == (0.0, 0.1)


def test_the_more_uncertain_of_length_and_bias_takes_the_larger_part():
    """At 90° 10° are a change of the product by 17 %, at 30° by 35 %."""
    part = shared(0.1, 0.0, [math.pi / 2], KNOWN).length
    assert part == pytest.approx(0.1 * 0.15**2 / (0.15**2 + rad(10) ** 2))
    parts = [shared(0.1, 0.0, [rad(bias)], KNOWN).length for bias in (90, 60, 30, 10)]
    assert parts == sorted(parts, reverse=True)
    # without a differential part there is nothing that the bias could take
    exact = Foreknowledge(0.1, 0.2, 0.1)
    assert shared(0.1, 0.0, [math.pi], exact) == Shared(0.1, 0.1, 0.0, (math.pi,), (0.2,))


def test_what_is_known_beforehand_stays():
    """A bias that is known stays and the length takes all; where both are, nothing changes."""
    bias_known = shared(0.1, 0.0, [1.2], Foreknowledge(0.1, 0.0, 0.1))
    assert bias_known.length == pytest.approx(0.1)
    assert bias_known.biases == (1.2,)
    assert shared(0.1, 0.05, [1.2], Foreknowledge(0.0, 0.0, 0.1)) == Shared(0.0, 0.0, 0.0, (1.2,), (0.0,))
    length_known = shared(0.1, 0.05, [1.2], Foreknowledge(0.0, 0.1, 0.1))
    assert (length_known.length, length_known.length_deviation) == (0.0, 0.0)
    assert length_known.biases[0] < 1.2
    # what the images hardly tell changes hardly anything
    assert shared(0.1, 10.0, [1.2], KNOWN).change < 1e-4


def test_what_the_product_does_not_tell_stays_unsure():
    exact, unsure = (shared(0.1, deviation, [1.2], KNOWN) for deviation in (0.0, 100.0))
    assert 0.5 * KNOWN.length < exact.length_deviation < KNOWN.length
    assert 0.5 * KNOWN.bias < exact.bias_deviations[0] < KNOWN.bias
    assert unsure.length_deviation == pytest.approx(KNOWN.length, rel=1e-4)
    assert unsure.bias_deviations[0] == pytest.approx(KNOWN.bias, rel=1e-4)


@pytest.mark.parametrize(("drift", "noise"), [(0.1, 0.004), (0.0, 0.02), (0.1, 0.02)])
@pytest.mark.slow
def test_drift_is_found_within_three_deviations(drift, noise):
    """In a stack without drift none is found, beside a volume that is fitted to the noise too."""
    grid, sides = Grid((5, 24, 22), (0.6, 0.2, 0.2)), torch.tensor([1.0, -2.0, 1.0])
    true = drift / 2 * torch.stack((sides, -sides / 2), 1).expand(2, 3, 2)
    acquisition = Acquisition([Prism((0.06, 0.18), rad(b)) for b in (75, -75)], (-1.2, 0.0, 1.2))
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.5))
    bead = Bead(1.2, 0.03, 1.4, (0.1, 0.3, -0.4)).delta(grid, dtype=torch.float32)
    with torch.no_grad():
        setup = Setup(Volume(grid, bead, 1.4), microscope, acquisition, drift=true)
        images = setup.images(Fidelity("wave", sources=30))
    data = images + noise * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    part = part_of(data, None, grid)
    beside = Beside(part, part.setup(1.4, microscope, acquisition), Recipe(bounds=Bounds(0.0, None)), [noise] * 2)
    found, deviations = find_images(beside)
    assert float(((found["drift"] - true).abs() / deviations["drift"]).max()) < 3
    assert float(deviations["drift"].max()) < 0.1
