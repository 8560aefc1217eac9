"""Error bars: what noise does to a volume, what is lost besides, and the numbers of its parts with theirs."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import tifffile
import torch
from absolute import Absolute
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from small_bead import CONFIG

from recon.cli import main
from recon.cli.evidence.error_bars import _words
from recon.evidence.bars import SPECIMEN, ErrorBars, bars_of
from recon.evidence.ends import ends, open_ends
from recon.evidence.error_bars import error_bars
from recon.evidence.errors import ErrorModel, near, noise_deviation, noise_interval
from recon.evidence.estimate import Estimate
from recon.evidence.refits import Refit, planned_refits, refits
from recon.evidence.regions import Known, Region, known_measures
from recon.evidence.turned import middle, turn, turned
from recon.fit.bounds import Bounds, SupportedBounds
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.misfit.gaussian import GaussianMisfit
from recon.recording.noise import NoiseModel
from recon.run.reconstruct import reconstructed
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism
from torchdic.files.stack import read_volume

BACKGROUND = 1.4
GRID = Grid((8, 24, 20), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5)], [-0.8, 0.8])


def ball(radius=0.9, delta=0.02, centre=(0.0, 0.0, 0.0), grid=GRID):
    """Δn of a ball, its surface within a voxel."""
    z, y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in range(3))
    away = (z[:, None, None] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 + (x - centre[2]) ** 2
    return (delta * torch.sigmoid((radius - away.sqrt()) / 0.03)).float()


# turned copies


def test_a_right_angle_about_z_brings_y_to_x():
    grid = Grid((4, 9, 9), (0.4, 0.2, 0.2))
    volume = torch.zeros(grid.shape)
    volume[1, 6, 4] = 1.0
    moved = turned(volume, grid, (1.5, 4.0, 4.0), Rotation.from_euler("z", 90, degrees=True))
    assert float(moved.max()) == pytest.approx(1.0)
    ((z, y, x),) = torch.nonzero(moved > 0.5).tolist()
    assert (z, y) == (1, 4)
    assert abs(x - 4) == 2


def test_a_ball_turns_into_itself_in_the_middle():
    """Whatever its place and the voxels' shape."""
    volume = ball(centre=(0.3, -0.4, 0.5))
    for number in range(5):
        moved = turned(volume, GRID, middle(volume), turn(number))
        assert float((moved - ball()).norm() / ball().norm()) < 0.25
        assert float(moved.sum()) == pytest.approx(float(volume.sum()), rel=0.03)


def test_turns_are_rotations_each_its_own_and_the_same_again():
    found = [turn(number).as_matrix() for number in range(6)]
    for number, matrix in enumerate(found):
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1.0)
        np.testing.assert_array_equal(matrix, turn(number).as_matrix())
    assert all(np.abs(a - b).max() > 0.1 for i, a in enumerate(found) for b in found[:i])


def test_an_empty_volume_stays_empty():
    nothing = torch.zeros(GRID.shape)
    assert middle(nothing) == tuple((n - 1) / 2 for n in GRID.shape)
    assert not turned(nothing, GRID, middle(nothing), turn(0)).any()
    assert not near(nothing).any()


# bars of voxels


def test_the_deviation_by_noise_is_that_of_the_refits():
    """About the one without noise: that priors draw a noisy one's volume in is what noise does, too."""
    drawn = torch.randn(200, 4, 6, 6, generator=torch.Generator().manual_seed(0))
    assert float(noise_deviation(0.01 * drawn).mean()) == pytest.approx(0.01, rel=0.02)
    assert float(noise_deviation(0.01 * drawn + 0.02).mean()) == pytest.approx(math.hypot(0.01, 0.02), rel=0.02)
    few = [noise_deviation(part) for part in drawn.split(10)]
    single = [part.std(0) for part in drawn.split(10)]
    assert float(torch.stack(few).std()) < 0.7 * float(torch.stack(single).std())


def test_the_interval_of_noise_holds_68_percent_of_what_it_does():
    random = torch.Generator().manual_seed(0)
    everywhere = torch.ones(6, 12, 12, dtype=torch.bool)
    normal = torch.randn(17, 6, 12, 12, generator=random)
    seldom = normal * (torch.rand(normal.shape, generator=random) < 0.3)  # most voxels stay where they are
    for kind, volumes in (("normal", normal), ("seldom", seldom)):
        known, unseen = volumes[:-1], volumes[-1]
        interval = noise_interval(known, everywhere)
        assert float((unseen.abs() <= interval * noise_deviation(known)).float().mean()) == pytest.approx(
            0.68, abs=0.05
        )
        assert interval == pytest.approx(1.0, abs=0.1) if kind == "normal" else interval < 0.6
    assert noise_interval(normal[:1], everywhere) == 1.0  # one doesn't tell
    assert noise_interval(torch.zeros(4, 6, 12, 12), everywhere) == 1.0


def blurred(volume, width):
    return torch.from_numpy(gaussian_filter(volume.numpy(), width))


def test_bars_of_what_is_lost_hold_two_of_three_voxels():
    """Of a ball that wasn't among the copies, with the same kind of loss."""

    def of(kind, radius, number=0):
        truth = ball(radius)
        return Refit(kind, number, blurred(truth, (1.0, 0.6, 0.6)), truth)

    model = ErrorModel.of_copies([of("turned", 0.8), of("turned", 1.1, 1)], GRID, 0.42)
    assert model is not None
    unseen = of("turned", 0.95)
    assert unseen.truth is not None
    off, bar = (unseen.delta - unseen.truth).abs(), model.deviation(unseen.delta)
    where = near(unseen.truth)
    assert float((off <= bar)[where].float().mean()) == pytest.approx(0.68, abs=0.12)
    assert float(bar[~near(unseen.delta)].max()) < 0.6 * float(bar.max())


def test_copies_that_are_found_exactly_leave_no_bars():
    exact = Refit("turned", 0, ball(), ball())
    assert ErrorModel.of_copies([exact], GRID, 0.42) is None
    assert ErrorModel.of_copies([], GRID, 0.42) is None


# numbers of regions


def test_a_balls_volume_index_and_dry_mass():
    """In the units of the field: µm³, Δn, and picograms at 0.185 ml/g."""
    grid = Grid((32, 32, 32), (0.1, 0.1, 0.1))
    delta = ball(1.2, 0.03, grid=grid)
    region = Region.within(SPECIMEN, torch.ones(grid.shape, dtype=torch.bool), delta)
    found = region.measures(delta, grid, 0.185)
    volume = 4 / 3 * math.pi * 1.2**3
    assert found["volume"] == pytest.approx(volume, rel=0.03)
    assert found["mean"] == pytest.approx(0.03, rel=0.06)
    assert found["mass"] == pytest.approx(0.03 * volume / 0.185, rel=0.06)


def test_a_hole_is_a_region_too():
    delta = -ball()
    region = Region.within("hole", torch.ones(GRID.shape, dtype=torch.bool), delta)
    assert region.threshold is not None
    assert region.threshold < 0
    assert torch.equal(region.voxels(delta), Region.within("ball", region.outline, -delta).voxels(-delta))
    assert region.measures(delta, GRID, 0.185)["mass"] < 0


def test_a_part_stands_out_in_an_outline_that_is_drawn_loosely():
    body, part = ball(1.1, 0.02), ball(0.5, 0.02)
    outline = ball(0.8) > 0.01
    region = Region.within("part", outline, body + part)
    assert torch.equal(region.voxels(body + part), part > 0.01)


def test_a_flat_outline_is_taken_whole():
    outline = ball(0.5) > 0.01
    assert torch.equal(
        Region.within("flat", outline, torch.full(GRID.shape, 0.02)).voxels(torch.zeros(GRID.shape)), outline
    )


def test_errors_of_numbers_are_those_of_the_refits():
    outline = torch.ones(GRID.shape, dtype=torch.bool)
    delta = torch.full(GRID.shape, 0.02)
    region = Region.within("all", outline, delta)
    noisy = [Refit("noise", i, delta * factor) for i, factor in enumerate((0.97, 0.99))]
    noisy.append(Refit("noiseless", 0, 0.98 * delta))
    lost = [Refit("turned", i, delta * factor, delta) for i, factor in enumerate((0.9, 0.94))]
    found = known_measures(region, delta, GRID, 0.185, [*noisy, *lost], {0: outline, 1: outline})["mass"]
    assert found.usual == pytest.approx(-0.08, rel=1e-4)
    assert found.value == pytest.approx(found.found / 0.92, rel=1e-4)
    assert found.noise == pytest.approx(0.01 * found.value, rel=1e-4)
    assert found.error == pytest.approx(found.value * math.sqrt((0.1**2 + 0.06**2) / 2), rel=1e-4)
    assert Known(1.0, 0.0, 0.3, 0.5).loss == pytest.approx(0.4)
    assert Known(1.0, 0.0, 0.3, 0.2).error == pytest.approx(0.3)


def test_a_copy_whose_part_is_turned_out_of_the_field_tells_nothing_of_it():
    outline, gone = (torch.full(GRID.shape, there, dtype=torch.bool) for there in (True, False))
    delta = torch.full(GRID.shape, 0.02)
    region = Region.within("all", outline, delta)
    copies = [Refit("turned", i, delta * factor, delta) for i, factor in enumerate((0.9, 0.5))]
    found = [Refit("noiseless", 0, delta), *copies]
    told = known_measures(region, delta, GRID, 0.185, found, {0: outline, 1: gone})["mass"]
    assert told.usual == pytest.approx(-0.1, rel=1e-4)


def test_an_edge_that_is_not_known_is_an_error_of_the_number():
    """Copies whose contrast falls by a fifth: of a threshold found anew the volume stays, of the kept one it falls."""
    outline = torch.ones(GRID.shape, dtype=torch.bool)
    delta = blurred(ball(), (0.8, 1.0, 1.0))
    region = Region.within("all", outline, delta)
    faded = Refit("turned", 0, 0.8 * delta, delta)
    found = known_measures(region, delta, GRID, 0.185, [Refit("noiseless", 0, delta), faded], {0: outline})["volume"]
    assert found.usual == pytest.approx(0.0, abs=0.02)
    kept = region.measures(0.8 * delta, GRID, 0.185)["volume"] / found.found - 1
    assert found.whole == pytest.approx(-kept * found.found, rel=0.02)


# refits


def problem_of(data, recipe=None, support=None, grid=GRID):
    setup = Setup(empty_medium(grid, BACKGROUND, data), MICROSCOPE, ACQUISITION)
    return Problem.from_recipe(data, setup, Fidelity(sources=6), recipe or Recipe(), noise=[0.01], support=support)


def images(seed=0):
    return 0.5 + 0.1 * torch.rand(1, 2, 24, 20, generator=torch.Generator().manual_seed(seed))


def step_of(delta, weight=20.0):
    values = {"delta": delta, "brightness": torch.ones(1, 2)}
    return Step(3, 0.1, 0.2, delta, 1.0, values, {}, (), ({"step": 3, "tv": weight},))


def averaging(problem):
    """An estimator that is linear in the images: Δn is a tenth of their mean over planes."""
    mean = problem.misfit.data.mean((0, 1))
    return step_of(mean.expand(GRID.shape) / 10)


def test_the_bars_of_a_linear_estimator_are_what_its_noise_leaves():
    problem = problem_of(images())
    estimate = Estimate(problem, averaging(problem), lambda images: torch.tensor(0.02), GaussianMisfit, averaging)
    found = list(refits(estimate, planned_refits(40, 0)))
    assert [refit.kind for refit in found] == ["noiseless", *(40 * ["noise"])]
    deviation = noise_deviation(torch.stack([refit.delta for refit in found[1:]]) - found[0].delta)
    assert float(deviation.mean()) == pytest.approx(0.02 / 10 / math.sqrt(2), rel=0.03)


def test_uniform_images_show_an_empty_volume():
    problem = problem_of(images())
    estimate = Estimate(problem, averaging(problem), lambda images: torch.tensor(0.0), GaussianMisfit, averaging)
    assert not estimate.refitted(torch.full((1, 2, 24, 20), 0.5)).any()


def test_each_refit_depends_on_its_number_alone():
    problem = problem_of(images())
    estimate = Estimate(problem, averaging(problem), lambda images: torch.tensor(0.02), GaussianMisfit, averaging)
    both = {(r.kind, r.number): r.delta for r in refits(estimate, planned_refits(3, 2))}
    (alone,) = refits(estimate, [("noise", 2)])
    (copied,) = refits(estimate, [("turned", 1)])
    assert torch.equal(alone.delta, both["noise", 2])
    assert torch.equal(copied.delta, both["turned", 1])
    assert not torch.equal(both["noise", 0], both["noise", 1])


def test_other_images_are_fitted_as_the_first_were_in_the_end():
    """With the last weight, held; from the estimate only where the method ends wherever it begins."""
    seen = []

    def solve(problem):
        seen.append(problem)
        return averaging(problem)

    support = ball() > 0.01
    problem = problem_of(images(), support=support)
    delta = ball()
    estimate = Estimate(problem, step_of(delta, 33.0), lambda images: torch.tensor(0.02), GaussianMisfit, solve)
    list(refits(estimate, planned_refits(1, 1)))
    noiseless, noisy, copied = seen
    assert noiseless.unknowns[0].given is None
    for fitted in seen:
        assert fitted.weight.first == 33.0
        assert fitted.weight.next([{"tv": 33.0}], 0.5, None, 1.0, 1.0)[0] == 33.0
    assert torch.equal(noisy.unknowns[0].given, delta)
    assert isinstance(noisy.unknowns[0].bounds, SupportedBounds)
    assert copied.unknowns[0].given is None
    assert copied.unknowns[0].bounds == Bounds(0.0, None)
    by_adam = replace(problem, method="adam")
    list(refits(replace(estimate, problem=by_adam), planned_refits(1, 0)))
    assert seen[-1].unknowns[0].given is None


def test_a_given_weight_that_falls_is_the_last_one_where_a_fit_goes_on():
    problem = problem_of(images(), Recipe(tv=(60.0, 5.0)))
    going_on = problem.again(problem.misfit, step_of(ball()), ball())
    assert [prior.weight(0, 20) for prior in going_on.priors] == [5.0, 0.5]
    anew = problem.again(problem.misfit, step_of(ball()))
    assert anew.priors[0].weight(0, 20) == 60.0


def test_a_fit_too_short_for_a_weight_by_its_noise_holds_the_first_one():
    """As one of two steps is: its weight is by the contrast, and so is that of the refits."""
    problem = problem_of(images())
    again = problem.again(problem.misfit, replace(step_of(ball()), weights=()))
    assert again.weight == replace(problem.weight, first=None, held=True)


def test_bars_of_an_empty_volume_are_nothing():
    problem = problem_of(images())

    def nothing(_):
        return step_of(torch.zeros(GRID.shape))

    estimate = Estimate(problem, nothing(problem), lambda images: torch.tensor(0.02), GaussianMisfit, nothing)
    found = bars_of(estimate, list(refits(estimate, planned_refits(2, 2))), 0.185)
    assert not found.total.any()
    assert found.typical(found.total) == 0.0
    assert all(known.value == known.error == 0.0 for known in found.regions[SPECIMEN][1].values())


# where a specimen ends


def test_a_specimen_ends_where_the_end_slices_hold_little_of_the_fullest():
    delta = torch.zeros(5, 4, 4)
    assert ends(delta) == (0.0, 0.0)
    delta[1:4, 1:3, 1:3] = torch.tensor([0.01, -0.02, 0.01])[:, None, None]
    delta[0, 1, 1] = 0.004
    assert ends(delta) == (pytest.approx(0.05), 0.0)
    assert open_ends(*ends(delta)) is None
    assert ends(delta[:2]) == (0.0, 0.0)  # no slice lies between


@pytest.mark.parametrize(
    ("first", "last", "words"),
    [
        (0.333, 0.49, "its first and last slices hold 33% and 49% of what the fullest does"),
        (0.0, 1.0, "its last slice holds 100% of what the fullest does"),
        (0.101, 0.099, "its first slice holds 10% of what the fullest does"),
    ],
)
def test_a_specimen_that_goes_on_is_told(first, last, words):
    assert open_ends(first, last) == words


def test_bars_of_a_specimen_that_goes_on_do_not_claim_to_hold():
    delta = torch.zeros(6, 8, 8)
    delta[:, 2:6, 2:6] = 0.02
    zeros = torch.zeros_like(delta)
    ends_within = delta.clone()
    ends_within[[0, -1]] = 0
    said = [list(_words(ErrorBars(GRID, d, zeros, zeros, 0.9, {}), 1.4))[-1] for d in (delta, ends_within)]
    assert said[0].startswith("the volume doesn't end within its depth: its first and last slices hold 100% and 100%")
    assert "two of three" not in said[0]
    assert said[1].startswith("the bars hold two of three voxels")


# in Python


def test_a_problem_alone_is_fitted_and_has_its_bars():
    """With the noise that its images show, and the numbers of the parts that are drawn."""
    problem = problem_of(images(), Recipe(steps=1))
    half = torch.zeros(GRID.shape, dtype=torch.bool)
    half[:, :12] = True
    found = error_bars(problem, noisy=2, copies=2, increment=0.2, outlines={"half": half})
    assert found.delta.shape == found.deviation.shape == found.total.shape == GRID.shape
    assert set(found.regions) == {SPECIMEN, "half"}
    assert bool((found.total >= found.deviation).all())
    assert float(found.deviation.max()) > 0


def test_the_noise_of_each_pixel_is_the_cameras_or_its_prisms():
    problem, bright = problem_of(images()), torch.full((1, 2, 24, 20), 0.5)
    by_camera = Estimate.of_fit(problem, step_of(ball()), NoiseModel(0.02, 0.1)).noise(bright)
    assert by_camera.flatten().tolist() == pytest.approx([math.sqrt(0.02 * 0.5 + 0.1**2)] * bright.numel())
    by_prism = Estimate.of_fit(problem, step_of(ball()), [0.03]).noise(bright)
    assert by_prism.flatten().tolist() == pytest.approx([0.03])
    measured = Estimate.of_fit(problem, step_of(ball())).noise(bright)
    assert measured.flatten().tolist() == pytest.approx([0.1 / math.sqrt(12)], rel=0.2)  # of numbers from 0 to 0.1


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"noisy": 1}, "noisy 1 must be at least 2"),
        ({"copies": 0}, "copies 0 must be at least 2"),
        ({"noise": [0.1, 0.1]}, "the noise is given of 2 prisms, the data have 1"),
        ({"noise": [-0.1]}, "the noise -0.1 of prism 1 must be at least 0 and finite"),
        ({"outlines": {"half": torch.ones(2, 3, 4) > 0}}, r"'half' is torch.bool of shape \(2, 3, 4\), it must be"),
    ],
)
def test_what_error_bars_cannot_be_of_is_refused(given, line):
    with pytest.raises(ValueError, match=line):
        error_bars(problem_of(images()), **given)


def test_a_misfit_that_cannot_be_made_again_is_refused_before_the_fit():
    problem = problem_of(images())
    with pytest.raises(NotImplementedError, match="absolute can't be made of other images"):
        error_bars(replace(problem, misfit=Absolute(images())))


def test_noise_that_cannot_be_measured_must_be_told():
    grid = Grid((2, 2, 2), (0.4, 0.2, 0.2))
    problem = problem_of(images()[..., :2, :2], grid=grid)
    with pytest.raises(ValueError, match="the noise of images so small can't be measured"):
        error_bars(problem, step_of(torch.zeros(grid.shape)))


# the command


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A reconstruction and its error bars, by the commands."""
    place = tmp_path_factory.mktemp("bars")
    (place / "bead.toml").write_text(CONFIG)
    config = str(place / "bead.toml")
    assert main(["simulate", config, "--out", str(place / "made"), "--device", "cpu"]) == 0
    assert main(["reconstruct", config, "--out", str(place / "run"), "--device", "cpu"]) == 0
    return place


def bars(folder, *more):
    return main(["error-bars", str(folder / "run"), "--device", "cpu", "--refits", "3", "--copies", "2", *more])


@pytest.fixture(scope="module")
def done(folder):
    assert bars(folder) == 0
    return folder / "run"


def test_it_leaves_volumes_a_figure_and_numbers(done):
    delta, grid = read_volume(done / "volume.ome.tif")
    for name in ("sd.ome.tif", "error.ome.tif"):
        volume, same = read_volume(done / name)
        assert volume.shape == delta.shape
        assert same.spacing == pytest.approx(grid.spacing)
        assert float(volume.min()) >= 0
        assert float(volume.max()) > 0
    told = json.loads((done / "error_bars.json").read_text())
    specimen = told["regions"]["specimen"]
    assert told["refits"]["noise"] == 3
    assert told["noise_interval"] > 0
    assert specimen["volume_um3"]["value"] == pytest.approx(4 / 3 * math.pi, rel=0.6)
    assert 1.4 < specimen["mean_index"]["value"] < 1.44
    assert specimen["dry_mass_pg"]["error"] > 0
    assert 0 < told["seen_share"] < 1
    assert (done / "error_bars.png").stat().st_size > 0
    assert len(list((done / "refits").glob("*.npy"))) == 6


@pytest.mark.filterwarnings("ignore::torchdic.errors.SamplingWarning")
def test_python_finds_the_same_bars_of_the_same_fit(done):
    """Bit for bit: the noise is measured alike, and each refit depends on its number alone."""
    read = reconstructed(done, torch.device("cpu"))
    found = error_bars(read.problem, read.step, noisy=3, copies=2)
    for name, bar in (("sd.ome.tif", found.deviation), ("error.ome.tif", found.total)):
        assert torch.equal(bar, read_volume(done / name)[0])


@pytest.mark.filterwarnings("always::recon.report.verdict.PoorFitWarning")
def test_a_model_that_does_not_explain_the_stack_is_warned_of(done, folder, capsys):
    """Its error is in no bar."""
    metrics = json.loads((done / "metrics.json").read_text())
    poor = {**metrics, "verdict": {**metrics["verdict"], "poor": True, "words": "misfit 1.7 × what noise leaves"}}
    (done / "metrics.json").write_text(json.dumps(poor))
    try:
        assert bars(folder) == 0
    finally:
        (done / "metrics.json").write_text(json.dumps(metrics))
    said = capsys.readouterr().err
    assert "misfit 1.7 × what noise leaves. What is wrong with the model is in no bar" in said


def test_the_refits_serve_again_for_other_regions(done, folder, capsys, monkeypatch):
    def never(*_):
        raise AssertionError("a refit was done again")

    monkeypatch.setattr("recon.run.evidence.error_bars.solved", never)
    labels = np.zeros((6, 26, 24), dtype=np.uint8)
    labels[:, 8:18, 7:17] = 3
    tifffile.imwrite(folder / "labels.tif", labels, metadata={"axes": "ZYX"})
    assert bars(folder, "--regions", str(folder / "labels.tif"), "--increment", "0.2") == 0
    out = capsys.readouterr().out
    assert "region 3" in out
    assert "pg more than its medium" in out
    told = json.loads((done / "error_bars.json").read_text())
    assert set(told["regions"]) == {"specimen", "region 3"}
    assert told["increment_ml_per_g"] == 0.2


def refused(folder, capsys, *more):
    capsys.readouterr()
    assert bars(folder, *more) == 2
    return [line for line in capsys.readouterr().err.splitlines() if "error:" in line][-1]


def test_labels_that_are_none_of_the_volume_are_refused(done, folder, capsys):
    tifffile.imwrite(folder / "other.tif", np.ones((6, 20, 24), dtype=np.uint8), metadata={"axes": "ZYX"})
    assert "other.tif: holds 6×20×24 labels, the volume 6×26×24" in refused(
        folder, capsys, "--regions", str(folder / "other.tif")
    )
    tifffile.imwrite(folder / "none.tif", np.zeros((6, 26, 24), dtype=np.uint8), metadata={"axes": "ZYX"})
    assert "no label other than 0" in refused(folder, capsys, "--regions", str(folder / "none.tif"))
    volume = str(done / "volume.ome.tif")
    line = refused(folder, capsys, "--regions", volume)
    assert f"{volume}: holds " in line
    assert line.endswith(" where a label is wanted, which is a whole number; 0 is none")


def test_a_folder_without_a_reconstruction_is_refused(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    assert "holds no finished reconstruction" in refused(tmp_path, capsys)


def test_refits_of_another_volume_are_replaced_only_on_request(done, folder, capsys):
    (done / "refits" / "identity.txt").write_text("another")
    assert "holds the refits of another volume; replace them with --restart" in refused(folder, capsys)
    assert len(list((done / "refits").glob("*.npy"))) == 6
    assert bars(folder, "--restart") == 0
    assert "another" not in (done / "refits" / "identity.txt").read_text()


def test_files_of_unknown_origin_are_not_thrown_away(done, folder, capsys):
    told = (done / "refits" / "identity.txt").read_text()
    (done / "refits" / "identity.txt").unlink()
    assert "replace them with --restart" in refused(folder, capsys)
    assert len(list((done / "refits").glob("*.npy"))) == 6
    (done / "refits" / "identity.txt").write_text(told)


def test_an_interruption_keeps_the_refits_so_far(done, folder, capsys, monkeypatch):
    before = (done / "refits" / "noise_00.npy").read_bytes()
    for file in ("noise_02.npy", "turned_01.npy"):
        (done / "refits" / file).unlink()

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("recon.run.evidence.error_bars.solved", stop)
        assert bars(folder) == 130
    assert "2 of 6 refits are left to do" in capsys.readouterr().err
    assert bars(folder) == 0
    assert (done / "refits" / "noise_00.npy").read_bytes() == before


@pytest.mark.parametrize("option", ["--refits", "--copies"])
def test_one_refit_tells_no_spread(folder, capsys, option):
    with pytest.raises(SystemExit):
        main(["error-bars", str(folder / "run"), option, "1"])
    assert "1 must be a number of at least 2" in capsys.readouterr().err


def test_another_volume_says_that_its_error_bars_are_old(done, folder, capsys):
    config = str(folder / "bead.toml")
    assert main(["reconstruct", config, "--out", str(done), "--device", "cpu", "--restart"]) == 0
    assert "those of an earlier volume" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        (("photons = 3000", "photons = 20"), "of the frequencies that the apertures let through: most of"),
        (("condenser = { na = 0.5 }", "condenser = { na = 0.0 }"), "these images hardly tell depth"),
        (("condenser = { na = 0.5 }", "condenser = { na = 0.5 }"), ""),
    ],
)
def test_what_the_images_cannot_say_stands_beside_the_verdict(tmp_path, capsys, changed, line):
    config = CONFIG.replace("steps = 4", "steps = 2").replace("[-1.0, 0.0, 1.0]", "[-2.0, -1.0, 0.0, 1.0, 2.0]")
    (tmp_path / "bead.toml").write_text(config.replace(*changed))
    named = str(tmp_path / "bead.toml")
    assert main(["simulate", named, "--out", str(tmp_path / "made"), "--device", "cpu"]) == 0
    assert main(["reconstruct", named, "--out", str(tmp_path / "run"), "--device", "cpu"]) == 0
    told = capsys.readouterr().out
    lacks = json.loads((tmp_path / "run" / "metrics.json").read_text())["seen"]["lacks"]
    assert (line in told) if line else lacks is None
    assert (lacks is None) == (line == "")
