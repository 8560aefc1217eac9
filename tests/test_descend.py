import copy
import dataclasses
import itertools
import math

import pytest
import torch
from absolute import Absolute
from bit_for_bit import alike

from data_synthetic import GaussianBall
from recon.fit.bounds import Bounds
from recon.fit.descent import descend, minimise
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.fit.unknowns import with_values
from recon.prior.edges import total_variation
from recon.report.metrics import mean_inside, residual_rms, volume_error
from recon.run import checkpoint
from recon.run.checkpoint import Checkpoint, CheckpointError
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BACKGROUND = 1.5
GRID = Grid((6, 16, 14), (0.5, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
TWO_SHEARS = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.2)], [-1.0, 0.0, 1.0])
FIDELITY = Fidelity(sources=6)
ADAM = Recipe(method="adam", steps=12, tv=(20.0, 5.0), prior="tv")
NEWTON = Recipe(steps=12)
METHODS = {"newton": NEWTON, "adam": ADAM}
# for laws that Adam's descent is held to in less time; test_newton holds Newton's to its own
NEWTON_SLOW = pytest.mark.parametrize("recipe", [pytest.param("newton", marks=pytest.mark.slow), "adam"], indirect=True)


@pytest.fixture(params=METHODS)
def recipe(request):
    """A recipe of each method."""
    return METHODS[request.param]


@pytest.fixture(scope="module")
def truth():
    """A ball off the centre along every axis."""
    return GaussianBall(0.5, 0.02, BACKGROUND, (0.3, -0.5, 0.4)).delta(GRID, dtype=torch.float32)


def seen(truth, acquisition=TWO_SHEARS, fidelity=FIDELITY):
    with torch.no_grad():
        return image(Volume(GRID, truth, BACKGROUND), MICROSCOPE, acquisition, fidelity)


def run(data, recipe, acquisition=TWO_SHEARS, fidelity=FIDELITY, resume=None):
    return list(descend(data, GRID, BACKGROUND, MICROSCOPE, acquisition, fidelity, recipe, resume))


@pytest.fixture(scope="module")
def descended(truth):
    """A function from a recipe to the steps of its run, made once."""
    done = {}

    def steps(recipe):
        name = next(name for name, one in METHODS.items() if one == recipe)
        if name not in done:
            done[name] = run(seen(truth), recipe)
        return done[name]

    return steps


# the descent


def test_the_misfit_falls_fiftyfold_and_the_error_with_it(truth):
    steps = run(seen(truth), Recipe("adam", 60, start="zero", tv=(100.0, 10.0), l1=1.0, prior="tv"))
    assert steps[0].misfit > 0.5  # the volume before the first step is nearly empty
    assert steps[-1].misfit < 0.02 * steps[0].misfit
    errors = [volume_error(step.delta, truth) for step in steps]
    assert errors[0] > 0.75
    assert errors[-1] < 0.6  # these few planes leave the ball blurred along z
    for axis in range(3):
        assert volume_error(steps[-1].delta.flip(axis), truth) > errors[-1] + 0.2


def test_newtons_misfit_falls_fiftyfold_in_few_steps(truth):
    steps = run(seen(truth), Recipe())
    assert steps[0].misfit == pytest.approx(1, rel=0.02)
    assert steps[-1].misfit < 0.02 * steps[0].misfit
    assert volume_error(steps[-1].delta, truth) < 0.4
    for axis in range(3):
        assert volume_error(steps[-1].delta.flip(axis), truth) > volume_error(steps[-1].delta, truth) + 0.2


@pytest.mark.slow  # test_newton holds it to the same
def test_newton_leaves_what_the_noise_leaves(truth):
    """The misfit of noise that it measured itself, neither far more nor less."""
    data = seen(truth)
    data = data + 0.02 * data.std() * torch.randn(data.shape)
    steps = run(data, Recipe(steps=30))
    noise = Problem.from_recipe(
        data, Setup(empty_medium(GRID, BACKGROUND, data), MICROSCOPE, TWO_SHEARS), FIDELITY, Recipe()
    )
    assert noise.weight is not None
    assert steps[-1].misfit == pytest.approx(noise.weight.noise_misfit, rel=0.3)


def test_the_linear_start_is_ahead_of_an_empty_one(truth):
    linear, zero = (run(seen(truth), dataclasses.replace(ADAM, start=s, steps=1))[0] for s in ("linear", "zero"))
    assert linear.misfit < 0.3 * zero.misfit


@pytest.mark.parametrize(
    ("propagation", "method"),
    [
        pytest.param(propagation, method, marks=() if (propagation, method) in fast else pytest.mark.slow)
        for fast in [{("projection", "newton"), ("wave", "adam")}]
        for propagation in ("projection", "rays", "wave")
        for method in METHODS
    ],
)
def test_each_propagation_descends_on_its_own_images(truth, propagation, method):
    recipe = Recipe() if method == "newton" else Recipe("adam", 25, start="zero", tv=(60.0, 5.0), prior="tv")
    fidelity = Fidelity(propagation, sources=4)
    steps = run(seen(truth, fidelity=fidelity), recipe, fidelity=fidelity)
    assert steps[-1].misfit < 0.2 * steps[0].misfit
    # the sum along z: where it lies along z, a projection leaves open
    first, last = (
        volume_error(delta.sum(0, keepdim=True), truth.sum(0, keepdim=True))
        for delta in (torch.zeros_like(truth), steps[-1].delta)
    )
    assert last < 0.6 * first
    assert steps[-1].delta.dtype == torch.float32


@pytest.mark.parametrize(
    "acquisition",
    [
        Acquisition([Prism((0.1, 0.2), 1.5)], [0.0]),
        Acquisition([None], [-1.0, 0.5]),
        Acquisition([Prism((0.24, 0.0), -1.0), None], [0.5, -0.5]),
        Acquisition([Prism((0.24, 0.0), -2.5), Prism((0.0, -0.24), -0.8)], [0.2]),
    ],
    ids=["one image", "bright field", "both", "negative bias"],
)
@NEWTON_SLOW
def test_any_acquisition_descends(truth, acquisition, recipe):
    data = seen(truth, acquisition)
    steps = run(data, dataclasses.replace(recipe, start="zero"), acquisition)
    assert steps[-1].misfit < 0.6 * steps[0].misfit
    assert float((steps[-1].delta * truth).sum()) > 0


@NEWTON_SLOW
def test_steps_are_numbered_from_1_and_time_goes_on(descended, recipe):
    steps = descended(recipe)
    assert [step.number for step in steps] == list(range(1, 13))
    assert all(0 < a.seconds < b.seconds for a, b in itertools.pairwise(steps))


@pytest.mark.parametrize(
    ("recipe", "bounds"),
    [
        pytest.param(method, bounds, id=f"{method}-{name}", marks=pytest.mark.slow if name in slow else ())
        for method, slow in (("newton", ("none", "both")), ("adam", ()))
        for name, bounds in {"0": Bounds(), "none": Bounds(None, None), "both": Bounds(-0.1, 0.1)}.items()
    ],
    indirect=["recipe"],
)
def test_what_a_step_holds_does_not_change_any_more(truth, bounds, recipe):
    recipe = dataclasses.replace(recipe, bounds=bounds)
    steps, copies = [], []
    for step in descend(seen(truth), GRID, BACKGROUND, MICROSCOPE, TWO_SHEARS, FIDELITY, recipe):
        steps.append(step)
        copies.append(copy.deepcopy(step))
    assert all(alike(step, copy) for step, copy in zip(steps, copies, strict=True))
    assert not torch.equal(steps[0].delta, steps[1].delta)
    assert not steps[-1].delta.requires_grad
    assert not steps[-1].state["delta"]["parameter"].requires_grad


def test_a_step_s_delta_is_its_parameters(descended):
    step = descended(ADAM)[-1]
    assert torch.equal(step.delta, ADAM.bounds.delta(step.state["delta"]["parameter"]))
    assert torch.equal(step.delta, step.values["delta"])


def test_delta_stays_within_its_bounds(truth, recipe):
    recipe = dataclasses.replace(recipe, bounds=Bounds(-0.001, 0.01), learning_rate=0.05)
    for step in run(seen(truth), recipe):
        assert float(step.delta.min()) >= -0.001 - 1e-8
        assert float(step.delta.max()) <= 0.01 + 1e-8


@pytest.mark.parametrize(("bounds", "error"), [(Bounds(None, None), 0.75), (Bounds(None, 0.0), 0.55)])
@pytest.mark.parametrize(
    "given",
    [
        {},  # which test_newton holds to the same in make test
        {"method": "adam", "steps": 40, "learning_rate": 2e-3, "tv": (10.0, 10.0)},
    ],
)
@pytest.mark.slow
def test_a_negative_contrast_is_found_where_the_bounds_let_it(truth, bounds, error, given):
    recipe = Recipe(**given, bounds=bounds)
    assert volume_error(run(seen(-truth), recipe)[-1].delta, -truth) < error
    assert volume_error(run(seen(-truth), Recipe(**given))[-1].delta, -truth) > 0.95  # the default ones do not


@NEWTON_SLOW
def test_another_misfit_is_lowered_in_its_own_measure(truth, recipe):
    data, fidelity = seen(truth), Fidelity(sources=6, order=1)  # which Newton's method asks for at each step
    setup = Setup(empty_medium(GRID, BACKGROUND, data), MICROSCOPE, TWO_SHEARS)
    recipe = dataclasses.replace(recipe, steps=30, draft_sources=None)
    problem = Problem.from_recipe(data, setup, fidelity, recipe, Absolute)
    steps = list(minimise(problem))
    assert steps[-1].misfit < 0.4 * steps[0].misfit
    for before, after in itertools.pairwise(steps):  # a step's misfit is that of the volume before it
        images = with_values(problem.unknowns, before.values, setup).images(fidelity)
        assert after.misfit == pytest.approx(Absolute(data)(images).item(), rel=1e-5)


@NEWTON_SLOW
def test_more_total_variation_leaves_less_of_it(truth, recipe):
    data = seen(truth) + 0.01 * torch.randn(2, 3, 16, 14)
    recipe = dataclasses.replace(recipe, prior="tv", l1=0.5)
    rough, smooth = (run(data, dataclasses.replace(recipe, tv=(w, w)))[-1].delta for w in (0.0, 100.0))
    assert total_variation(smooth, GRID.spacing) < 0.5 * total_variation(rough, GRID.spacing)


@NEWTON_SLOW
def test_l1_pulls_an_invisible_uniform_index_down(truth, recipe):
    recipe = dataclasses.replace(recipe, tv=(20.0, 5.0), steps=25)
    free, held = (run(seen(truth), dataclasses.replace(recipe, l1=w))[-1].delta.mean() for w in (0.0, 100.0))
    assert float(held) < 0.9 * float(free)


def test_draft_sources_serve_the_first_60_percent_only(truth, descended):
    data = seen(truth)
    recipe = dataclasses.replace(ADAM, draft_sources=3)
    drafted, few, all_ = run(data, recipe), run(data, recipe, fidelity=Fidelity(sources=3)), descended(ADAM)
    # 12 steps: numbers 1 to 8 (0 … 7 < 7.2) are drafts
    assert all(alike(a, b) for a, b in zip(drafted[:8], few[:8], strict=True))
    assert drafted[8].misfit != few[8].misfit
    assert drafted[0].misfit != all_[0].misfit
    (again,) = run(data, dataclasses.replace(ADAM, draft_sources=3, steps=9), resume=drafted[7])
    expected = run(data, dataclasses.replace(ADAM, draft_sources=None, steps=9), resume=drafted[7])
    assert alike(again, expected[0])


@pytest.mark.slow
def test_newtons_drafts_are_corrected_to_the_images_of_all_directions(truth):
    """Where it ends, the misfit is that of careful images, though its steps see few directions."""
    fidelity = Fidelity(sources=40, padding=3)
    data = seen(truth, fidelity=fidelity)
    recipe = Recipe(draft_sources=10, steps=25)
    steps = run(data, recipe, fidelity=fidelity)
    setup = Setup(empty_medium(GRID, BACKGROUND, data), MICROSCOPE, TWO_SHEARS)
    problem = Problem.from_recipe(data, setup, fidelity, recipe)
    last, before = steps[-1], steps[-2]

    def misfit(step, careful):
        return float(problem.misfit(with_values(problem.unknowns, step.values, setup).images(careful)))

    # a thousandth counts as noise where there is none, and a correction may be off by a tenth of it
    assert last.misfit == pytest.approx(misfit(before, fidelity), abs=1e-4)
    assert misfit(before, Fidelity(sources=10)) > 1.5 * last.misfit


def test_float64_data_make_a_float64_volume(truth, recipe):
    data = seen(truth).double()
    step = run(data, dataclasses.replace(recipe, steps=2))[-1]
    assert step.delta.dtype == torch.float64
    single = run(data.float(), dataclasses.replace(recipe, steps=2))[-1]
    assert volume_error(single.delta.double(), step.delta) < 0.05


def test_one_slice_descends(truth, recipe):
    grid = Grid((1, 16, 14), (0.5, 0.2, 0.2))
    acquisition = Acquisition([Prism((0.0, 0.24), 1.5)], [0.0])
    delta = truth[3:4]
    with torch.no_grad():
        data = image(Volume(grid, delta, BACKGROUND), MICROSCOPE, acquisition, FIDELITY)
    *_, step = descend(data, grid, BACKGROUND, MICROSCOPE, acquisition, FIDELITY, recipe)
    assert step.misfit < 0.1


@pytest.mark.parametrize("shape", [(2, 3, 14, 16), (1, 3, 16, 14), (2, 2, 16, 14), (3, 2, 16, 14)])
def test_data_of_another_shape_are_refused_with_both_shapes(shape, recipe):
    with pytest.raises(ValueError, match=r"\(2, 3, 16, 14\)") as caught:
        run(torch.rand(shape), recipe)
    assert str(tuple(shape)) in str(caught.value)


def test_uniform_data_are_refused(recipe):
    with pytest.raises(ValueError, match="uniform"):
        run(torch.full((2, 3, 16, 14), 0.5), recipe)


@pytest.mark.parametrize("rate", [1e3, 1e30])
@pytest.mark.parametrize("bounds", [Bounds(), Bounds(None, None), Bounds(-3.0, None)], ids=["0", "none", "below 0"])
def test_a_descent_that_diverges_says_at_which_step(truth, rate, bounds):
    recipe = dataclasses.replace(ADAM, learning_rate=rate, bounds=bounds)
    with pytest.raises(FloatingPointError, match=r"diverged at step \d+: (the loss is|the index falls to|slabs of)"):
        run(seen(truth), recipe)


def test_a_volume_whose_index_is_below_0_is_no_start(truth, recipe):
    recipe = dataclasses.replace(recipe, start="zero", bounds=Bounds(-3.0, -2.0))
    with pytest.raises(ValueError, match=r"index -0\.5\S* = background 1\.5 \+ delta must stay above 0"):
        run(seen(truth), recipe)


@pytest.mark.parametrize(
    "bounds", [Bounds(None, None), pytest.param(Bounds(-3.0, 3.0), marks=pytest.mark.slow)], ids=["none", "wide"]
)
def test_newton_takes_no_step_that_has_no_images(truth, bounds):
    """Data far brighter than any specimen makes: every long step is taken back, and the misfit never rises for it."""
    data = seen(truth)
    data = data.mean() + 300 * (data - data.mean())
    steps = run(data, Recipe(steps=15, bounds=bounds))
    assert all(bool(torch.isfinite(step.delta).all()) for step in steps)
    assert min(BACKGROUND + float(step.delta.min()) for step in steps) > 0
    assert steps[-1].misfit < steps[0].misfit


def test_data_that_are_not_finite_do_not_pass_as_a_fit(truth, recipe):
    data = seen(truth)
    data[0, 0, 3, 3] = torch.nan
    with pytest.raises((FloatingPointError, ValueError)):
        run(data, recipe)


@pytest.mark.parametrize(
    ("values", "law"),
    [
        ({"steps": 0}, "steps 0 must be at least 1"),
        ({"learning_rate": 0.0}, "learning_rate 0.0 must be above 0"),
        ({"learning_rate": math.nan}, "learning_rate nan must be above 0"),
        ({"tv": (-1.0, 1.0)}, "tv -1.0 must be at least 0"),
        ({"tv": (1.0, math.inf)}, "tv inf must be at least 0"),
        ({"l1": -0.1}, "l1 -0.1 must be at least 0"),
        ({"draft_sources": 0}, "draft_sources 0 must be at least 1"),
        (
            {"learn": ("colour",)},
            "learn 'colour' must be one of 'brightness', 'bias', 'drift', 'lamp', 'focus', 'shear'",
        ),
        ({"learn": ("bias", "bias")}, r"learn \['bias', 'bias'\] names one twice"),
    ],
)
def test_an_unphysical_recipe_is_refused(values, law):
    with pytest.raises(ValueError, match=law):
        Recipe(**values)


# going on after an interruption


@pytest.mark.parametrize(
    "sources", [pytest.param(3, marks=pytest.mark.slow), 4, None], ids="{} draft directions".format
)
@NEWTON_SLOW
def test_resuming_from_any_step_ends_where_an_uninterrupted_run_does(truth, recipe, sources):
    data = seen(truth)
    recipe = dataclasses.replace(recipe, steps=14 if recipe.method == "newton" else 8, draft_sources=sources)
    steps = run(data, recipe)
    for k, step in enumerate(steps):
        rest = run(data, recipe, resume=step)
        assert len(rest) == len(steps) - 1 - k
        assert all(alike(a, b) for a, b in zip(rest, steps[k + 1 :], strict=True))


@pytest.mark.slow
def test_newton_ends_by_itself_and_does_not_go_on_afterwards(truth):
    data = seen(truth) + 0.01 * torch.randn(2, 3, 16, 14)
    recipe = dataclasses.replace(NEWTON, steps=200)
    steps = run(data, recipe)
    assert len(steps) < 200
    assert run(data, recipe, resume=steps[-1]) == []


@pytest.mark.parametrize(("one", "other"), [(NEWTON, ADAM), (ADAM, NEWTON)], ids=["adam's", "newton's"])
def test_a_step_of_another_method_is_refused(truth, one, other):
    step = run(seen(truth), dataclasses.replace(other, steps=1))[-1]
    with pytest.raises(ValueError, match=r"the saved step (is none of Newton's method|has the unknowns)"):
        run(seen(truth), one, resume=step)


@NEWTON_SLOW
def test_two_runs_are_bit_for_bit_the_same(truth, descended, recipe):
    one, other = descended(recipe), run(seen(truth), recipe)
    assert all(alike(a, b) for a, b in zip(one, other, strict=True))


@NEWTON_SLOW
def test_resuming_counts_the_seconds_on(truth, descended, recipe):
    steps = descended(recipe)
    late = dataclasses.replace(steps[5], seconds=1000.0)
    assert run(seen(truth), recipe, resume=late)[0].seconds > 1000


@NEWTON_SLOW
def test_resuming_leaves_the_step_that_it_went_on_from_alone(truth, descended, recipe):
    steps = descended(recipe)
    before = copy.deepcopy(steps[4])
    run(seen(truth), recipe, resume=steps[4])
    assert alike(steps[4], before)


@pytest.fixture
def saved(truth, tmp_path, descended, recipe):
    """A checkpoint of step 5 on disk: (path, data, all steps)."""
    data, steps = seen(truth), descended(recipe)
    rows = [(s.number, s.misfit, s.loss, s.seconds) for s in steps[:5]]
    path = tmp_path / "checkpoint.pt"
    checkpoint.save(path, Checkpoint(steps[4], rows, "volume.shape = [6, 16, 14]\ndata's sha256 = abc"))
    return path, data, steps


def test_a_checkpoint_from_disk_ends_where_an_uninterrupted_run_does(saved, recipe):
    path, data, steps = saved
    again = checkpoint.load(path, "volume.shape = [6, 16, 14]\ndata's sha256 = abc")
    assert alike(again.step, steps[4])
    assert again.step.seconds == steps[4].seconds
    assert again.rows == [(s.number, s.misfit, s.loss, s.seconds) for s in steps[:5]]
    rest = run(data, recipe, resume=again.step)
    assert all(alike(a, b) for a, b in zip(rest, steps[5:], strict=True))


@pytest.mark.parametrize(
    ("identity", "named"),
    [
        ("volume.shape = [6, 16, 16]\ndata's sha256 = abc", "volume.shape was [6, 16, 14], is [6, 16, 16]"),
        ("volume.shape = [6, 16, 14]\ndata's sha256 = 012", "data's sha256 was abc, is 012"),
        ("volume.shape = [6, 16, 14]", "data's sha256 was abc, is absent"),
        ("volume.shape = [6, 16, 14]\ndata's sha256 = abc\nfidelity.steps = 3", "fidelity.steps was absent, is 3"),
    ],
)
@NEWTON_SLOW
def test_a_checkpoint_of_another_run_is_refused_with_what_changed(saved, identity, named):
    path, _, _ = saved
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load(path, identity)
    message = str(caught.value)
    assert str(path) in message
    assert named in message
    assert "\n" not in message


@pytest.mark.parametrize("content", [b"", b"no checkpoint", None], ids=["empty", "text", "truncated"])
@NEWTON_SLOW
def test_a_damaged_checkpoint_is_refused_in_one_line(saved, content):
    path, _, _ = saved
    path.write_bytes(path.read_bytes()[:-500] if content is None else content)
    with pytest.raises(CheckpointError) as caught:
        checkpoint.load(path, "")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    path = tmp_path / "checkpoint.pt"
    torch.save({"weights": torch.zeros(3)}, path)
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt: is no checkpoint of this version"):
        checkpoint.load(path, "")


@NEWTON_SLOW
def test_a_checkpoint_of_an_earlier_version_is_refused_in_one_line(saved):
    """One that holds the learned tensor and Adam's own state, as they were saved before unknowns had names."""
    path, _, steps = saved
    parameter = torch.zeros(GRID.shape, requires_grad=True)
    step = {"number": 5, "misfit": 0.5, "loss": 0.6, "delta": steps[4].delta, "seconds": 1.0, "plans": ()}
    step |= {"parameter": parameter.detach(), "optimiser": torch.optim.Adam([parameter]).state_dict()}
    identity = "volume.shape = [6, 16, 14]\ndata's sha256 = abc"
    torch.save({"step": step, "rows": [(5, 0.5, 0.6, 1.0)], "identity": identity}, path)
    with pytest.raises(CheckpointError, match="is a checkpoint of an earlier version") as caught:
        checkpoint.load(path, identity)
    assert str(path) in str(caught.value)
    assert "--restart" in str(caught.value)
    assert "\n" not in str(caught.value)


@NEWTON_SLOW
def test_a_checkpoint_that_fails_to_be_written_leaves_the_earlier_one(saved, monkeypatch):
    path, _, steps = saved
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", fail)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(path, Checkpoint(steps[7], [], ""))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["checkpoint.pt"]


# metrics


def test_an_empty_volumes_error_is_1_and_the_truths_0(truth):
    assert volume_error(torch.zeros_like(truth), truth) == 1
    assert volume_error(truth, truth) == 0
    assert volume_error(1.2 * truth, truth) == pytest.approx(0.2, rel=1e-5)


def test_the_mean_inside_is_over_the_region_alone():
    delta = torch.tensor([[[1.0, 2.0, 9.0]]])
    assert mean_inside(delta, torch.tensor([[[True, True, False]]])) == 1.5


def test_each_prism_has_its_own_residual():
    images = torch.zeros(2, 3, 4, 5)
    data = torch.stack([torch.full((3, 4, 5), 0.1), torch.full((3, 4, 5), -0.2)])
    assert residual_rms(images, data) == pytest.approx([0.1, 0.2])
