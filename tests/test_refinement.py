import itertools
import math
from dataclasses import replace

import pytest
import torch
from absolute import Absolute
from distant import Device, bring, send

from data_synthetic import GaussianBall
from recon.fit.bounds import Bounds
from recon.fit.descent import minimise
from recon.fit.nuisances import refinement
from recon.fit.nuisances.bias import Bias, CommonBias
from recon.fit.nuisances.drift import Drift
from recon.fit.nuisances.focus import FocusErrors
from recon.fit.nuisances.light import Brightness
from recon.fit.nuisances.nearby import Nearby
from recon.fit.nuisances.refinement import Beforehand, best_brightness, refined
from recon.fit.nuisances.shear import ShearError
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem
from recon.fit.setup import Setup, empty_medium
from recon.fit.unknowns import IndexDifference, with_values
from recon.misfit.gaussian import GaussianMisfit
from recon.misfit.poisson import PoissonMisfit
from recon.recording.noise import NoiseModel
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BACKGROUND = 1.5
GRID = Grid((6, 24, 26), (0.5, 0.2, 0.21))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
TRUE = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.2)], [-1.2, 0.0, 1.2])
FIDELITY = Fidelity(sources=6)
OFF = math.radians(10)
BRIGHTNESS = torch.tensor([[1.02, 0.985, 1.01], [0.98, 1.015, 0.99]])
DRIFT = torch.tensor([[[0.1, -0.06], [-0.04, 0.1], [-0.08, 0.0]], [[0.06, 0.05], [-0.1, -0.02], [0.06, -0.07]]])


def setup(grid=GRID, acquisition=TRUE, dtype=torch.float32, **known):
    delta = GaussianBall(0.6, 0.02, BACKGROUND, (0.3, -0.3, 0.4)).delta(grid, dtype=dtype)
    return Setup(Volume(grid, delta, BACKGROUND), MICROSCOPE, acquisition, **known)


def turned(by=OFF):
    return Acquisition([replace(prism, bias=prism.bias + by) for prism in TRUE.prisms], TRUE.focus)


def starts(unknowns, known, misfit):
    return {unknown.name: unknown.start(known, misfit) for unknown in unknowns}


def values(unknowns, parameters):
    return {unknown.name: unknown.value(parameters[unknown.name]) for unknown in unknowns}


def misfit_of(unknowns, parameters, known, misfit):
    return float(misfit(with_values(unknowns, values(unknowns, parameters), known).images(FIDELITY)))


def repeated(unknowns, known, misfit, times):
    parameters = starts(unknowns, known, misfit)
    for _ in range(times):
        parameters = refined(unknowns, parameters, known, misfit, FIDELITY)
    return values(unknowns, parameters)


def test_one_step_finds_bias_brightness_and_drift_beside_the_true_volume():
    """To 5 % of what they were off, and a few steps to 1e-3 of it."""
    data = setup(brightness=BRIGHTNESS, drift=DRIFT).images(FIDELITY)
    unknowns = [Bias(), Brightness(), Drift()]
    misfit, known = GaussianMisfit(data), setup(acquisition=turned())
    assert float(DRIFT.mean((0, 1)).abs().max()) < 1e-8  # else it would be the volume's place
    for times, share in ((1, 0.05), (4, 1e-3)):
        found = repeated(unknowns, known, misfit, times)
        assert float((found["bias"] - torch.tensor([1.5, -1.2])).abs().max()) < share * OFF
        assert float((found["brightness"] - BRIGHTNESS).abs().max()) < share * 0.02
        assert float((found["drift"] - DRIFT).abs().max()) < share * 0.1


def test_focus_errors_are_found_beside_the_true_volume():
    errors = torch.tensor([0.15, -0.2, 0.05])
    seen = Acquisition(TRUE.prisms, [f + float(e) for f, e in zip(TRUE.focus, errors, strict=True)])
    misfit = GaussianMisfit(setup(acquisition=seen).images(FIDELITY))
    found = repeated([FocusErrors()], setup(), misfit, 3)["focus"]
    torch.testing.assert_close(found, errors, rtol=0, atol=2e-3)


def test_a_bead_tells_the_shear():
    """Its length and its direction, against a volume that is known."""
    factor, angle = 1.08, math.radians(4)
    seen = ShearError().put(torch.tensor([factor, angle]), setup())
    misfit = GaussianMisfit(seen.images(FIDELITY))
    found = repeated([ShearError()], setup(), misfit, 3)["shear"]
    assert found.tolist() == pytest.approx([factor, angle], abs=1e-4)


def test_a_common_bias_and_everything_else_are_found_at_once():
    acquisition = Acquisition([Prism((0.0, 0.24), 1.4), None, Prism((0.24, 0.0), -1.4)], TRUE.focus)
    brightness, drift = torch.cat((BRIGHTNESS, BRIGHTNESS[:1])), torch.cat((DRIFT, DRIFT[:1] * 0))
    drift = drift - drift.mean((0, 1))
    unknowns = [CommonBias(), ShearError(), FocusErrors(), Brightness(), Drift()]
    truth = {
        "bias": torch.tensor(1.5),
        "shear": torch.tensor([1.05, -0.05]),
        "focus": torch.tensor([0.1, -0.15, 0.05]),
        "brightness": brightness,
        "drift": drift,
    }
    known = setup(acquisition=acquisition, dtype=torch.float64)
    misfit = GaussianMisfit(with_values(unknowns, truth, known).images(FIDELITY))
    found = repeated(unknowns, known, misfit, 5)
    for name, expected in truth.items():
        torch.testing.assert_close(found[name].float(), expected, rtol=0, atol=1e-3, msg=name)


@pytest.mark.parametrize("sides", [(24, 26), (23, 25), (21, 26)])
def test_drift_and_brightness_are_found_within_a_margin(sides):
    grid = Grid((6, *sides), (0.5, 0.2, 0.21))
    data = setup(grid, brightness=BRIGHTNESS, drift=DRIFT, margin=4).images(FIDELITY)
    found = repeated([Brightness(), Drift()], setup(grid, margin=4), GaussianMisfit(data), 3)
    torch.testing.assert_close(found["brightness"], BRIGHTNESS, rtol=0, atol=1e-4)
    torch.testing.assert_close(found["drift"], DRIFT, rtol=0, atol=1e-3)


# few images


@pytest.fixture
def propagations(monkeypatch):
    """The number of prisms of every image that is formed."""
    formed = []

    def counted(volume, microscope, acquisition, fidelity):
        formed.append(len(acquisition.prisms))
        return image(volume, microscope, acquisition, fidelity)

    monkeypatch.setattr("recon.fit.setup.image", counted)
    return formed


def test_brightness_and_drift_propagate_nothing(propagations):
    data = setup(brightness=BRIGHTNESS, drift=DRIFT).images(FIDELITY)
    known, unknowns = setup(), [Brightness(), Drift()]
    formed = known.formed(FIDELITY)
    propagations.clear()
    misfit = GaussianMisfit(data)
    start = starts(unknowns, known, misfit)
    with_images = refined(unknowns, start, known, misfit, FIDELITY, formed)
    assert propagations == []
    without = refined(unknowns, start, known, misfit, FIDELITY)
    assert propagations == [2]
    assert all(torch.equal(with_images[name], without[name]) for name in start)


def test_prisms_are_moved_with_one_propagation(propagations):
    """The images as they are, and a pair for the biases and each of a shear's two entries; then one for the try."""
    misfit, known = GaussianMisfit(setup().images(FIDELITY)), setup(acquisition=turned(0.02))
    propagations.clear()
    unknowns = [Bias(), ShearError(), Brightness()]
    refined(unknowns, starts(unknowns, known, misfit), known, misfit, FIDELITY)
    assert propagations == [2 * (1 + 2 * 3), 2]
    propagations.clear()
    unknowns = [Bias(), FocusErrors()]
    refined(unknowns, starts(unknowns, known, misfit), known, misfit, FIDELITY, known.formed(FIDELITY))
    assert propagations == [2, 2 * 2, 2, 2]  # the given images, biases, planes, the try


def test_where_everything_is_found_no_try_is_formed(propagations):
    misfit, known = GaussianMisfit(setup().images(FIDELITY)), setup()
    propagations.clear()
    start = starts([Bias()], known, misfit)
    found = refined([Bias()], start, known, misfit, FIDELITY)
    assert propagations == [2 * 3]
    assert torch.equal(found["bias"], start["bias"])


def test_nothing_is_differentiated_and_nothing_given_is_changed():
    data = setup(brightness=BRIGHTNESS).images(FIDELITY)
    misfit, known, unknowns = GaussianMisfit(data), setup(acquisition=turned()), [Brightness(), Bias()]
    known = replace(known, volume=Volume(GRID, known.volume.delta.requires_grad_(), BACKGROUND))
    start = {name: part.requires_grad_() for name, part in starts(unknowns, known, misfit).items()}
    before = {name: part.detach().clone() for name, part in start.items()}
    found = refined(unknowns, start, known, misfit, FIDELITY)
    assert not any(part.requires_grad for part in found.values())
    assert all(torch.equal(start[name], before[name]) for name in start)
    assert not any(torch.equal(start[name], found[name]) for name in start)
    assert known.volume.delta.grad is None


def test_without_unknowns_nothing_is_computed(propagations):
    data = torch.rand(2, 3, 24, 26)
    assert refined([], {}, setup(), GaussianMisfit(data), FIDELITY) == {}
    assert propagations == []


@pytest.fixture
def away():
    """A function: how far nearby images are from those at 1, 2 and 4 steps of an unknown, and how far these are."""
    prisms = [Prism((0.0, 0.24), 1.4), Prism((0.24, 0.0), -1.4)]
    known = setup(acquisition=Acquisition(prisms, TRUE.focus), dtype=torch.float64, margin=3)
    misfit = GaussianMisfit(known.images(FIDELITY))

    def measure(unknown):
        start = starts([unknown], known, misfit)
        nearby = Nearby([unknown], start, known, FIDELITY)
        way = unknown.step * torch.randn(start[unknown.name].shape, dtype=torch.float64)
        left, moved = [], []
        for by in (1.0, 2.0, 4.0):
            parameters = {unknown.name: start[unknown.name] + by * way}
            images = nearby.placed(parameters).images(FIDELITY)
            left.append(float((nearby.recorded(parameters) - images).norm()))
            moved.append(float((images - misfit.data).norm()))
        return left, moved

    return measure


@pytest.mark.parametrize("unknown", [Bias(), CommonBias(), FocusErrors()], ids=["bias", "common bias", "focus"])
def test_what_nearby_images_leave_falls_with_the_cube_of_the_distance(unknown, away):
    left, moved = away(unknown)
    assert left[1] > 5 * left[0]
    assert left[2] > 5 * left[1]
    assert left[2] < 0.05 * moved[2]


def test_nearby_images_leave_little_where_two_entries_move_one_image(away):
    """The length and the angle of a shear: their product is of second order and is left out."""
    left, moved = away(ShearError())
    assert left[2] < 0.05 * moved[2]


@pytest.mark.parametrize("unknown", [Brightness(), Drift()], ids=["brightness", "drift"])
def test_nearby_images_record_exactly(unknown, away):
    assert max(away(unknown)[0]) < 1e-12


# the misfit never grows


def wrong(name):
    """A setup, unknowns and data that don't go together well."""
    data = setup(brightness=BRIGHTNESS, drift=DRIFT).images(FIDELITY)
    noisy = data + 0.05 * torch.randn(data.shape)
    known = setup(acquisition=turned(1.2))
    if name == "a bias that is far off":
        return data, known, [Bias(), Brightness()]
    if name == "an empty volume":
        return noisy, replace(known, volume=empty_medium(GRID, BACKGROUND, data)), [Bias(), Brightness(), Drift()]
    if name == "another specimen":
        other = Volume(GRID, -2 * setup().volume.delta, BACKGROUND)
        return data, replace(known, volume=other), [Bias(), Brightness(), Drift(), FocusErrors(), ShearError()]
    return torch.rand(data.shape), known, [Bias(), Brightness(), Drift(), FocusErrors(), ShearError()]


KINDS = {
    "gaussian": GaussianMisfit,
    "absolute": Absolute,
    "poisson": lambda data: PoissonMisfit(data, NoiseModel(1e-3, 0.0)),
}
# each misfit once, and each setup but that of noise alone
FAST = (("a bias that is far off", "poisson"), ("an empty volume", "gaussian"), ("another specimen", "absolute"))


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pytest.param(name, KINDS[kind], id=f"{name}-{kind}", marks=() if (name, kind) in FAST else pytest.mark.slow)
        for name in ("a bias that is far off", "an empty volume", "another specimen", "noise alone")
        for kind in KINDS
    ],
)
def test_no_step_raises_the_misfit(name, kind):
    data, known, unknowns = wrong(name)
    misfit = kind(data)
    parameters = starts(unknowns, known, misfit)
    values_ = [misfit_of(unknowns, parameters, known, misfit)]
    for _ in range(4):
        parameters = refined(unknowns, parameters, known, misfit, FIDELITY)
        assert all(bool(torch.isfinite(part).all()) for part in parameters.values())
        values_.append(misfit_of(unknowns, parameters, known, misfit))
    # the same images by another order of prisms round differently
    assert all(after <= before * (1 + 1e-5) for before, after in itertools.pairwise(values_))
    assert values_[-1] < values_[0]


def test_a_step_that_would_raise_the_misfit_is_not_taken(monkeypatch):
    """Not even its sixteenth, where it goes the wrong way."""
    data = setup(brightness=BRIGHTNESS).images(FIDELITY)
    misfit, known, unknowns = GaussianMisfit(data), setup(), [Brightness()]
    start = starts(unknowns, known, misfit)
    right = refinement._gauss_newton

    def backwards(*arguments):
        step, length = right(*arguments)
        return {name: -part for name, part in step.items()}, length

    monkeypatch.setattr(refinement, "_gauss_newton", backwards)
    assert torch.equal(refined(unknowns, start, known, misfit, FIDELITY)["brightness"], start["brightness"])

    def long(*arguments):
        step, length = right(*arguments)
        return {name: 3 * part for name, part in step.items()}, length

    monkeypatch.setattr(refinement, "STEPS", 1)
    monkeypatch.setattr(refinement, "_gauss_newton", long)
    half = refined(unknowns, start, known, misfit, FIDELITY)["brightness"]
    monkeypatch.setattr(refinement, "_gauss_newton", right)
    expected = 1.5 * refined(unknowns, start, known, misfit, FIDELITY)["brightness"]
    torch.testing.assert_close(half, expected, rtol=1e-4, atol=1e-7)


def test_what_the_images_say_nothing_of_stays():
    """The drift and the focus of an empty volume, and the bias that bright field doesn't have."""
    acquisition = Acquisition([Prism((0.0, 0.24), 1.5), None], TRUE.focus)
    data = setup(acquisition=acquisition).images(FIDELITY)
    known = replace(setup(acquisition=acquisition), volume=empty_medium(GRID, BACKGROUND, data))
    misfit, unknowns = GaussianMisfit(data), [Drift(), FocusErrors(), Bias()]
    found = values(unknowns, refined(unknowns, starts(unknowns, known, misfit), known, misfit, FIDELITY))
    assert float(found["drift"].abs().max()) < 1e-3
    assert float(found["focus"].abs().max()) < 1e-3
    assert float(found["bias"][1]) == 0


def test_what_is_found_on_nearby_images_is_judged_by_new_ones(monkeypatch):
    """Where those are worse, nothing is taken; where half of the way is better, that is."""
    misfit, known, unknowns = GaussianMisfit(setup().images(FIDELITY)), setup(acquisition=turned(0.1)), [Bias()]
    start = starts(unknowns, known, misfit)
    right = refinement._lowered

    def further(factor):
        def lowered(nearby, parameters, step, misfit):
            found = right(nearby, parameters, step, misfit)
            return {name: part + factor * (found[name] - part) for name, part in start.items()}

        return lowered

    monkeypatch.setattr(refinement, "STEPS", 1)
    monkeypatch.setattr(refinement, "_lowered", further(-1.0))
    assert torch.equal(refined(unknowns, start, known, misfit, FIDELITY)["bias"], start["bias"])
    monkeypatch.setattr(refinement, "_lowered", further(3.0))
    moved = refined(unknowns, start, known, misfit, FIDELITY)["bias"] - start["bias"]
    torch.testing.assert_close(moved, torch.full((2,), -0.15), rtol=0, atol=0.02)


def test_a_step_is_of_limited_length():
    """Whatever the nearby images promise: fifteen of an unknown's own steps."""
    misfit = GaussianMisfit(torch.rand(2, 3, 24, 26) * 50)
    known = setup()
    start = starts([Bias(), Brightness()], known, misfit)
    found = refined([Bias(), Brightness()], start, known, misfit, FIDELITY)
    assert float((found["bias"] - start["bias"]).abs().max()) <= 15.001 * Bias().step
    assert float((found["brightness"] - start["brightness"]).abs().max()) == pytest.approx(15 * Brightness().step)


# brightness in closed form


def test_the_best_brightness_is_exact():
    data = setup(brightness=BRIGHTNESS).images(FIDELITY)
    found = best_brightness(setup().images(FIDELITY), GaussianMisfit(data))
    torch.testing.assert_close(found, BRIGHTNESS, rtol=1e-6, atol=0)


@pytest.mark.parametrize("noise", [None, NoiseModel(1e-3, 0.01)])
def test_the_best_brightness_is_the_minimum_of_a_gaussian_misfit(noise):
    data = setup(brightness=BRIGHTNESS).images(FIDELITY)
    data = (data + 0.02 * torch.randn(data.shape)).double()
    mask = torch.rand(data.shape) > 0.2
    misfit = GaussianMisfit(data, noise, mask)
    images = setup(dtype=torch.float64).images(FIDELITY)
    brightness = best_brightness(images, misfit).requires_grad_()
    (slope,) = torch.autograd.grad(misfit(images * brightness[..., None, None]), brightness)
    assert float(slope.abs().max()) < 1e-12


def test_an_image_without_a_pixel_that_counts_has_a_brightness_of_1():
    data = setup(brightness=BRIGHTNESS).images(FIDELITY)
    mask = torch.ones(data.shape, dtype=torch.bool)
    mask[0, 1] = False
    found = best_brightness(setup().images(FIDELITY), GaussianMisfit(data, mask=mask))
    assert float(found[0, 1]) == 1
    assert float(found[0, 0]) == pytest.approx(1.02, rel=1e-6)


# on another device


def test_refinement_goes_there_as_here():
    known = setup(acquisition=turned(), dtype=torch.float64, margin=3)
    unknowns = [Bias(), Brightness(), Drift(), FocusErrors(), ShearError()]
    data = setup(dtype=torch.float64, brightness=BRIGHTNESS, drift=DRIFT, margin=3).images(FIDELITY)
    misfit = GaussianMisfit(data)
    here = refined(unknowns, starts(unknowns, known, misfit), known, misfit, FIDELITY)
    lit = best_brightness(known.images(FIDELITY), misfit)
    with Device():
        volume = Volume(GRID, send(known.volume.delta), BACKGROUND)
        far, misfit = replace(known, volume=volume), GaussianMisfit(send(data))
        there = refined(unknowns, starts(unknowns, far, misfit), far, misfit, FIDELITY)
        lit_there = best_brightness(far.images(FIDELITY), misfit)
    torch.testing.assert_close(bring(lit_there), lit, rtol=1e-9, atol=1e-12)
    for name, value in there.items():
        torch.testing.assert_close(bring(value), here[name], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("method", "steps"), [pytest.param("newton", 4, marks=pytest.mark.slow), ("adam", 2)])
def test_a_descent_of_nuisances_goes_there_as_here(method, steps):
    known = setup(acquisition=turned(), dtype=torch.float64, margin=3)
    data = setup(dtype=torch.float64, brightness=BRIGHTNESS, drift=DRIFT, margin=3).images(FIDELITY)
    unknowns = [Bias(), Brightness(), Drift(), FocusErrors(), ShearError()]

    def descended(data):
        scene = replace(known, volume=empty_medium(GRID, BACKGROUND, data))
        delta = IndexDifference(5e-3, Bounds(), "linear")
        problem = Problem(scene, GaussianMisfit(data), [delta, *unknowns], [], GivenFidelity(FIDELITY), steps, method)
        *_, last = minimise(problem)
        return last.values

    here = descended(data)
    with Device():
        there = descended(send(data))
    for name, value in there.items():
        torch.testing.assert_close(bring(value), here[name], rtol=1e-6, atol=1e-9)


def test_what_is_known_of_a_drift_beforehand_pulls_it_to_zero():
    """Its first and second derivative are those of differences, and nothing else is pulled."""
    exact = setup(dtype=torch.float64, drift=DRIFT.double())
    misfit = GaussianMisfit(exact.images(FIDELITY))
    unknowns = [Brightness(), Drift()]
    here = {"brightness": BRIGHTNESS.double().log(), "drift": 0.5 * DRIFT.double()}
    objective = Beforehand(unknowns, misfit, unit=2e-3)
    second, first = objective.pull(here)
    toward = torch.randn(DRIFT.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    toward = toward - toward.mean((0, 1))
    scaled = torch.cat((torch.zeros(BRIGHTNESS.numel(), dtype=torch.float64), toward.flatten()))
    scale = refinement.SCALE * Drift().step

    def outside(steps):
        return objective(misfit.data, {**here, "drift": here["drift"] + steps * scale * toward})

    up, middle, down = outside(1e-3), outside(0.0), outside(-1e-3)
    assert (up - down) / 2e-3 == pytest.approx(float((first * scaled).sum()), rel=1e-6)
    assert (up - 2 * middle + down) / 1e-6 == pytest.approx(float((second * scaled**2).sum()), rel=1e-4)
    assert not first[: BRIGHTNESS.numel()].any()


def test_images_that_say_nothing_of_their_place_stay_where_they_are():
    """Noise alone is no drift: it stays within the width that a drift has beforehand."""
    faint = setup(acquisition=TRUE)
    faint = replace(faint, volume=Volume(GRID, 1e-3 * faint.volume.delta, BACKGROUND))
    with torch.no_grad():
        images = faint.images(FIDELITY)
    data = images + 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))
    found = repeated([Brightness(), Drift()], faint, GaussianMisfit(data), 1)
    assert float(found["drift"].abs().max()) < 0.01 * Drift.width
