"""Work and precision: errors are those of known answers, costs are counted, fronts hold no beaten point."""

import csv
import importlib
import itertools
import json
import math
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from results import BESIDE

from data_synthetic import Bead, GaussianBall
from recon.cli import main
from recon.cli.accuracy import work_precision as work_precision_command
from recon.config.conversion import converter, dump
from recon.config.reading import load
from recon.report.fronts import MARKS, as_dict, draw_fronts, marks_of, write_csv
from recon.run.exact_images import exact_images
from torchdic import (
    Acquisition,
    Candidate,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    Trial,
    Volume,
    image,
    work_precision,
)
from torchdic.files.whole import write_json
from torchdic.planning.image_error import FLOOR, image_error
from torchdic.planning.work_precision import (
    converged_fidelities,
    gradient_error,
    ladder,
    loss_weights,
    pareto_front,
    peak_bytes,
)

N0 = 1.36
GRID = Grid((6, 22, 24), (0.4, 0.2, 0.21))
SCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4))
# Bright field too: its own contrast is what its error is measured by.
ACQUISITION = Acquisition([Prism((0.05, 0.21), 1.1), None], [0.6, -0.9])


@pytest.fixture
def volume(smooth_field):
    return Volume(GRID, smooth_field(GRID, 0.02), N0)


def measured(volume, *candidates, reference, acquisition=ACQUISITION, **options):
    return work_precision(volume, SCOPE, acquisition, candidates, reference, repeats=1, **options)


# --- errors ---------------------------------------------------------------------------------------------------------


def test_error_is_the_worst_image_s_rms_over_its_contrast():
    """Of two images of ±1 and ±0.1 (those are their contrasts), both off by 0.05: 0.05 and 0.5."""
    sign = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(4, 2)
    expected = torch.stack([sign, 0.1 * sign])[:, None]
    assert image_error(expected + 0.05, expected) == pytest.approx(0.5, rel=1e-12)
    assert image_error(expected.transpose(0, 1) + 0.05, expected.transpose(0, 1)) == pytest.approx(0.5, rel=1e-12)


def test_empty_image_has_an_error_too():
    flat = torch.full((1, 1, 4, 4), 0.5, dtype=torch.float64)
    assert image_error(flat + 1e-4, flat) == pytest.approx(1e-4 / FLOOR, rel=1e-9)


@pytest.mark.parametrize("propagation", ["projection", "rays", "wave"])
def test_candidate_equal_to_the_reference_has_no_numerical_error(volume, propagation):
    fidelity = Fidelity(propagation, steps=4, sources=5)
    (trial,) = measured(volume, Candidate(fidelity, "float64"), reference=fidelity)
    assert trial.numerical_error == 0
    assert trial.numerical_gradient_error == 0
    assert (trial.model_error == 0) == (propagation == "wave")
    assert (trial.model_gradient_error == 0) == (propagation == "wave")


@pytest.mark.parametrize(("order", "steps"), [pytest.param(1, (48, 96, 192), marks=pytest.mark.slow), (2, (6, 12, 24))])
def test_error_of_the_wave_falls_with_the_order_of_its_steps(smooth_field, order, steps):
    """The error of n steps is C·n^−order where slabs sample the volume alike (it is uniform along z).

    Voxels of 0.6 µm hold no steep waves, of which a slab's scattering has only the first two terms.
    """
    grid = Grid((6, 22, 24), (0.4, 0.6, 0.6))
    column = Volume(grid, smooth_field(grid, 0.02)[2:3].expand(grid.shape).clone(), N0)
    candidates = [Fidelity("wave", n, order=order) for n in steps]
    found = work_precision(
        column, Microscope(0.546), ACQUISITION, candidates, Fidelity("wave", 8 * steps[-1]), repeats=1
    )
    for kind in ("numerical_error", "numerical_gradient_error"):
        errors = [getattr(trial, kind) for trial in found]
        slopes = [math.log2(a / b) for a, b in itertools.pairwise(errors)]
        # what is left is the next order's share, and the reference's own second-order error
        assert slopes == pytest.approx([order] * 2, abs=0.3), errors


def test_float32_has_a_floor_that_float64_has_not(volume):
    """The same numbers in float32: off by rounding, some 1e-7 a transform, over a contrast of about 0.1."""
    fidelity = Fidelity("wave", sources=5)
    single, double = measured(
        volume, Candidate(fidelity, "float32"), Candidate(fidelity, "float64"), reference=fidelity
    )
    assert double.numerical_error == 0
    for error in (single.numerical_error, single.numerical_gradient_error):
        assert 1e-8 < error < 1e-4


def test_gradient_is_that_of_finite_differences(volume):
    """Along a random direction, against central differences of the loss of the reference's own images."""
    fidelity = Fidelity("wave", sources=3)
    direction = torch.randn(GRID.shape, dtype=torch.float64) * 1e-5

    def loss(delta):
        images = image(Volume(GRID, delta, N0), SCOPE, ACQUISITION, fidelity)
        return float((images * loss_weights(images.shape)).sum())

    expected = (loss(volume.delta + direction) - loss(volume.delta - direction)) / 2
    delta = volume.delta.clone().requires_grad_()
    images = image(Volume(GRID, delta, N0), SCOPE, ACQUISITION, fidelity)
    (gradient,) = torch.autograd.grad((images * loss_weights(images.shape)).sum(), delta)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-4)
    # and it is this gradient's error that a trial reports
    rough = replace(fidelity, steps=2)
    (trial,) = measured(volume, rough, reference=fidelity)
    images = image(Volume(GRID, delta, N0), SCOPE, ACQUISITION, rough)
    (other,) = torch.autograd.grad((images * loss_weights(images.shape)).sum(), delta)
    assert trial.numerical_gradient_error == pytest.approx(float((other - gradient).norm() / gradient.norm()), rel=1e-9)
    assert gradient_error(other, gradient) == pytest.approx(trial.numerical_gradient_error, rel=1e-9)


@pytest.mark.slow
def test_numerical_and_model_errors_are_kept_apart():
    """Straight rays converge to their own answer, which is not that of the exact field; the wave's is."""
    ball, grid = GaussianBall(0.8, 0.05, N0), Grid((24, 40, 40), (0.25, 0.16, 0.16))
    volume = Volume(grid, ball.delta(grid), N0)
    acquisition = Acquisition([Prism((0.0, 0.2), 1.5)], [0.0, 1.0])
    reference = Fidelity("wave", sources=6, padding=20)
    exact = exact_images(ball, grid, SCOPE, acquisition, reference)
    straight, wave = (replace(reference, propagation=p) for p in ("projection", "wave"))
    found = measured(volume, straight, wave, reference=reference, acquisition=acquisition, exact=exact)
    assert [trial.numerical_error for trial in found] == [0, 0]
    assert found[0].model_error == pytest.approx(image_error(image(volume, SCOPE, acquisition, straight), exact))
    assert found[1].model_error < 0.01 < 0.04 < found[0].model_error
    # without an exact field the converged wave is the truth
    (against_wave,) = measured(volume, straight, reference=reference, acquisition=acquisition)
    assert against_wave.model_error == pytest.approx(found[0].model_error, abs=0.01)
    assert against_wave.model_error != found[0].model_error


@pytest.mark.parametrize(
    "options",
    [
        {"amplitude": False},
        pytest.param({"defocus": "paraxial"}, marks=pytest.mark.slow),
        pytest.param({"amplitude": False, "object_aberration": "linear"}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_model_options_are_the_candidate_s_own_in_its_converged_answer(volume, options):
    """Rays without amplitude, or with paraxial defocus, are other models: they converge to answers of their own."""
    reference = Fidelity("wave", steps=4, sources=4)
    (trial,) = measured(volume, Fidelity("rays", steps=4, sources=4, **options), reference=reference)
    assert trial.numerical_error == 0
    assert trial.model_error > 1e-3


def test_scene_s_absorption_and_learned_volume_take_part(volume):
    """An absorbing volume is compared with itself, and the caller's parameters get no gradient."""
    delta = torch.nn.Parameter(volume.delta.clone())
    absorbing = Volume(GRID, delta, N0, torch.full(GRID.shape, 1e-3, dtype=torch.float64))
    fidelity = Fidelity("wave", sources=3)
    exact = image(absorbing, SCOPE, ACQUISITION, fidelity).detach()
    (trial,) = measured(absorbing, fidelity, reference=fidelity, exact=exact)
    assert trial.model_error == 0
    assert delta.grad is None


def test_rays_that_turn_are_a_failure_with_its_reason():
    grid = Grid((8, 24, 24), (0.25, 0.1, 0.1))
    strong = Volume(grid, Bead(0.9, -0.3, 1.5).delta(grid), 1.5)
    scope = Microscope(0.546, Objective(1.2), Condenser(1.19))
    reference = Fidelity("wave", sources=9, steps=64)
    rays, wave = work_precision(
        strong, scope, Acquisition(), [replace(reference, propagation="rays"), reference], reference, repeats=1
    )
    assert rays.failure is not None
    assert "rays can't go on" in rays.failure
    assert rays.seconds is rays.model_error is rays.peak_bytes is None
    assert wave.failure is None
    assert wave.numerical_error == 0


# --- costs ----------------------------------------------------------------------------------------------------------


def test_peak_is_what_is_held_at_once():
    """Ten arrays of 8 kB one after the other are one at a time, and ten when they are kept."""

    def each(keep):
        kept = []
        for _ in range(10):
            array = torch.zeros(1000, dtype=torch.float64)
            kept = [*kept, array] if keep else [array]
            del array
        return len(kept)

    assert peak_bytes(lambda: each(True)) == (10, 80000)
    result, most = peak_bytes(lambda: each(False))
    assert result == 1
    assert 8000 <= most <= 16000


def test_bytes_grow_with_the_sources_and_the_digits_kept(volume):
    """In proportion to both, for the gradient keeps all sources' fields; without it less is held."""
    few, many = (Fidelity("wave", sources=n) for n in (2, 16))
    small, large, single = measured(volume, few, many, Candidate(many, "float32"), reference=few)
    assert 4 * small.gradient_peak_bytes < large.gradient_peak_bytes < 10 * small.gradient_peak_bytes
    assert single.gradient_peak_bytes == pytest.approx(large.gradient_peak_bytes / 2, rel=0.1)
    assert large.peak_bytes < 0.6 * large.gradient_peak_bytes
    assert large.seconds > 0
    assert large.gradient_seconds > 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_bytes_are_its_allocator_s():
    (_, most) = peak_bytes(lambda: torch.zeros(1 << 20, device="cuda"), "cuda")
    assert most == 4 << 20


# --- fronts ---------------------------------------------------------------------------------------------------------


def test_front_holds_what_no_other_point_beats():
    costs = [3.0, 1.0, 2.0, 4.0, 2.5, None, 1.5]
    errors = [0.1, 0.5, 0.2, 0.1, 0.3, 0.0, None]
    # 4 s at 0.1 is beaten by 3 s at 0.1, and 2.5 s at 0.3 by 2 s at 0.2
    assert pareto_front(costs, errors) == [1, 2, 0]


def test_of_equal_points_the_first_is_on_the_front():
    assert pareto_front([1.0, 1.0], [0.5, 0.5]) == [0]
    assert pareto_front([1.0, 1.0], [0.5, 0.2]) == [1]
    assert pareto_front([], []) == []


def test_ladder_climbs_from_projection_to_a_careful_wave_and_names_its_rungs():
    rungs = ladder(GRID)
    assert {rung.fidelity.propagation for rung in rungs} == {"projection", "rays", "wave"}
    assert {rung.dtype for rung in rungs} == {None, "float64"}
    assert len({rung.label for rung in rungs}) == len(rungs)
    for fidelity in (rung.fidelity for rung in rungs):
        best = converged_fidelities(rungs, GRID)[fidelity.propagation]
        assert best.steps >= 2 * (fidelity.steps or 6)
        assert best.sources > fidelity.sources
        assert best.padding >= fidelity.padding
        points, _ = Condenser(0.5).sources(best.sources, dtype=torch.float64)
        assert len(points) == best.sources
        assert float(torch.cdist(points, -points).min(1).values.max()) < 1e-6  # from opposite sides alike


def test_ladder_pads_no_specimen_that_reaches_the_sides():
    rungs = ladder(GRID, padded=False)
    assert {rung.fidelity.padding for rung in rungs} == {0}
    assert len({rung.label for rung in rungs}) == len(rungs) == len(ladder(GRID)) - 1


def test_label_says_what_is_not_a_default():
    fidelity = Fidelity("wave", steps=16, sources=12, order=1)
    assert Candidate(fidelity).label == "wave 12, 16 steps, order 1"
    assert Candidate(fidelity, "float64").label == "wave 12, 16 steps, order 1, float64"
    assert Candidate(fidelity, name="mine").label == "mine"


@pytest.fixture
def some_trials():
    mine = Candidate(Fidelity("wave", sources=3), "float32", 'a, "b"')
    return [
        Trial("mine", mine, 0.1, 0.3, 1000, 3000, 1e-3, 2e-3, 1e-2, 0.1),
        Trial("other", Candidate(Fidelity("projection")), 1 / 3, 1.0, 1, 2, 0.0, 0.3, 1e-5, 1.0),
        Trial("turned", Candidate(Fidelity("rays", steps=4)), failure="3 of 9 rays can't go on"),
    ]


def test_json_brings_the_trials_back(some_trials, tmp_path):
    write_json(tmp_path / "t.json", as_dict(some_trials, {"wave": Fidelity("wave", sources=60)}))
    found = json.loads((tmp_path / "t.json").read_text(encoding="utf-8"))
    assert [converter.structure(trial, Trial) for trial in found["trials"]] == some_trials
    assert found["reference"]["wave"]["sources"] == 60
    assert found["torch"] == torch.__version__


def test_csv_holds_a_row_for_each_trial_to_the_last_digit(some_trials, tmp_path):
    write_csv(tmp_path / "t.csv", some_trials)
    with (tmp_path / "t.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == ["mine", "other", "turned"]
    for row, trial in zip(rows, some_trials, strict=True):
        for key in ("seconds", "gradient_seconds", "numerical_error", "model_gradient_error"):
            assert (float(row[key]) if row[key] else None) == getattr(trial, key)
        assert row["propagation"] == trial.candidate.fidelity.propagation
        assert row["failure"] == (trial.failure or "")


def test_figure_names_the_front_and_only_it(some_trials):
    figure = draw_fronts({"scene": some_trials})
    words = {text.get_text() for axes in figure.axes for text in axes.texts}
    assert words == {"mine", "other"}
    beaten = replace(some_trials[0], name="beaten", seconds=9.0, gradient_seconds=9.0, numerical_error=1.0)
    beaten = replace(beaten, model_error=1.0, numerical_gradient_error=1.0, model_gradient_error=1.0)
    figure = draw_fronts({"scene": [*some_trials, beaten]})
    assert "beaten" not in {text.get_text() for axes in figure.axes for text in axes.texts}


def test_legend_says_what_the_marks_mean(some_trials):
    (legend,) = draw_fronts({"scene": some_trials}).legends
    words = {text.get_text() for text in legend.get_texts()}
    assert words == {"projection", "rays", "wave", "float64", "beaten by another", "Pareto front"}


def test_any_propagation_has_a_mark_of_its_own():
    """Those that the docs' figures show keep theirs, whatever appears beside them."""
    names = ["echo", "wave", "glow", "echo", "projection"]
    marks = marks_of(names)
    assert list(marks) == ["projection", "wave", "echo", "glow"]
    assert len(set(marks.values())) == 4
    assert all(marks[name] == MARKS[name] for name in ("projection", "wave"))
    many = marks_of(f"propagation {i}" for i in range(100))
    assert len(many) == 100


# --- the presets ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def benchmark():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
        yield importlib.import_module("accuracy")
        patch.delitem(sys.modules, "accuracy")


PROMISED = {
    "thin weak bead": {"DRAFT": 0.037, "STANDARD": 0.019, "REFERENCE": 0.017},
    "cell": {"DRAFT": 0.20, "STANDARD": 0.084, "REFERENCE": 0.012},
    "thick graded index": {"DRAFT": 0.039, "STANDARD": 0.036, "REFERENCE": 0.0035},
    "sharp strong bead": {"DRAFT": 0.31, "STANDARD": 0.071, "REFERENCE": 0.040},
}


@pytest.fixture(scope="module")
def truth(benchmark):
    """The exact images of a scene's specimen, or where there is no such field the wave's: padded, in thin slabs."""

    @cache
    def find(name):
        scene = benchmark.SCENES[name]
        parts = benchmark.MICROSCOPE, scene.acquisition
        if hasattr(scene.specimen, "field"):
            return exact_images(scene.specimen, scene.grid, *parts, Fidelity(sources=200))
        with torch.no_grad():
            return image(scene.volume(), *parts, Fidelity("wave", 2 * scene.grid.shape[0], 200, padding=16))

    return find


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        pytest.param(name, preset, marks=() if name == "thin weak bead" or preset == fast else pytest.mark.slow)
        for (name, presets), fast in zip(PROMISED.items(), ("", "", "", "DRAFT"), strict=True)
        for preset in presets
    ],
)
def test_preset_errs_by_what_it_says(benchmark, truth, name, preset):
    """Within a fifth of the tables of docs/accuracy.md, either way."""
    scene, error = benchmark.SCENES[name], PROMISED[name][preset]
    with torch.no_grad():
        images = image(scene.volume(), benchmark.MICROSCOPE, scene.acquisition, benchmark.PRESETS[preset])
    assert error / 1.2 < image_error(images, truth(name)) < 1.2 * error


@pytest.mark.parametrize("preset", ["DRAFT", "STANDARD", pytest.param("REFERENCE", marks=pytest.mark.slow)])
def test_presets_leave_an_empty_volume_empty(benchmark, preset):
    scene = benchmark.SCENES["empty"]
    with torch.no_grad():
        images = image(scene.volume(), benchmark.MICROSCOPE, scene.acquisition, benchmark.PRESETS[preset])
    assert image_error(images, torch.full_like(images, math.sin(float(benchmark.PRISM.bias) / 2) ** 2)) < 1e-4


# --- the command ------------------------------------------------------------------------------------------------------

CONFIG = """
[volume]
shape = [4, 14, 12]
spacing = [0.5, 0.25, 0.25]
background = 1.5
[microscope]
wavelength = 0.546
objective = { na = 0.6 }
condenser = { na = 0.3 }
[acquisition]
prisms = [{ shear = [0.0, 0.24], bias = 1.5 }]
[specimen]
kind = "bead"
radius = 0.6
contrast = 0.02
[work_precision]
repeats = 1
[work_precision.reference]
sources = 6
steps = 8
[[candidates]]
fidelity = { propagation = "projection", sources = 2 }
[[candidates]]
name = "best"
dtype = "float64"
fidelity = { sources = 6, steps = 8 }
"""


@pytest.fixture
def run(tmp_path, capfd):
    """A function that runs the command on a configuration: its exit code, and the lines on stderr."""

    def call(text):
        path = tmp_path / "config.toml"
        path.write_text(text, encoding="utf-8")
        code = main(["work-precision", str(path), "--out", str(tmp_path / "out"), "--device", "cpu"])
        return code, capfd.readouterr().err.splitlines()

    return call


def test_command_leaves_csv_json_and_a_figure(run, tmp_path):
    code, _ = run(CONFIG)
    assert code == 0
    out = tmp_path / "out"
    left = [*(f"work_precision.{kind}" for kind in ("csv", "json", "png")), "config.resolved.toml", *BESIDE]
    assert {path.name for path in out.iterdir()} == set(left)
    found = json.loads((out / "work_precision.json").read_text(encoding="utf-8"))
    straight, best = (converter.structure(trial, Trial) for trial in found["trials"])
    assert (straight.name, best.name) == ("projection 2", "best")
    assert best.numerical_error == best.numerical_gradient_error == best.model_gradient_error == 0
    # a bead has an exact field, which is the truth
    assert 1e-3 < best.model_error < straight.model_error
    assert found["reference"]["projection"]["steps"] == 8
    assert (out / "work_precision.png").read_bytes().startswith(b"\x89PNG")


def test_an_interrupted_command_keeps_what_it_has_measured(run, tmp_path, monkeypatch):
    original = work_precision_command.trials

    def stopped(*arguments, **options):
        for number, trial in enumerate(original(*arguments, **options)):
            if number == 1:
                raise KeyboardInterrupt
            yield trial

    monkeypatch.setattr(work_precision_command, "trials", stopped)
    code, told = run(CONFIG)
    assert code == 130
    assert "interrupted after 1 of 2 candidates" in told[-1]
    assert (tmp_path / "out" / "work_precision.csv").read_text(encoding="utf-8").count("projection 2") == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('dtype = "float64"', 'dtype = "float16"', "candidates[1]: dtype 'float16' must be one of"),
        ('dtype = "float64"', "digits = 3", "unknown key candidates[1].digits"),
        ("repeats = 1", "repeats = 0", "work_precision: repeats 0 must be at least 1"),
        ("sources = 2 }", "sources = 0 }", "candidates[0].fidelity: sources 0 must be a whole number of at least 1"),
        (
            "radius = 0.6",
            "radius = 0.6\nbackground = 1.4",
            "specimen.background 1.4 differs from volume.background 1.5",
        ),
        (CONFIG[CONFIG.index("[specimen]") : CONFIG.index("[work_precision]")], "", "missing key specimen"),
        (CONFIG[CONFIG.index("[[candidates]]") :], "", None),
    ],
)
def test_bad_configuration_is_one_line(run, tmp_path, old, new, message):
    text = CONFIG.replace(old, new)
    if message is None:
        text, message = "candidates = []\n" + text, "candidates must hold at least one"
    code, lines = run(text)
    assert code == 2
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "out").exists()


def test_candidates_and_reference_survive_the_dump(tmp_path):
    path, again = tmp_path / "a.toml", tmp_path / "b.toml"
    path.write_text(CONFIG, encoding="utf-8")
    config = load(path)
    again.write_text(dump(config), encoding="utf-8")
    assert list(load(again).candidates) == list(config.candidates)
    assert load(again).work_precision == config.work_precision
    assert config.candidates[1] == Candidate(Fidelity("wave", 8, 6), "float64", "best")
    assert config.work_precision.reference == Fidelity("wave", 8, 6)


# --- errors in one line -----------------------------------------------------------------------------------------------


def test_errors_state_the_value_and_the_law(volume):
    fidelity = Fidelity("wave", sources=1)
    with pytest.raises(ValueError, match="needs at least one candidate"):
        measured(volume, reference=fidelity)
    with pytest.raises(ValueError, match="repeats 0 must be at least 1"):
        work_precision(volume, SCOPE, ACQUISITION, [fidelity], fidelity, repeats=0)
    with pytest.raises(ValueError, match=r"exact images have shape \(1, 1, 2, 2\), the model's \(2, 2, 22, 24\)"):
        measured(volume, fidelity, reference=fidelity, exact=torch.zeros(1, 1, 2, 2))
    with pytest.raises(ValueError, match="reference has none for propagation 'rays', only for wave"):
        measured(volume, Fidelity("rays"), reference={"wave": fidelity})
    with pytest.raises(ValueError, match="dtype 'float16' must be one of 'float32', 'float64'"):
        Candidate(fidelity, "float16")
