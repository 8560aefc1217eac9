"""The proximal Newton descent."""

import copy
import functools
import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from bit_for_bit import alike
from distant import DISTANT, Device, bring, send

from recon.fit.bounds import Bounds
from recon.fit.descent import minimise
from recon.fit.newton.correction import REST, Correction, drafts
from recon.fit.newton.descent import COARSE_STEPS, CREEP, _Descent, expected_misled, minimise_by_newton
from recon.fit.nuisances.light import Brightness
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.fit.unknowns import IndexDifference, Unknown
from recon.misfit.gaussian import GaussianMisfit
from recon.misfit.poisson import PoissonMisfit
from recon.misfit.robust import RobustMisfit
from recon.prior.base import Prior
from recon.recording.noise import NoiseModel
from recon.report.metrics import volume_error
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume
from torchdic.errors import UnstableError

BACKGROUND = 1.5
GRID = Grid((8, 20, 18), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.2)], [-1.2, 0.0, 1.2])
FIDELITY = Fidelity(sources=8)
SLOW = pytest.mark.slow
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")


def bead(delta=0.02, grid=GRID, centre=(0.2, -0.2, 0.3), radius=0.8, dtype=torch.float32):
    """A sphere of sharp edge, but for a part of a voxel."""
    z, y, x = (
        (torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * d for n, d in zip(grid.shape, grid.spacing, strict=True)
    )
    distance = ((z[:, None, None] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 + (x - centre[2]) ** 2).sqrt()
    return (delta * torch.sigmoid((radius - distance) / 0.05)).to(dtype)


def setup_of(delta, **parts):
    """What is recorded of a Δn; `parts` of the setup, or of the grid, the microscope and the acquisition."""
    given = {"microscope": MICROSCOPE, "acquisition": ACQUISITION} | parts
    grid = given.pop("grid", GRID)
    return Setup(Volume(grid, delta, BACKGROUND), **given)


def recorded(setup, noise=0.0, fidelity=FIDELITY, seed=0):
    """Images with normal noise of this part of their contrast, and the noise's standard deviation in each prism."""
    with torch.no_grad():
        images = setup.images(fidelity)
    level = noise * float(images.var(dim=(2, 3)).mean().sqrt())
    drawn = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return images + level * drawn.to(images), [level] * len(images)


def known(setup):
    """The setup without its specimen and its recording's faults, as a fit begins with."""
    volume = empty_medium(setup.volume.grid, BACKGROUND, setup.volume.delta)
    return replace(setup, volume=volume, brightness=None, drift=None)


def problem_of(data, setup, recipe=None, fidelity=FIDELITY, misfit=GaussianMisfit, noise=None):
    return Problem.from_recipe(data, known(setup), fidelity, recipe or Recipe(), misfit, noise)


def fitted(data, setup, recipe=None, fidelity=FIDELITY, **others):
    return list(minimise(problem_of(data, setup, recipe, fidelity, **others)))


def error(steps, delta):
    return volume_error(steps[-1].delta, delta)


@pytest.fixture(scope="module")
def scene():
    """A bead, its setup, and images with noise of 0.3 of their contrast."""
    delta = bead()
    setup = setup_of(delta)
    data, noise = recorded(setup, 0.3)
    return delta, setup, data, noise


@pytest.fixture(scope="module")
def plain(scene):
    """The steps of the default recipe."""
    _, setup, data, _ = scene
    return fitted(data, setup)


# what it finds


def test_from_nothing_it_finds_a_bead(scene, plain):
    delta, _, _, _ = scene
    assert plain[0].misfit > 0.95
    assert error(plain, delta) < 0.3
    assert float(plain[-1].delta.max()) == pytest.approx(0.02, rel=0.2)
    for axis in range(3):
        assert volume_error(plain[-1].delta.flip(axis), delta) > error(plain, delta) + 0.1


@pytest.mark.parametrize("height", [pytest.param(0.002, marks=SLOW), pytest.param(0.06, marks=SLOW), 0.1])
def test_it_converges_on_weak_and_on_strong_beads(height):
    delta = bead(height)
    setup = setup_of(delta)
    data, _ = recorded(setup, 0.1)
    steps = fitted(data, setup)
    assert error(steps, delta) < 0.4
    assert steps[-1].misfit < 0.03
    assert max(step.misfit for step in steps) <= steps[0].misfit


@pytest.mark.parametrize(
    ("prior", "height"),
    [
        pytest.param("log-tv", 0.1, marks=SLOW),
        ("tv", 0.1),
        ("smooth", 0.02),
        *(pytest.param(*case, marks=SLOW) for case in (("log-tv", 0.02), ("tv", 0.02), ("smooth", 0.1))),
    ],
)
def test_the_objective_of_a_given_weight_never_rises(prior, height):
    """But where a prior learns the contrast, in the first steps with it, and where careful images correct others."""
    setup = setup_of(bead(height))
    data, _ = recorded(setup, 0.2)
    weight = 0.5 / height
    recipe = Recipe(tv=(weight, weight), l1=weight / 4, prior=prior, steps=20)
    losses = [step.loss for step in fitted(data, setup, recipe, replace(FIDELITY, order=1))]
    settled = losses if prior == "tv" else losses[14:]
    assert all(after <= before * (1 + 1e-6) for before, after in pairwise(settled))
    assert losses[-1] < 0.3 * losses[0]


@SLOW
def test_a_step_that_careful_images_call_worse_is_taken_back():
    """Two directions mislead at a Δn of 0.2: without the law the objective rises by 3 % in a step."""
    setup, careful = setup_of(bead(0.2)), replace(FIDELITY, sources=48)
    data, _ = recorded(setup, 0.05, careful)
    recipe = Recipe(tv=(10.0, 10.0), l1=2.5, prior="tv", steps=24, draft_sources=2)
    losses = [step.loss for step in fitted(data, setup, recipe, careful)]
    assert all(after <= before * (1 + CREEP) for before, after in pairwise(losses[COARSE_STEPS + 1 :]))
    assert losses[-1] < 0.21


def test_no_other_volume_nearby_has_a_lower_objective(scene):
    """The minimum of misfit and priors, against steps along random directions and towards the truth."""
    delta, setup, data, _ = scene
    recipe = Recipe(tv=(40.0, 40.0), l1=10.0, prior="tv", steps=40)
    problem = problem_of(data, setup, recipe)
    found = list(minimise(problem))[-1]
    lit = replace(known(setup), brightness=found.values["brightness"])

    def objective(at):
        volume = Volume(GRID, at, BACKGROUND)
        with torch.no_grad():
            misfit = problem.misfit(replace(lit, volume=volume).images(replace(FIDELITY, order=1)))
        return float(misfit) + sum(p.weight(0, 1) * float(p(volume)) for p in problem.priors)

    least = objective(found.delta)
    blurred = torch.nn.functional.avg_pool3d(found.delta[None], 3, 1, 1)[0]
    for toward in (delta, blurred, torch.zeros_like(delta), 1.1 * found.delta, found.delta.roll(1, 2)):
        for share in (0.02, 0.2):
            assert objective(found.delta + share * (toward - found.delta)) > least - 1e-4 * least


def test_the_result_scales_with_the_datas_contrast(scene):
    """Δn and noise a tenth as large: the same volume a tenth as large, but for the second order in Δn."""
    results = []
    for height in (0.004, 0.0004):
        setup = setup_of(bead(height))
        steps = fitted(*recorded(setup, 0.3)[:1], setup, Recipe(steps=9))
        results.append(steps[-1].delta / height)
    assert volume_error(results[1], results[0]) < 0.08


def test_a_known_and_a_measured_noise_agree(scene, plain):
    delta, setup, data, noise = scene
    steps = fitted(data, setup, noise=noise)
    assert error(steps, delta) == pytest.approx(error(plain, delta), abs=0.03)


@pytest.mark.parametrize("noise", [pytest.param(0.1, marks=SLOW), pytest.param(0.3, marks=SLOW), 1.0])
def test_the_misfit_ends_at_the_noises(noise):
    setup = setup_of(bead())
    data, _ = recorded(setup, noise)
    problem = problem_of(data, setup)
    last = list(minimise(problem))[-1]
    error = math.sqrt(2 / data.numel())
    assert last.misfit == pytest.approx(problem.weight.noise_misfit, rel=0.03 + error)


@pytest.mark.slow
def test_the_weight_follows_the_noise_and_settles():
    """More noise, more weight; and at the end it hardly moves, also where the misfit hangs on it."""
    last = []
    for noise in (0.1, 0.3, 1.0):
        setup = setup_of(bead())
        steps = fitted(recorded(setup, noise)[0], setup)
        weights = [record["tv"] for record in steps[-1].weights]
        assert max(weights[-3:]) / min(weights[-3:]) < 1.2
        last.append(weights[-1])
    assert last == sorted(last)
    assert last[-1] > 3 * last[0]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=SLOW) for seed in (1, 2, 3))])
def test_where_there_is_only_noise_nothing_is_invented(seed):
    """Noise of this size in images of a bead that fills it would be a Δn of some 0.01."""
    setup = setup_of(torch.zeros(GRID.shape))
    data = setup.images(FIDELITY) + 0.01 * torch.randn(2, 3, 20, 18, generator=torch.Generator().manual_seed(seed))
    steps = fitted(data, setup, noise=[0.01, 0.01])
    assert float(steps[-1].delta.abs().mean()) < 1e-4


def test_an_unknown_noise_ends_with_a_white_residual(scene):
    delta, setup, data, _ = scene
    problem = problem_of(data, setup)
    unknown = replace(problem, weight=replace(problem.weight, noise_misfit=None))
    steps = list(minimise(unknown))
    assert error(steps, delta) < 0.35
    assert steps[-1].weights[-1]["white"] == pytest.approx(1, abs=0.1)


# what it is given


@pytest.mark.parametrize(
    ("sign", "bounds"),
    [
        pytest.param(-1, Bounds(None, 0.0), marks=SLOW),
        (1, Bounds(0.0, 0.015)),
        pytest.param(-1, Bounds(None, None), marks=SLOW),
        pytest.param(1, Bounds(None, 0.05), marks=SLOW),
    ],
)
def test_bounds_are_kept_exactly_and_either_sign_is_found(sign, bounds):
    delta = sign * bead()
    setup = setup_of(delta)
    data, _ = recorded(setup, 0.2)
    steps = fitted(data, setup, Recipe(bounds=bounds))
    for step in steps:
        assert torch.equal(step.delta, bounds.clamped(step.delta))
    assert error(steps, delta) < 0.4
    if bounds.upper == 0.015:
        assert float(steps[-1].delta.max()) == pytest.approx(0.015, abs=1e-7)


@pytest.mark.parametrize(
    ("acquisition", "most"),
    [
        (Acquisition([Prism((0.1, 0.2), 1.5)], [0.2]), 0.85),
        pytest.param(Acquisition([Prism((0.0, 0.24), 1.5), None], [-1.2, 0.0, 1.2]), 0.35, marks=SLOW),
        pytest.param(Acquisition([None], [-1.0, 1.0]), 0.7, marks=SLOW),
    ],
    ids=["one image", "with bright field", "bright field"],
)
def test_any_acquisition_is_explained(acquisition, most):
    delta = bead()
    setup = setup_of(delta, acquisition=acquisition)
    data, _ = recorded(setup, 0.2)
    steps = fitted(data, setup)
    assert steps[-1].misfit < 0.06
    assert error(steps, delta) < most


def test_one_slice_is_found():
    grid = Grid((1, 20, 18), (0.4, 0.2, 0.2))
    delta = bead(0.03, grid, (0.0, 0.1, -0.2))
    setup = setup_of(delta, grid=grid)
    assert error(fitted(recorded(setup, 0.2)[0], setup), delta) < 0.2


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=SLOW)])
def test_other_propagations_lower_their_misfit(propagation):
    """The Hessian is that of straight rays, and the secants and the damping make up for the rest."""
    fidelity = Fidelity(propagation, sources=4)
    setup = setup_of(bead())
    data, _ = recorded(setup, 0.2, fidelity)
    steps = fitted(data, setup, Recipe(steps=14), fidelity)
    assert steps[-1].misfit < 0.1 * steps[0].misfit


def test_a_specimen_beyond_the_field_is_found_in_the_margin():
    grid = Grid((8, 28, 26), (0.4, 0.2, 0.2))
    delta = bead(grid=grid, centre=(0.2, 2.0, 0.3))  # the field ends at 2.0
    setup = setup_of(delta, grid=grid, margin=4)
    steps = fitted(recorded(setup, 0.2)[0], setup)
    assert steps[-1].delta.shape == grid.shape
    assert error(steps, delta) < 0.5
    assert steps[-1].misfit < 0.06


@pytest.fixture(scope="module")
def by_pixels():
    """A function from the side of a camera's pixel to the error of a fit; as much light on any, so less on small ones.

    Pixels of None are the voxels, which sample the light twice as finely as it needs.
    """
    grid = Grid((8, 40, 38), (0.4, 0.1, 0.1))
    delta = bead(0.02, grid, radius=0.9)

    @functools.cache
    def find(pixel):
        camera = None if pixel is None else Camera(pixel_size=pixel)
        setup = setup_of(delta, grid=grid, microscope=replace(MICROSCOPE, camera=camera))
        images = setup.images(FIDELITY)
        noise = 0.009 * 0.1 / (pixel or 0.1) * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
        steps = fitted(images + noise, setup)
        # the first step is as long as it should be: what it leaves is noise, more of it on small pixels
        assert steps[1].misfit < 0.35 * steps[0].misfit
        return error(steps, delta)

    return find


@pytest.mark.parametrize(
    "pixel",
    [
        pytest.param(0.2, id="twice", marks=SLOW),
        pytest.param(0.15, id="1.5 times", marks=SLOW),
        pytest.param(0.1 / 1.5, id="1/1.5", marks=SLOW),
    ],
)
def test_a_cameras_pixels_may_be_coarser_or_finer_than_voxels(by_pixels, pixel):
    """The error is near that on equal pixels."""
    assert by_pixels(pixel) < 1.25 * by_pixels(None)
    assert by_pixels(None) < 0.3


def test_float64_stays_float64(scene, plain):
    delta, _, data, _ = scene
    steps = fitted(data.double(), setup_of(delta.double()), Recipe(steps=9))
    assert steps[-1].delta.dtype == torch.float64
    assert volume_error(plain[8].delta.double(), steps[-1].delta) < 0.02


def test_masked_pixels_play_no_part(scene, plain):
    delta, setup, data, _ = scene
    mask = torch.ones_like(data, dtype=torch.bool)
    mask[:, :, 2:5, 3:6] = False
    wild = torch.where(mask, data, 50.0)
    steps = [fitted(d, setup, Recipe(steps=12), misfit=lambda x: GaussianMisfit(x, mask=mask)) for d in (data, wild)]
    assert torch.equal(steps[0][-1].delta, steps[1][-1].delta)
    assert error(steps[0], delta) < error(plain, delta) + 0.1


# other misfits


@pytest.mark.slow
def test_counted_photons_are_explained_by_either_misfit_of_theirs():
    delta = bead()
    setup = setup_of(delta)
    photons = 4000.0
    with torch.no_grad():
        images = setup.images(FIDELITY)
    data = torch.poisson(images * photons, generator=torch.Generator().manual_seed(0)) / photons
    model = NoiseModel(1 / photons, 0.0)
    for misfit in (PoissonMisfit, GaussianMisfit):
        problem = problem_of(data, setup, misfit=lambda x, misfit=misfit: misfit(x, model))
        steps = list(minimise(problem))
        assert error(steps, delta) < 0.45
        assert 0.97 < steps[-1].misfit / problem.weight.noise_misfit < 1.05


def test_few_photons_do_not_stop_it():
    """Counts of 0 have an infinite weight by themselves, and a first weight of the priors may empty the volume."""
    delta = bead(0.1)
    setup = setup_of(delta)
    with torch.no_grad():
        data = torch.poisson(setup.images(FIDELITY) * 10, generator=torch.Generator().manual_seed(0)) / 10
    steps = fitted(data, setup, misfit=lambda x: PoissonMisfit(x, NoiseModel(0.1, 0.0)))
    assert steps[-1].weights
    assert error(steps, delta) < 0.9
    assert steps[-1].misfit < 0.95 * steps[0].misfit


@pytest.mark.slow
def test_hot_pixels_hardly_move_a_robust_fit(scene):
    delta, setup, data, _ = scene
    hot = data.clone()
    hot[torch.rand(data.shape, generator=torch.Generator().manual_seed(5)) < 0.01] += 0.2
    few = Recipe(steps=9)
    clean = error(fitted(data, setup, few, misfit=RobustMisfit), delta)
    assert error(fitted(hot, setup, few, misfit=RobustMisfit), delta) < 1.2 * clean
    assert error(fitted(hot, setup, few), delta) > 1.5 * clean


# nuisances


def test_brightness_is_always_learned(scene, plain):
    delta, setup, data, _ = scene
    factors = torch.linspace(0.98, 1.02, 6).reshape(2, 3)
    steps = fitted(data * factors[..., None, None], setup)
    assert error(steps, delta) < error(plain, delta) + 0.03
    torch.testing.assert_close(steps[-1].values["brightness"], factors, rtol=3e-3, atol=0)


def test_a_bias_that_is_wrong_by_10_degrees_is_learned(scene, plain):
    delta, setup, data, _ = scene
    off = [replace(prism, bias=prism.bias + math.radians(10)) for prism in ACQUISITION.prisms]
    wrong = replace(setup, acquisition=replace(ACQUISITION, prisms=off))
    steps = fitted(data, wrong, Recipe(learn=("bias",)))
    assert error(steps, delta) < error(plain, delta) + 0.05
    assert steps[-1].values["bias"].tolist() == pytest.approx([1.5, -1.2], abs=math.radians(10))


@pytest.mark.slow
def test_a_drift_of_a_tenth_of_a_micrometre_is_learned(scene, plain):
    delta, setup, _, _ = scene
    drift = 0.1 * torch.randn(2, 3, 2, generator=torch.Generator().manual_seed(1))
    drift = drift - drift.mean((0, 1))
    data, _ = recorded(replace(setup, drift=drift), 0.3)
    steps = fitted(data, setup, Recipe(learn=("drift",)))
    assert error(steps, delta) < error(plain, delta) + 0.1
    assert float((steps[-1].values["drift"] - drift).square().mean().sqrt()) < 0.015


# directions, and images that are corrected


def test_drafts_have_fewer_directions_and_no_padding():
    careful = Fidelity(sources=72, padding=4, steps=5)
    coarse, fine = drafts(careful, 32)
    assert (coarse.sources, fine.sources) == (18, 32)
    assert coarse.padding == fine.padding == 0
    assert coarse.steps == fine.steps == 5
    assert drafts(Fidelity(sources=8), 32)[0] == replace(Fidelity(sources=8), order=1)
    assert drafts(careful, None)[1].sources == 72


def test_a_correction_makes_drafts_careful_and_rests_where_it_hardly_moves(scene):
    _, setup, _, _ = scene
    careful, draft = Fidelity(sources=18), Fidelity(sources=4)
    formed = setup.formed(draft)
    delta = setup.volume.delta
    made = Correction().renewed(setup, formed, careful, None, lambda change: 1.0)
    torch.testing.assert_close(made.to(formed, delta, None), setup.formed(careful))
    assert made.rest == 0
    again = made.renewed(setup, formed, careful, None, lambda change: 0.0)
    assert again.rest == REST
    kept = again.renewed(setup, formed + 1, careful, None, lambda change: 0.0)
    assert kept.added is again.added
    assert kept.rest == REST - 1
    assert Correction().to(formed, delta, None) is formed


def test_where_it_ends_the_volume_explains_the_data_by_careful_images():
    """Data and careful images of 72 directions, steps on 8: the misfit that is reported is that of 72."""
    delta, careful = bead(), Fidelity(sources=72)
    setup = setup_of(delta)
    data, _ = recorded(setup, 0.1, careful)
    problem = problem_of(data, setup, Recipe(draft_sources=8), careful)
    steps = list(minimise(problem))
    last, before = steps[-1], steps[-2]
    lit = replace(setup, volume=Volume(GRID, before.delta, BACKGROUND), brightness=before.values["brightness"])
    with torch.no_grad():
        true, draft = (float(problem.misfit(lit.images(f))) for f in (careful, Fidelity(sources=8)))
    assert last.misfit == pytest.approx(true, rel=0.02)
    assert abs(draft - true) > 3 * abs(last.misfit - true)


@pytest.mark.parametrize(("height", "misled"), [(0.2, True), pytest.param(0.01, False, marks=SLOW)])
def test_few_directions_are_given_up_where_they_mislead(monkeypatch, height, misled):
    """A correction that holds at one volume doesn't make few directions' gradient that of all."""
    delta, careful = bead(height, radius=1.0), Fidelity(sources=72)
    setup = setup_of(delta)
    data, _ = recorded(setup, 0.1, careful)
    assert expected_misled(problem_of(data, setup, Recipe(draft_sources=8), careful)) is misled
    steps = fitted(data, setup, Recipe(draft_sources=8), careful)
    assert steps[-1].state["newton"]["misled"] is misled
    if misled:
        by_all = next(step for step in steps if step.state["newton"]["misled"])
        assert by_all.weights[-1]["tv"] == by_all.weights[-2]["tv"]  # of wrong images, it waits
        monkeypatch.setattr("recon.fit.newton.descent.ASTRAY", math.inf)
        assert error(steps, delta) < 0.9 * error(fitted(data, setup, Recipe(draft_sources=8), careful), delta)


@pytest.mark.parametrize("height", [0.01, 0.08])
def test_few_directions_are_not_expected_to_mislead_where_the_specimen_is_weak(height):
    """At 0.08 the light's phase is no longer small, and it is the estimate's images that say so."""
    careful = Fidelity(sources=72)
    setup = setup_of(bead(height, radius=1.0))
    data, _ = recorded(setup, 0.1, careful)
    assert not expected_misled(problem_of(data, setup, Recipe(draft_sources=8), careful))
    assert not expected_misled(problem_of(data, setup, Recipe(draft_sources=None), careful))


def test_a_descent_goes_on_from_a_given_volume(scene, plain):
    """Where it ended, the objective is as low already, by the weight and the contrast that were known in the end."""
    delta, setup, data, noise = scene
    problem = problem_of(data, setup, noise=noise)
    steps = list(minimise(problem.again(problem.misfit, plain[-1], plain[-1].delta)))
    assert steps[0].misfit == pytest.approx(plain[-1].misfit, rel=0.01)
    assert steps[-1].loss < steps[0].loss * 1.001
    assert {record["tv"] for record in steps[-1].weights} == {plain[-1].weights[-1]["tv"]}
    assert error(steps, delta) == pytest.approx(error(plain, delta), rel=0.1)


def test_the_careful_images_correct_from_the_fine_steps_on(scene, monkeypatch):
    """Not after 60 % of the steps: a descent may end before."""
    _, setup, data, _ = scene
    made = []
    renewed = Correction.renewed
    monkeypatch.setattr(
        Correction, "renewed", lambda self, *given: made.append(given[2].sources) or renewed(self, *given)
    )
    fitted(data, setup, Recipe(draft_sources=8, steps=COARSE_STEPS + 1), Fidelity(sources=18))
    assert set(made) == {18}
    assert len(made) >= 1


def test_a_step_whose_careful_images_cannot_be_computed_is_taken_back(scene, monkeypatch):
    """Steep directions of a condenser that was told too wide make energy in slabs before the drafts' do."""
    _, setup, data, _ = scene
    renewed, wild = Correction.renewed, []

    def once(self, *given):
        if self.added is not None and not wild:
            wild.append(True)
            raise UnstableError("slabs make energy")
        return renewed(self, *given)

    recipe = Recipe(draft_sources=8, steps=COARSE_STEPS + 6)
    undisturbed = fitted(data, setup, recipe, Fidelity(sources=18))
    monkeypatch.setattr(Correction, "renewed", once)
    steps = fitted(data, setup, recipe, Fidelity(sources=18))
    assert wild
    back = [torch.equal(one.delta, other.delta) for one, other in pairwise(steps)]
    assert any(back)
    assert steps[-1].misfit == pytest.approx(undisturbed[-1].misfit, rel=0.03)


@pytest.mark.slow
def test_a_fidelity_is_planned_once_the_volume_has_grown(scene):
    delta, setup, data, _ = scene
    steps = fitted(data, setup, Recipe(steps=14), 0.2)
    assert [plan["step"] for plan in steps[-1].plans] == [COARSE_STEPS + 1]
    assert error(steps, delta) < 0.5


@pytest.mark.parametrize("steps", [1, 3])
def test_a_planned_descent_of_few_steps_is_judged_by_a_plan(scene, steps):
    _, setup, data, _ = scene
    (*_, last) = fitted(data, setup, Recipe(steps=steps), 0.2)
    assert [plan["step"] for plan in last.plans] == [steps]


# going on after an interruption

RESUMED = {
    "many directions": (Recipe(steps=10, draft_sources=20), Fidelity(sources=24)),
    "few directions": (Recipe(steps=11), Fidelity(sources=4)),
    "corrected": (Recipe(steps=11, draft_sources=3, learn=("bias", "drift")), Fidelity(sources=6, padding=1)),
    "tolerance": (Recipe(steps=10), 0.3),
}


@pytest.mark.parametrize("case", ["many directions", *(pytest.param(c, marks=SLOW) for c in list(RESUMED)[1:])])
def test_resuming_from_any_step_ends_where_an_uninterrupted_run_does(case, scene):
    _, setup, data, _ = scene
    recipe, fidelity = RESUMED[case]
    problem = problem_of(data, setup, recipe, fidelity)
    steps = list(minimise(problem))
    for k in (0, COARSE_STEPS - 1, COARSE_STEPS, len(steps) - 2, len(steps) - 1):
        (*rest,) = minimise(problem, steps[k])
        assert len(rest) == len(steps) - 1 - k
        assert all(alike(a, b) for a, b in zip(rest, steps[k + 1 :], strict=True))


def test_a_descent_that_has_ended_does_not_go_on(scene):
    """Where nothing changes any more, before its last step."""
    _, setup, data, _ = scene
    problem = problem_of(data, setup, Recipe(tv=(300.0, 300.0), l1=100.0, prior="tv", steps=40))
    steps = list(minimise(problem))
    assert len(steps) < 40
    assert list(minimise(problem, steps[-1])) == []


def test_resuming_leaves_the_step_that_it_went_on_from_alone(scene):
    _, setup, data, _ = scene
    problem = problem_of(data, setup, Recipe(steps=5))
    step = list(minimise(problem))[2]
    before = copy.deepcopy(step)
    assert len(list(minimise(problem, step))) == 2
    assert alike(step, before)


def test_a_step_of_another_descent_is_refused(scene):
    _, setup, data, _ = scene
    newton = problem_of(data, setup, Recipe(steps=1))
    adam = problem_of(data, setup, Recipe(method="adam", start="zero", steps=1))
    drifting = problem_of(data, setup, Recipe(steps=2, learn=("drift",)))
    (step,), (other,) = list(minimise(newton)), list(minimise(adam))
    with pytest.raises(ValueError, match="the saved step is none of Newton's method"):
        next(minimise(newton, other))
    with pytest.raises(ValueError, match=r"unknowns delta, brightness, the descent has delta, brightness, drift"):
        next(minimise(drifting, step))


# what it refuses


def test_unknowns_that_are_neither_index_nor_nuisance_are_refused(scene):
    _, setup, data, _ = scene

    class Background(Unknown):
        name = "background"
        learning_rate = 1e-3

        def start(self, setup, misfit):
            return misfit.data.new_tensor(BACKGROUND)

        def put(self, value, setup):
            return setup

    problem = problem_of(data, setup)
    for unknowns in ([*problem.unknowns, Background()], [Brightness()]):
        with pytest.raises(ValueError, match=r"Newton's method finds Δn.*; use method 'adam'"):
            next(minimise_by_newton(replace(problem, unknowns=unknowns)))


def test_a_prior_without_a_majorant_is_refused(scene):
    _, setup, data, _ = scene

    class Fourth(Prior):
        def weight(self, step, steps):
            return 1.0

        def __call__(self, volume):
            return volume.delta.pow(4).mean()

    with pytest.raises(NotImplementedError, match="Fourth has no majorant"):
        next(minimise_by_newton(replace(problem_of(data, setup), priors=[Fourth()])))


def test_without_nuisances_and_priors_it_is_least_squares(scene):
    """Gauss and Newton's descent of the misfit alone, from clean images."""
    delta, setup, _, _ = scene
    data, _ = recorded(setup)
    problem = replace(problem_of(data, setup, Recipe(steps=12)), priors=[], weight=None)
    index = next(u for u in problem.unknowns if isinstance(u, IndexDifference))
    steps = list(minimise_by_newton(replace(problem, unknowns=[index])))
    assert steps[-1].misfit < 2e-3
    assert error(steps, delta) < 0.6


def test_the_first_step_is_that_of_the_weak_specimen(scene):
    """As long as it should be: of a weak specimen, whose misfit is a parabola, it finds nearly all."""
    setup = setup_of(bead(1e-3))
    data, _ = recorded(setup)
    steps = fitted(data, setup, Recipe(steps=2))
    assert steps[1].misfit < 0.1


def weak(problem, draft):
    """The Hessian with which a descent begins."""
    descent = _Descent(problem)
    parameters = {u.name: u.start(problem.setup, problem.misfit) for u in descent.nuisances}
    return descent.responses(parameters, draft, None)


def test_the_hessian_is_the_misfits_own_along_a_smooth_direction():
    """With a margin, a camera's pixels and brightness: second differences of the misfit at the empty volume."""
    cases = {
        "voxels": setup_of(bead(dtype=torch.float64)),
        "camera": setup_of(bead(dtype=torch.float64), microscope=replace(MICROSCOPE, camera=Camera(pixel_size=0.4))),
    }
    for name, setup in cases.items():
        data, _ = recorded(setup)
        problem = problem_of(data, setup)
        hessian = weak(problem, replace(FIDELITY, order=1))
        x, h = bead(1.0, radius=0.9, dtype=torch.float64), 1e-5
        base = known(setup)

        def misfit(step, problem=problem, base=base, x=x):
            volume = Volume(GRID, step * x, BACKGROUND)
            return float(problem.misfit(replace(base, volume=volume).images(FIDELITY)))

        # the residual's own part cancels for the weak specimen: what is left is Gauss and Newton's
        shown = [replace(base, volume=Volume(GRID, s * h * x, BACKGROUND)).images(FIDELITY) for s in (-1, 1)]
        along = (shown[1] - shown[0]) / (2 * h)
        expected = float((problem.misfit.curvature(problem.misfit.data) * along.square()).sum())
        found = float((x * hessian(x)).sum()) / math.prod(GRID.shape)
        assert found == pytest.approx(expected, rel=0.02), name


@pytest.mark.slow
def test_it_goes_there_as_here(scene):
    delta, _, data, _ = scene
    here = fitted(data.double(), setup_of(delta.double()), Recipe(steps=3), Fidelity(sources=3))[-1]
    with Device():
        there = fitted(send(data.double()), setup_of(send(delta.double())), Recipe(steps=3), Fidelity(sources=3))[-1]
    assert there.delta.device == DISTANT
    torch.testing.assert_close(bring(there.delta), here.delta, rtol=1e-6, atol=1e-9)


@pytest.mark.filterwarnings("ignore::torchdic.errors.SamplingWarning")
def test_a_field_that_holds_no_frequency_that_passes_stays_empty():
    setup = setup_of(torch.zeros(4, 2, 2), grid=Grid((4, 2, 2), (0.5, 0.2, 0.2)))
    data = 1 + 0.1 * torch.rand(2, 3, 2, 2, generator=torch.Generator().manual_seed(0))
    *_, last = fitted(data, setup, Recipe(steps=6))
    assert not last.delta.any()
