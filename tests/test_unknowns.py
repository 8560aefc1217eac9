import math
from dataclasses import dataclass, replace

import pytest
import torch
from bit_for_bit import alike

from data_synthetic import GaussianBall
from recon.fit.bounds import Bounds
from recon.fit.descent import minimise
from recon.fit.nuisances.bias import Bias
from recon.fit.nuisances.drift import Drift
from recon.fit.nuisances.focus import FocusErrors
from recon.fit.nuisances.light import Brightness
from recon.fit.nuisances.shear import ShearError
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.fit.unknowns import IndexDifference, Unknown, Unknowns
from recon.misfit.gaussian import GaussianMisfit
from recon.report.metrics import volume_error
from recon.run import checkpoint
from recon.run.checkpoint import Checkpoint
from recon.run.room import _ample, held_beside_images
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
)
from torchdic.memory.held import course_of, most

BACKGROUND = 1.5
GRID = Grid((5, 14, 12), (0.5, 0.2, 0.21))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
FIDELITY = Fidelity(sources=6)
TRUE = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.2)], [-1.0, 0.0, 1.0])
OFF = math.radians(10)
DECLARED = Acquisition([replace(prism, bias=prism.bias + OFF) for prism in TRUE.prisms], TRUE.focus)


@dataclass(frozen=True)
class BiasOffset(Unknown):
    """What is added to the bias of every prism, rad: an unknown that the toolbox doesn't have, as a user adds one."""

    learning_rate: float
    name = "bias offset"

    def start(self, setup, misfit):
        return torch.zeros((), dtype=misfit.data.dtype)

    def put(self, value, setup):
        prisms = [replace(prism, bias=prism.bias + value) for prism in setup.acquisition.prisms]
        return replace(setup, acquisition=Acquisition(prisms, setup.acquisition.focus))


@pytest.fixture
def truth():
    return GaussianBall(0.5, 0.02, BACKGROUND, (0.3, -0.3, 0.4)).delta(GRID, dtype=torch.float32)


@pytest.fixture
def data(truth):
    with torch.no_grad():
        return image(Volume(GRID, truth, BACKGROUND), MICROSCOPE, TRUE, FIDELITY)


def problem(data, acquisition, *more, steps=40, method="adam"):
    """Δn, and more unknowns beside it, sought behind the data with an acquisition that may be wrong."""
    setup = Setup(empty_medium(GRID, BACKGROUND, data), MICROSCOPE, acquisition)
    recipe = Recipe(method, steps, start="zero", tv=(20.0, 5.0), prior="tv", draft_sources=None)
    made = Problem.from_recipe(data, setup, FIDELITY, recipe)
    return replace(made, unknowns=[made.unknowns[0], *more])


@pytest.fixture(params=["newton", "adam"])
def method(request):
    return request.param


NEWTON_SLOW = pytest.mark.parametrize("method", [pytest.param("newton", marks=pytest.mark.slow), "adam"])


@pytest.mark.slow
def test_a_bias_that_is_10_degrees_off_is_found_beside_the_volume(data, truth):
    *_, right = minimise(problem(data, TRUE))
    *_, wrong = minimise(problem(data, DECLARED))
    *_, learned = minimise(problem(data, DECLARED, BiasOffset(0.05)))
    assert learned.values["bias offset"].item() == pytest.approx(-OFF, abs=math.radians(0.5))
    assert volume_error(wrong.delta, truth) > 2 * volume_error(right.delta, truth)
    assert volume_error(learned.delta, truth) < 1.05 * volume_error(right.delta, truth)


def test_each_unknown_has_its_own_learning_rate(data):
    """Adam's first step is as long as the learning rate."""
    step = next(minimise(problem(data, DECLARED, BiasOffset(0.05))))
    assert step.values["bias offset"].item() == pytest.approx(-0.05, rel=1e-3)
    start = Bounds().parameter(torch.zeros(GRID.shape), margin=1e-3)
    moved = (step.state["delta"]["parameter"] - start).abs()
    assert moved.max().item() == pytest.approx(5e-3, rel=1e-3)


def test_a_descent_of_two_unknowns_goes_on_from_disk_bit_for_bit(data, tmp_path):
    two = problem(data, DECLARED, BiasOffset(0.05), steps=10)
    steps = list(minimise(two))
    for step in steps[3], steps[7]:
        checkpoint.save(tmp_path / "checkpoint.pt", Checkpoint(step, [], ""))
        again = checkpoint.load(tmp_path / "checkpoint.pt", "").step
        assert alike(again, step)
        rest = list(minimise(two, again))
        assert len(rest) == 10 - step.number
        assert all(alike(a, b) for a, b in zip(rest, steps[step.number :], strict=True))


@NEWTON_SLOW
def test_a_problem_can_be_solved_again(data, method):
    two = problem(data, DECLARED, Bias(), steps=4, method=method)
    assert all(alike(a, b) for a, b in zip(minimise(two), minimise(two), strict=True))


def test_a_step_of_other_unknowns_is_refused_with_their_names(data, method):
    step = next(minimise(problem(data, DECLARED, method=method)))
    with pytest.raises(ValueError, match="the saved step has the unknowns delta, the descent has delta, bias"):
        next(minimise(problem(data, DECLARED, Bias(), method=method), step))


def test_newton_names_what_it_does_not_find(data):
    with pytest.raises(ValueError, match="finds Δn and nuisances, not bias offset; use method 'adam'"):
        next(minimise(problem(data, DECLARED, BiasOffset(0.05), method="newton")))
    alone = replace(problem(data, DECLARED, method="newton"), unknowns=[Bias()])
    with pytest.raises(ValueError, match="finds Δn, which is none of the unknowns; use method 'adam'"):
        next(minimise(alone))


@pytest.mark.parametrize(
    ("microscope", "acquisition", "law"),
    [
        (
            MICROSCOPE,
            Acquisition([Prism((0.0, 0.24), 0.0), Prism((0.24, 0.0), 2 * math.pi)]),
            r"have biases 0, 6\.28319",
        ),
        (replace(MICROSCOPE, condenser_prism=False), TRUE, r"a condenser prism, .* is false"),
        (
            replace(MICROSCOPE, polarisation=Polarisation(pupil=JonesPupil(retardance={4: (0.1, 0.0)}))),
            TRUE,
            r"can't hold microscope\.polarisation\.pupil",
        ),
    ],
    ids=["no bias", "no condenser prism", "pupil"],
)
def test_newton_names_the_linear_transfer_that_it_lacks(data, microscope, acquisition, law):
    data = data[: len(acquisition.prisms), : len(acquisition.focus)]
    setup = Setup(empty_medium(GRID, BACKGROUND, data), microscope, acquisition)
    problem = Problem.from_recipe(data, setup, FIDELITY, Recipe())
    with pytest.raises(ValueError, match=f"Newton's method needs .*{law}.*; use method 'adam'"):
        next(minimise(problem))


def test_one_prism_without_bias_is_explained_beside_another(data, truth):
    """An image without bias has no linear response; the others' Hessian serves it as well."""
    acquisition = Acquisition([Prism((0.0, 0.24), 0.0), TRUE.prisms[1]], TRUE.focus)
    with torch.no_grad():
        data = image(Volume(GRID, truth, BACKGROUND), MICROSCOPE, acquisition, FIDELITY)
    setup = Setup(empty_medium(GRID, BACKGROUND, data), MICROSCOPE, acquisition)
    *_, last = minimise(Problem.from_recipe(data, setup, FIDELITY, Recipe()))
    assert last.misfit < 0.1


def test_two_unknowns_of_one_name_are_refused(data):
    with pytest.raises(ValueError, match="two unknowns share a name: delta, bias offset, bias offset"):
        problem(data, DECLARED, BiasOffset(0.05), BiasOffset(0.03))


def test_the_bias_alone_is_found_where_the_volume_is_known(data, truth):
    setup = Setup(Volume(GRID, truth, BACKGROUND), MICROSCOPE, DECLARED)
    known = replace(problem(data, DECLARED), setup=setup, unknowns=[BiasOffset(0.05)], priors=[])
    *_, last = minimise(known)
    assert last.values["bias offset"].item() == pytest.approx(-OFF, abs=math.radians(0.5))
    assert torch.equal(last.delta, truth)
    assert last.misfit < 0.01


def test_values_are_put_where_they_belong_and_keep_their_graph(data):
    two = problem(data, DECLARED, BiasOffset(0.05))
    unknowns = Unknowns.at_start(two.unknowns, two.setup, two.misfit)
    put = unknowns.into(two.setup)
    volume, microscope, acquisition = put.volume, put.microscope, put.acquisition
    assert volume.delta.requires_grad
    assert torch.equal(volume.delta.detach(), unknowns.values()["delta"])
    assert microscope is MICROSCOPE
    assert [float(prism.bias.detach()) for prism in acquisition.prisms] == pytest.approx(
        [prism.bias for prism in DECLARED.prisms]
    )
    assert not any(value.requires_grad for value in unknowns.values().values())


def test_a_known_absorption_stays_where_delta_is_put(data):
    absorption = torch.full(GRID.shape, 1e-3)
    setup = Setup(Volume(GRID, torch.zeros(GRID.shape), BACKGROUND, absorption), MICROSCOPE, TRUE)
    unknown = IndexDifference(5e-3, Bounds(), "zero")
    delta = unknown.value(unknown.start(setup, GaussianMisfit(data)))
    put = unknown.put(delta, setup).volume
    assert put.delta is delta
    assert torch.equal(put.absorption, absorption)
    assert float(put.background) == BACKGROUND


def test_an_empty_medium_takes_no_memory_for_its_voxels():
    medium = empty_medium(Grid((100, 100, 100), (0.5, 0.2, 0.2)), BACKGROUND, torch.zeros(1, dtype=torch.float64))
    assert medium.delta.untyped_storage().nbytes() == 8


# what is learned beside Δn


BRIGHTNESS = torch.tensor([[1.02, 0.985, 1.01], [0.98, 1.015, 0.99]])
DRIFT = torch.tensor([[[0.1, -0.06], [-0.04, 0.1], [-0.08, 0.0]], [[0.06, 0.05], [-0.1, -0.02], [0.06, -0.07]]])
NUISANCES = [Bias(), Brightness(), Drift(), FocusErrors(), ShearError()]


@NEWTON_SLOW
def test_bias_brightness_and_drift_are_learned_beside_the_volume(truth, method):
    known = Setup(Volume(GRID, truth, BACKGROUND), MICROSCOPE, TRUE, BRIGHTNESS, DRIFT)
    with torch.no_grad():
        data = known.images(FIDELITY)
    *_, wrong = minimise(problem(data, DECLARED, method=method))
    *_, learned = minimise(problem(data, DECLARED, Bias(), Brightness(), Drift(), steps=60, method=method))
    assert learned.misfit < 0.2 * wrong.misfit
    assert volume_error(learned.delta, truth) < 0.5 * volume_error(wrong.delta, truth)
    assert float((learned.values["bias"] - torch.tensor([1.5, -1.2])).abs().max()) < 0.25 * OFF
    assert float((learned.values["drift"] - DRIFT).abs().max()) < 0.04
    assert learned.values["brightness"].shape == (2, 3)


@NEWTON_SLOW
def test_a_descent_of_everything_goes_on_from_disk_bit_for_bit(data, tmp_path, method):
    everything = problem(data, DECLARED, *NUISANCES, steps=11 if method == "newton" else 6, method=method)
    steps = list(minimise(everything))
    assert set(steps[-1].values) == {"delta", "bias", "brightness", "drift", "focus", "shear"}
    for step in steps[0], steps[-4], steps[-3]:
        checkpoint.save(tmp_path / "checkpoint.pt", Checkpoint(step, [], ""))
        again = checkpoint.load(tmp_path / "checkpoint.pt", "").step
        assert alike(again, step)
        rest = list(minimise(everything, again))
        assert all(alike(a, b) for a, b in zip(rest, steps[step.number :], strict=True))


@pytest.mark.parametrize("unknown", NUISANCES, ids=lambda unknown: unknown.name)
def test_adams_first_step_is_as_long_as_the_nuisances_rate(unknown, data, truth):
    """Beside the true volume; the images of an empty one hardly change with it."""
    setup = Setup(Volume(GRID, truth, BACKGROUND), MICROSCOPE, DECLARED)
    alone = replace(problem(data, DECLARED), setup=setup, unknowns=[unknown], priors=[])
    parameter = next(minimise(alone)).state[unknown.name]["parameter"]
    moved = (parameter - unknown.start(setup, alone.misfit)).abs()
    assert float(moved.max()) == pytest.approx(unknown.learning_rate, rel=1e-3)


@NEWTON_SLOW
def test_a_volume_with_a_margin_descends(truth, method):
    """Data of the middle of the true volume; the wide one explains them, beside a drift."""
    wide = Setup(Volume(GRID, truth, BACKGROUND), MICROSCOPE, TRUE, drift=DRIFT, margin=2)
    with torch.no_grad():
        data = wide.images(FIDELITY)
    setup = replace(wide, volume=empty_medium(GRID, BACKGROUND, data), drift=None)
    given = {"tv": (20.0, 5.0), "prior": "tv"} if method == "adam" else {}
    recipe = Recipe(method, 40, start="linear", draft_sources=None, **given)
    made = Problem.from_recipe(data, setup, FIDELITY, recipe)
    *_, last = minimise(replace(made, unknowns=[*made.unknowns, Drift()]))
    assert last.delta.shape == GRID.shape
    assert last.misfit < 0.1
    assert float((last.values["drift"] - DRIFT).abs().max()) < 0.05


def test_room_is_found_for_what_drift_and_brightness_hold(data):
    """More than Δn alone asks for; nothing but few numbers for those of the prisms."""
    alone = problem(data, DECLARED)
    held = {
        names: held_beside_images(problem(data, DECLARED, *more), GaussianMisfit, FIDELITY)
        for names, more in (("drift", [Brightness(), Drift()]), ("bias", [Bias()]))
    }
    without = held_beside_images(alone, GaussianMisfit, FIDELITY)
    # an image's spectrum, 8 bytes for half the pixels of each image, at the least
    assert held["drift"] >= without + 8 * data.numel() // 2
    assert held["bias"] == pytest.approx(without, abs=4096)


@NEWTON_SLOW
def test_the_sample_of_a_descent_holds_what_its_later_steps_hold(truth, method):
    """The room is measured on few pixels and in few steps; here it is held to all of a longer descent."""
    grid, fidelity = Grid((5, 48, 44), (0.5, 0.2, 0.21)), Fidelity(sources=1, padding=2)
    points, weights = MICROSCOPE.sources(1, dtype=torch.float64)
    microscope = MICROSCOPE.lit_from(points, weights)
    with torch.no_grad():
        delta = GaussianBall(1.0, 0.02, BACKGROUND).delta(grid, dtype=torch.float32)
        data = image(Volume(grid, delta, BACKGROUND), microscope, TRUE, fidelity)
    setup = Setup(empty_medium(grid, BACKGROUND, data), microscope, TRUE)
    made = Problem.from_recipe(data, setup, fidelity, Recipe(method, steps=18))

    def descend():
        last = None
        for step in minimise(made):
            last = step
        del last

    def compute():
        learned = torch.zeros(grid.shape, requires_grad=True)
        image(Volume(grid, learned, BACKGROUND), microscope, TRUE, fidelity).sum().backward()

    whole = most(course_of(descend))
    found = held_beside_images(made, GaussianMisfit, fidelity) + most(course_of(compute))
    assert 0.95 * whole < found < 1.5 * whole
    assert whole < _ample(made.setup)


@NEWTON_SLOW
def test_room_is_found_for_a_problem_with_a_margin(data, method):
    made = problem(data, TRUE, method=method)
    setup = replace(made.setup, volume=empty_medium(GRID.widened(3, 3), BACKGROUND, data), margin=3)
    wide = held_beside_images(replace(made, setup=setup), GaussianMisfit, FIDELITY)
    assert wide > held_beside_images(made, GaussianMisfit, FIDELITY)
