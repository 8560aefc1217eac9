"""The verdict on a finished fit, and what most likely is wrong with a poor one."""

import math
import warnings

import pytest
import torch

from recon.calibration.trials.short_fits import can_be_tried
from recon.fit.bounds import Bounds
from recon.fit.descent import minimise
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from recon.report.causes import Cause, ranked, seen_in_residual, tried, variants
from recon.report.metrics import coarse_residual
from recon.report.verdict import LIMIT, PoorFitWarning, Verdict, judged, leaves_too_much
from recon.run.results import model_images, tell
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

GRID = Grid((6, 24, 22), (0.5, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.7), Condenser(0.5))
SHEARS, FOCUS = ((0.0, 0.24), (0.24, 0.0)), (-1.5, -0.5, 0.5, 1.5)
QUARTER = math.pi / 2
TRUE = Acquisition([Prism(shear, QUARTER) for shear in SHEARS], FOCUS)
NOISE = 0.004
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")


def sheared(*shears, focus=FOCUS):
    return Acquisition([Prism(shear, QUARTER) for shear in shears], focus)


MISTAKES = {
    "sign": sheared((0.0, -0.24), (-0.24, 0.0)),
    "focus": sheared(*SHEARS, focus=FOCUS[::-1]),
    "axes": sheared(*SHEARS[::-1]),
    "mirrored y": sheared((0.0, 0.24), (-0.24, 0.0)),
    "mirrored x": sheared((0.0, -0.24), (0.24, 0.0)),
}


@pytest.fixture(scope="module")
def truth():
    """A ball off the centre, so that no mirror image of it is the same."""
    z, y, x = ((torch.arange(n) - (n - 1) / 2) * d for n, d in zip(GRID.shape, GRID.spacing, strict=True))
    distance = ((z[:, None, None] - 0.5) ** 2 + (y[:, None] + 0.4) ** 2 + (x - 0.5) ** 2).sqrt()
    return 0.02 * torch.sigmoid((0.9 - distance) / 0.1)


@pytest.fixture(scope="module")
def images(truth):
    with torch.no_grad():
        return image(Volume(GRID, truth, 1.335), MICROSCOPE, TRUE, Fidelity(sources=18))


@pytest.fixture(scope="module")
def data(images):
    return images + NOISE * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))


def problem_of(data, acquisition=TRUE, bounds=None, **parts):
    setup = Setup(empty_medium(GRID, 1.335, data), parts.get("microscope", MICROSCOPE), acquisition)
    return Problem.from_recipe(data, setup, Fidelity(sources=18), Recipe(bounds=bounds or Bounds()), noise=[NOISE] * 2)


# causes that short fits find


@pytest.mark.parametrize(
    "name", ["sign", "focus", *(pytest.param(n, marks=pytest.mark.slow) for n in ("axes", "mirrored y", "mirrored x"))]
)
def test_a_short_fit_names_the_mistake_of_geometry(data, name):
    problem = problem_of(data, MISTAKES[name])
    first = max(tried(problem, 0.9, problem.misfit.of_noise([NOISE] * 2)), key=lambda cause: cause.share)
    assert first.name == name
    assert first.share > 0.7


def test_a_specimen_on_the_other_side_of_the_bounds_is_found(data):
    problem = problem_of(data, bounds=Bounds(None, 0.0))
    causes = sorted(tried(problem, 0.9, problem.misfit.of_noise([NOISE] * 2)), key=lambda cause: -cause.share)
    assert causes[0].name == "Δn's sign"


@pytest.mark.slow
def test_a_right_problem_has_no_other_that_explains_as_much(data):
    problem = problem_of(data)
    noise = problem.misfit.of_noise([NOISE] * 2)
    assert not list(tried(problem, LIMIT * noise, noise))


def test_a_variant_differs_from_all_others(data):
    """A prism of reversed shear and bias is the same prism, so nothing is tried twice."""
    both = Acquisition([Prism((0.0, 0.24), QUARTER), Prism((0.0, 0.24), -QUARTER)], FOCUS)
    names = [v.name for v in variants(problem_of(data, both))]
    assert names.count("sign") == 1
    assert "prisms" not in names  # to exchange these two is to reverse the sign
    assert "mirrored x" not in names
    assert "mirrored y" not in names


def test_what_newton_cannot_fit_is_not_tried(data):
    assert can_be_tried(problem_of(data))
    assert not can_be_tried(problem_of(data, microscope=Microscope(0.546, condenser_prism=False)))


@pytest.mark.parametrize(("name", "rest"), [("sign", "reverse acquisition.focus"), ("focus", "reverse the sign of")])
def test_the_advice_to_reverse_names_what_else_gives_the_same_images(data, name, rest):
    """Of shears, planes and Δn's sign all three reversed are a gauge, see tests/test_laws.py."""
    advice = {v.name: v.advice for v in variants(problem_of(data))}[name]
    assert f"or, with the same images, {rest}" in advice
    assert 'set reconstruction.bounds = { lower = "none", upper = 0 } (images' in advice
    free = {v.name: v.advice for v in variants(problem_of(data, bounds=Bounds(None, None)))}[name]
    assert f"or, with the same images, {rest}" in free
    assert "bounds" not in free


def test_what_is_assumed_is_advised_first(data):
    assumed = {v.name: v.advice for v in variants(problem_of(data), ("sign of Δn",))}["focus"]
    assert assumed.startswith("reverse the sign of every shear and set reconstruction.bounds")
    assert "or, with the same images, reverse acquisition.focus" in assumed
    known, near, doubted = Cause("axes", 0.9, "", ""), Cause("focus", 0.85, "", ""), Cause("focus", 0.5, "", "")
    assert ranked([known, near], ("order of the planes",)) == (near, known)
    assert ranked([known, near]) == (known, near)
    assert ranked([known, doubted], ("order of the planes",)) == (known, doubted)


@pytest.mark.parametrize("stacked", [True, False])
def test_a_planes_order_is_advised_only_where_there_are_planes(data, stacked):
    planes = slice(None) if stacked else slice(1, 2)
    acquisition = sheared(*SHEARS, focus=FOCUS[planes])
    advice = {v.name: v.advice for v in variants(problem_of(data[:, planes], acquisition))}["sign"]
    assert ("focus" in advice) is stacked


@pytest.mark.parametrize("name", ["right", "mirrored y", pytest.param("sign", marks=pytest.mark.slow)])
def test_a_small_noisy_stack_with_a_reversed_axis_is_not_explained(images, name):
    """A wild volume brings its misfit to the noise's, by following the noise; the right one isn't warned of."""
    level = 5 * NOISE
    noisy = images + level * torch.randn(images.shape, generator=torch.Generator().manual_seed(1))
    setup = Setup(empty_medium(GRID, 1.335, noisy), MICROSCOPE, MISTAKES.get(name, TRUE))
    problem = Problem.from_recipe(noisy, setup, Fidelity(sources=18), Recipe(), noise=[level] * 2)
    steps = list(minimise(problem))
    found = judged(problem, model_images(problem, steps[-1]), [level] * 2, "newton", [step.row for step in steps])
    assert not leaves_too_much(found.misfit, found.noise)
    assert found.poor is (name != "right")
    assert [cause.name for cause in found.causes[:1]] == ([] if name == "right" else [name])
    assert ("another explains the stack better; most likely" in found.words) is found.poor


def test_white_noise_has_a_coarse_residual_of_1_and_structure_more():
    noise = torch.randn(2, 3, 60, 60, generator=torch.Generator().manual_seed(0))
    rows, columns = noise * 0.1, torch.sin(torch.arange(60) / 4.0)
    assert coarse_residual(rows, [0.1, 0.1]) == pytest.approx(1, abs=0.1)  # two of its standard deviations
    # means over three pixels keep (sin 3w/sin w/3)² = 0.92 of the wave's power 1/2, at w = 1/8
    expected = 9 * 0.5 * 0.01 * (math.sin(3 / 8) / math.sin(1 / 8) / 3) ** 2 / 0.01
    assert coarse_residual(0.1 * columns.expand(2, 3, 60, 60), [0.1, 0.1]) == pytest.approx(expected, rel=0.1)
    assert coarse_residual(rows[..., :2], [0.1, 0.1]) == 1.0


# causes that the residual shows


def residual_causes(images, data, margin=0):
    misfit = GaussianMisfit(data)
    return {cause.name for cause in seen_in_residual(images, misfit, misfit.of_noise([NOISE] * 2), margin)}


def test_noise_alone_shows_no_cause(images, data):
    assert residual_causes(images, data) == set()


def test_each_spoilt_residual_shows_its_cause(images, data):
    stuck, cut, moved, lit = (data.clone() for _ in range(4))
    stuck[:, :, [3, 20], [5, 9]] += 1.0
    cut[..., :2] += 0.2 * torch.sin(torch.arange(24.0))[:, None]
    moved[1, 2] = moved[1, 2].roll(7, 0)
    lit += 0.1 * torch.randn(2, 4, 1, 1, generator=torch.Generator().manual_seed(1))
    assert "stuck pixels" in residual_causes(images, stuck)
    assert "cut specimen" in residual_causes(images, cut)
    assert "cut specimen" not in residual_causes(images, cut, margin=3)
    assert "one image" in residual_causes(images, moved)
    assert "brightness" in residual_causes(images, lit)


# the verdict


def test_the_truth_explains_its_stack(images, data):
    found = judged(problem_of(data), images, [NOISE] * 2, "newton", [(n, 0.5, 0.5, 1.0) for n in range(20)])
    assert not found.poor
    assert found.causes == ()
    assert found.ratio == pytest.approx(1.0, abs=0.05)
    assert found.explained == pytest.approx(1.0, abs=0.05)
    assert found.white == pytest.approx(1.0, abs=0.1)
    assert "the volume explains the stack" in found.words
    assert "×" in found.words


def test_few_steps_are_named_and_nothing_else_is_tried(data, capsys):
    empty = data.mean((2, 3), keepdim=True).expand(data.shape)
    found = judged(problem_of(data), empty, [NOISE] * 2, "newton", [(1, 1.0, 1.0, 1.0)])
    assert found.poor
    assert [cause.name for cause in found.causes] == ["few steps"]
    assert capsys.readouterr().out == ""


def test_a_poor_fit_is_warned_of_with_cause_and_advice(data, capsys):
    empty = data.mean((2, 3), keepdim=True).expand(data.shape)
    rows = [(n, 0.9, 0.9, 1.0) for n in range(20)]
    found = judged(problem_of(data, MISTAKES["sign"]), empty, [NOISE] * 2, "newton", rows)
    assert "short fits" in capsys.readouterr().out
    with pytest.warns(PoorFitWarning, match=r"most likely: sign .*reverse the sign of every shear"):
        tell(found)
    assert found.as_json()["causes"][0]["name"] == "sign"
    assert "\n" not in found.words


def test_a_good_fit_is_told_without_a_warning(capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tell(Verdict(0.131, 0.1305, 1.0))
    assert (
        capsys.readouterr().out == "misfit 0.131 is 1.004 × what noise leaves (0.131): the volume explains the stack\n"
    )


@pytest.mark.parametrize(
    ("misfit", "noise", "poor"),
    [
        (0.0005, 0.0, False),  # clean: what voxels and directions leave
        (0.3, 0.0, True),
        (0.0153, 0.0146, False),
        (0.136, 0.129, False),
        (0.15, 0.129, True),
        (0.99, 0.98, False),
        (1.01, None, True),
        (0.5, None, False),
        (math.nan, 0.1, True),
    ],
)
def test_too_much_is_a_tenth_above_the_noise_and_a_hundredth_of_the_contrast(misfit, noise, poor):
    assert leaves_too_much(misfit, noise) is poor


def test_a_volume_that_follows_the_noise_is_told():
    assert "follows the noise" in Verdict(0.1, 0.13, 1.0).words


def test_free_bounds_are_told():
    assert "Δn's sign is free" in Verdict(0.13, 0.13, 1.0, free=True).words


def test_a_sign_that_is_assumed_is_told_beside_the_volume_that_explains_the_stack():
    words = Verdict(0.13, 0.13, 1.0, assumed=("bias", "sign of Δn")).words
    assert words.endswith("; so does −Δn with reversed shears and planes: sign of Δn is assumed")
    assert "−Δn" not in Verdict(0.13, 0.13, 1.0, assumed=("bias",)).words


def test_without_a_cause_what_is_assumed_is_to_be_checked_first():
    assert "check what is assumed (bias), then pixel size" in Verdict(0.5, 0.13, 1.0, assumed=("bias",)).words


def test_a_specimen_that_goes_on_beyond_the_depth_is_told(images, data, truth):
    """The apertures see little of where it ends, so that it may end beyond the last slice, and anywhere there."""
    rows = [(n, 0.5, 0.5, 1.0) for n in range(20)]
    found = judged(problem_of(data), images, [NOISE] * 2, "newton", rows)
    within = truth.clone()
    within[[0, -1]] = 0
    assert "depth" not in found.with_volume(within).words
    within[-1] = truth[truth.shape[0] // 2]
    beyond = found.with_volume(within)
    words = "the volume explains the stack; it doesn't end within its depth (its last slice holds 100% of what the"
    assert words in beyond.words
    assert beyond.words.endswith("isn't told: fit it with more slices (volume.shape)")
    assert beyond.as_json()["ends"] == [0.0, pytest.approx(1.0)]


def test_a_volume_that_is_full_of_the_other_sign_is_told(images, data, truth):
    """The ball less its own Δn everywhere gives the same images: a specimen above the medium, bounds below it."""
    rows = [(n, 0.5, 0.5, 1.0) for n in range(20)]
    problem = problem_of(data, bounds=Bounds(None, 0.0))
    found = judged(problem, images, [NOISE] * 2, "newton", rows).with_volume(truth - truth.max())
    assert "the volume explains the stack; more than half of the volume has a Δn of about -0.02: images" in found.words
    assert "more than half" not in judged(problem, images, [NOISE] * 2, "newton", rows).with_volume(truth).words
