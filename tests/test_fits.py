"""Work and precision of the fit: sensible candidates, errors against a truth, misfits over noise, kept results."""

import csv
import json
from dataclasses import replace

import pytest
import torch

from data_synthetic import Bead, CellPhantom
from recon.cli import main
from recon.config.conversion import dump
from recon.config.reading import load
from recon.config.schema import ConfigError
from recon.earlier.tikhonov import tikhonov
from recon.fit.bounds import Bounds
from recon.fit.problem import measured_noise
from recon.fit.setup import Setup, empty_medium
from recon.report.fit_fronts import draw_fits, fits_table, write_fits
from recon.report.fit_trial import FitCandidate, FitTrial
from recon.report.metrics import volume_error
from recon.run.data import load_data
from recon.run.fits.finer import FinerModel
from recon.run.fits.ladder import configured, fits_of, planes_of
from recon.run.fits.trials import Recorded, fit_trials
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import write_stack

CPU = torch.device("cpu")
TOML = """
[volume]
shape = [6, 28, 26]
spacing = [0.4, 0.2, 0.2]
background = 1.36
[microscope]
wavelength = 0.546
objective = { na = 0.8 }
condenser = { na = 0.5 }
camera = { photons = 5000 }
[acquisition]
focus = [-1.0, -0.5, 0.0, 0.5, 1.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }, { shear = [0.24, 0.0], bias = -1.5708 }]
"""
BEAD = '[specimen]\nkind = "bead"\nradius = 0.8\ncontrast = 0.02\n'
FEW = "[work_precision]\n"


@pytest.fixture
def config(tmp_path):
    """A function that writes a configuration with further lines, and returns its path."""

    def write(*further):
        path = tmp_path / "run.toml"
        path.write_text(TOML + "".join(further))
        return path

    return write


def work_precision(config, out, *options):
    return main(["work-precision", str(config), "--fit", "--out", str(out), "--device", "cpu", *options])


def kept(out):
    return json.loads((out / "fits.json").read_text())


# --- candidates -------------------------------------------------------------------------------------------------------


def test_newton_fits_by_the_wave_alone_and_direct_methods_have_no_propagation(config):
    found = fits_of(load(config(BEAD)))
    assert {(c.method, c.propagation) for c in found} == {
        ("newton", "wave"),
        ("adam", "wave"),
        ("adam", "rays"),
        ("adam", "projection"),
        ("linear", None),
        ("opl", None),
    }
    assert {c.planes for c in found} == {5, 3, 2}
    assert {c.directions for c in found if c.method == "newton"} == {32, 128}
    assert len(set(found)) == len(found) == 21


def test_each_combination_that_is_asked_for_is_tried_once(config):
    chosen = 'methods = ["newton", "linear"]\ndirections = [8, 18, 8]\nplanes = [5, 1]\n'
    found = fits_of(load(config(BEAD, FEW, chosen)))
    newton = [FitCandidate("newton", "wave", n, p) for p in (5, 1) for n in (8, 18)]
    assert found == [*newton, FitCandidate("linear", None, None, 5), FitCandidate("linear", None, None, 1)]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("planes = [6]", "work_precision.planes: 6 exceeds the stack's 5"),
        ("planes = []", "planes must hold at least one"),
        ("directions = [0]", "directions 0 must be at least 1"),
        ('methods = ["guess"]', "methods 'guess' must be among 'newton', 'adam', 'linear', 'opl'"),
        ('propagations = ["sound"]', "propagations 'sound' must be among"),
        ('methods = ["newton"]\npropagations = ["rays"]', "newton can't fit by rays"),
    ],
)
def test_candidates_that_make_no_sense_are_refused_in_one_line(config, line, message, tmp_path, capsys):
    assert work_precision(config(BEAD, FEW, line, "\n"), tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_planes_are_spread_evenly_over_the_stack():
    assert planes_of(5, 5) == [0, 1, 2, 3, 4]
    assert planes_of(3, 5) == [0, 2, 4]
    assert planes_of(5, 17) == [0, 4, 8, 12, 16]
    assert planes_of(1, 5) == [2]
    assert all(len(set(planes_of(n, 31))) == n for n in range(1, 32))


def test_steps_count_for_their_own_method_and_fidelity_for_its_own_propagation(config):
    own = '[reconstruction]\nmethod = "adam"\nsteps = 7\ntv = [3.0, 1.0]\n[fidelity]\npropagation = "rays"\nsteps = 3\n'
    whole = load(config(BEAD, own))
    adam, newton, straight = (
        configured(whole, FitCandidate(*how))
        for how in (("adam", "rays", 8, 3), ("newton", "wave", 32, 5), ("adam", "projection", 8, 5))
    )
    assert (adam.reconstruction.steps, newton.reconstruction.steps) == (7, None)
    assert {c.reconstruction.tv for c in (adam, newton, straight)} == {(3.0, 1.0)}
    assert adam.fidelity == Fidelity("rays", steps=3, sources=8)
    assert straight.fidelity == Fidelity("projection", 3, 8)
    assert list(map(float, adam.acquisition.focus)) == [-1.0, 0.0, 1.0]


def test_a_configuration_with_fits_is_written_and_read_again(config):
    text = 'methods = ["opl"]\npropagations = ["wave"]\ndirections = [8]\nplanes = [1, 5]\n'
    once = load(config(BEAD, FEW, text))
    again = config().with_name("again.toml")
    again.write_text(dump(once))
    assert load(again).work_precision == once.work_precision


# --- the stack --------------------------------------------------------------------------------------------------------


def test_finer_truth_is_the_mean_of_finer_voxels():
    grid, cell = Grid((4, 20, 18), (1.5, 0.5, 0.5)), CellPhantom()
    model = FinerModel((3, 2, 2))
    fine = cell.delta(model.grid(grid))
    truth = model.truth(cell, grid)
    assert truth.shape == grid.shape
    assert float(truth.double().sum()) * 12 == pytest.approx(float(fine.sum()), rel=1e-6)
    assert float(truth[1, 9, 8]) == pytest.approx(float(fine[3:6, 18:20, 16:18].mean()), rel=1e-6)


def test_a_specimens_stack_is_not_that_of_the_model_that_fits_it(config, monkeypatch, tmp_path):
    """Its images come from the exact field and carry the camera's noise: what is left is not 0 but the noise."""
    seen = []
    monkeypatch.setattr("recon.cli.accuracy.fits.fit_trials", lambda recorded, *_: seen.append(recorded) or iter(()))
    monkeypatch.setattr("recon.cli.accuracy.fits.fits_table", lambda _: "")
    monkeypatch.setattr("recon.cli.accuracy.fits.draw_fits", lambda _: None)
    path = config(BEAD)
    assert work_precision(path, tmp_path / "out") == 2  # no candidate was tried
    (recorded,) = seen
    whole, bead = load(path), Bead(0.8, 0.02, 1.36)
    volume = Volume(whole.volume.grid, bead.delta(whole.volume.grid), 1.36)
    modelled = image(volume, whole.microscope, whole.acquisition, Fidelity("wave", sources=128, padding=8))
    left = (torch.from_numpy(recorded.measured.data) - modelled).square().mean().sqrt()
    assert float(left) == pytest.approx((0.5 / 5000) ** 0.5, rel=0.1)
    assert recorded.truth is not None
    assert volume_error(recorded.truth, volume.delta.float()) < 0.02


# --- trials -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A weak bead's stack, from the wave with noise."""
    path = tmp_path_factory.mktemp("fits") / "run.toml"
    path.write_text(TOML + f'{BEAD}[data]\npath = "stack.ome.tif"\n')
    config = load(path)
    grid = config.volume.grid
    truth = Bead(0.8, 0.02, 1.36).delta(grid, dtype=torch.float32)
    images = image(Volume(grid, truth, 1.36), config.microscope, config.acquisition, Fidelity("wave", sources=50))
    data = Camera(photons=5000).record(images, torch.Generator().manual_seed(0))
    write_stack(path.with_name("stack.ome.tif"), data, grid.spacing[1:], 0.5)
    return Recorded(config, load_data(config), truth, CPU)


def shortened(recorded, **changes):
    """The same stack, fitted in fewer steps, or with other changes of [reconstruction]."""
    section = replace(recorded.config.reconstruction, **{"steps": 8, **changes})
    return replace(recorded, config=replace(recorded.config, reconstruction=section))


def test_a_trial_states_the_error_of_its_own_volume(recorded):
    """That of the linear estimate from two planes, found by itself."""
    (trial,) = fit_trials(recorded, [FitCandidate("linear", None, None, 2)])
    config, data = recorded.config, torch.from_numpy(recorded.measured.data)
    few = replace(config.acquisition, focus=[config.acquisition.focus[i] for i in (0, 4)])
    setup = Setup(empty_medium(config.volume.grid, 1.36, data), config.microscope, few)
    found = tikhonov(data[:, [0, 4]], setup, measured_noise(data), Bounds()).delta
    assert trial.volume_error == pytest.approx(volume_error(found, recorded.truth), rel=1e-4)
    assert trial.mass == pytest.approx(float(found.sum() / recorded.truth.sum()), rel=1e-4)
    assert trial.seconds > 0
    assert trial.peak_bytes > 4 * found.numel()


@pytest.mark.slow
def test_the_default_method_explains_the_noise_and_errs_least(recorded):
    tried = [FitCandidate("newton", "wave", 32, 5), FitCandidate("linear", None, None, 5)]
    newton, linear = fit_trials(shortened(recorded), tried)
    assert newton.volume_error < 0.7 * linear.volume_error
    assert newton.over_noise == pytest.approx(1, abs=0.05)
    assert newton.whole_over_noise == pytest.approx(1, abs=0.05)
    assert linear.whole_over_noise > newton.whole_over_noise


@pytest.mark.slow
def test_planes_that_were_left_out_tell_what_was_missed(recorded):
    """One plane is explained as well as its noise allows, and the other planes are not."""
    (trial,) = fit_trials(shortened(recorded), [FitCandidate("newton", "wave", 18, 1)])
    assert trial.over_noise < 1.03
    assert trial.whole_over_noise > trial.over_noise + 0.02


def test_planes_of_unknown_drift_are_not_judged(recorded):
    learned = shortened(recorded, learn=("drift",), steps=1)
    some, every = fit_trials(learned, [FitCandidate("newton", "wave", 8, n) for n in (3, 5)])
    assert some.misfit is not None
    assert some.whole_misfit is None
    assert every.whole_misfit is not None


def test_without_a_truth_the_misfit_is_all_that_is_told(recorded):
    (trial,) = fit_trials(replace(recorded, truth=None), [FitCandidate("opl", None, None, 5)])
    assert trial.volume_error is trial.mass is None
    assert trial.over_noise > 0


def test_a_clean_stacks_misfit_is_over_nothing(recorded):
    (trial,) = fit_trials(replace(recorded, noisy=False), [FitCandidate("opl", None, None, 5)])
    assert trial.noise_misfit == trial.whole_noise_misfit == 0
    assert trial.over_noise is trial.whole_over_noise is None
    assert trial.misfit > 0


def test_more_directions_hold_more_bytes(recorded):
    few = shortened(recorded, method="adam", steps=1, start="zero")
    trials = list(fit_trials(few, [FitCandidate("adam", "wave", n, 2) for n in (4, 64)]))
    assert trials[1].peak_bytes > 2 * trials[0].peak_bytes


def test_a_candidate_that_cannot_fit_says_why_and_the_next_one_goes_on(recorded):
    """Without a bias images don't change to first order, which all methods but Adam need."""
    prisms = [replace(prism, bias=0.0) for prism in recorded.config.acquisition.prisms]
    dark = replace(recorded.config, acquisition=replace(recorded.config.acquisition, prisms=prisms))
    adam = replace(dark.reconstruction, method="adam", start="zero", steps=1)
    tried = [FitCandidate("newton", "wave", 8, 1), FitCandidate("adam", "wave", 8, 1)]
    newton, other = fit_trials(replace(recorded, config=replace(dark, reconstruction=adam)), tried)
    assert "linear response" in newton.failure
    assert newton.seconds is None
    assert other.failure is None


# --- what is left in the folder ---------------------------------------------------------------------------------------

QUICK = 'methods = ["linear", "opl"]\nplanes = [5, 2]\n'


@pytest.fixture
def measured(recorded, config, tmp_path):
    """A function that writes a configuration with candidates, and the bead's stack beside it."""

    def write(candidates, data=recorded.measured.data):
        write_stack(tmp_path / "stack.ome.tif", torch.from_numpy(data), (0.2, 0.2), 0.5)
        return config('[data]\npath = "stack.ome.tif"\n', FEW, candidates)

    return write


def test_a_run_leaves_table_json_and_figure(config, tmp_path, capsys, monkeypatch):
    assert work_precision(config(BEAD, FEW, QUICK), tmp_path / "out") == 0
    found = kept(tmp_path / "out")
    assert found["complete"]
    assert [(t["candidate"]["method"], t["candidate"]["planes"]) for t in found["trials"]] == [
        ("linear", 5),
        ("linear", 2),
        ("opl", 5),
        ("opl", 2),
    ]
    with (tmp_path / "out" / "fits.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["volume_error"]) for row in rows] == [t["volume_error"] for t in found["trials"]]
    assert (tmp_path / "out" / "fits.png").stat().st_size > 10000
    printed = capsys.readouterr()
    assert printed.out.count("| linear |") == 2
    assert "4/4" in printed.err

    def made(*_):
        raise AssertionError("a stack was made before the folder was looked at")

    monkeypatch.setattr("recon.cli.accuracy.fits._recorded", made)
    assert work_precision(config(BEAD, FEW, QUICK), tmp_path / "out") == 2
    assert "--restart" in capsys.readouterr().err


@pytest.mark.usefixtures("no_pictures")
def test_an_interruption_loses_no_fit(measured, tmp_path, capsys, monkeypatch):
    """Ctrl-C in the third of four fits: two are kept, and the resumed run is as if there had been none."""
    path, out = measured(QUICK), tmp_path / "out"

    def interrupted(recorded, candidates, seen):
        for number, trial in enumerate(fit_trials(recorded, candidates, seen)):
            if number == 2:
                raise KeyboardInterrupt
            yield trial

    with monkeypatch.context() as patch:
        patch.setattr("recon.cli.accuracy.fits.fit_trials", interrupted)
        assert work_precision(path, out) == 130
    assert "interrupted after 2 of 4 fits; go on with --resume" in capsys.readouterr().err
    first = kept(out)
    assert not first["complete"]
    assert len(first["trials"]) == 2
    assert work_precision(path, out) == 2
    assert "go on with --resume or begin anew with --restart" in capsys.readouterr().err
    assert work_precision(path, out, "--resume") == 0
    whole = kept(out)
    assert whole["complete"]
    assert whole["trials"][:2] == first["trials"]
    assert len(whole["trials"]) == 4
    # further candidates of a finished run are added to what is known
    more = measured('methods = ["linear", "opl"]\nplanes = [5, 2, 1]\n')
    assert work_precision(more, out, "--resume") == 0
    assert {t["candidate"]["planes"] for t in kept(out)["trials"]} == {5, 2, 1}
    assert kept(out)["trials"][:4] == whole["trials"]


@pytest.mark.usefixtures("no_pictures")
def test_fits_of_another_stack_are_not_taken_over(measured, recorded, tmp_path, capsys):
    out, chosen = tmp_path / "out", 'methods = ["opl"]\nplanes = [1]\n'
    assert work_precision(measured(chosen), out) == 0
    brighter = measured(chosen, 1.01 * recorded.measured.data)
    assert work_precision(brighter, out, "--resume") == 2
    assert "another configuration or stack" in capsys.readouterr().err
    assert work_precision(brighter, out, "--restart") == 0
    (out / "fits.json").write_text("{}")
    assert work_precision(brighter, out, "--resume") == 2
    assert "holds no trials of this version" in capsys.readouterr().err


@pytest.mark.usefixtures("no_pictures")
def test_a_measured_stack_is_judged_by_its_noise(measured, tmp_path, capsys):
    assert work_precision(measured('methods = ["opl"]\nplanes = [5]\n'), tmp_path / "out") == 0
    (trial,) = kept(tmp_path / "out")["trials"]
    assert trial["volume_error"] is None
    assert trial["misfit"] / trial["noise_misfit"] > 1
    assert "truth isn't known" in capsys.readouterr().out


def test_nothing_to_fit_is_refused(config, tmp_path, capsys):
    assert work_precision(config(), tmp_path / "out") == 2
    assert "missing key specimen or data.path" in capsys.readouterr().err


def test_resume_goes_with_fit(config, tmp_path, capsys):
    typed = ["work-precision", str(config(BEAD)), "--out", str(tmp_path / "out"), "--device", "cpu", "--resume"]
    assert main(typed) == 2
    assert "--resume goes with --fit" in capsys.readouterr().err


# --- tables and figures -----------------------------------------------------------------------------------------------


def trial(method, error, seconds, **further):
    numbers = {"misfit": 0.2, "noise_misfit": 0.1, "whole_misfit": 0.3, "whole_noise_misfit": 0.1}
    known = {"volume_error": error, "seconds": seconds, "peak_bytes": 2**20, **numbers, **further}
    return FitTrial(FitCandidate(method, None, None, 3), **known)


def test_a_table_shows_misfits_over_noise_and_those_without_noise_in_brackets(tmp_path):
    failed = FitTrial(FitCandidate("newton", "wave", 8, 1), failure="no light")
    rows = fits_table([trial("opl", 0.5, 1.0), trial("linear", None, 1.0, noise_misfit=0.0), failed]).splitlines()
    assert "| 0.500 |  | 2.000 | 3.000 |" in rows[2]
    assert "| (0.2) |" in rows[3]
    assert rows[4].startswith("| newton | wave | 8 | 1 | no light |")
    assert len({row.count("|") for row in rows}) == 1
    write_fits(tmp_path / "fits.csv", [failed])
    assert "no light" in (tmp_path / "fits.csv").read_text()


def test_fronts_name_the_fits_that_no_other_beats():
    trials = [trial("opl", 0.7, 0.1), trial("linear", 0.5, 1.0), trial("adam", 0.6, 9.0), trial("newton", 0.1, 8.0)]
    seconds, bytes_ = draw_fits({"bead": trials}).axes
    assert [text.get_text() for text in seconds.texts] == ["opl, 3 planes", "linear, 3 planes", "newton, 3 planes"]
    assert [text.get_text() for text in bytes_.texts] == ["newton, 3 planes"]
    assert seconds.get_ylabel().startswith("error of Δn")
    unknown = [replace(t, volume_error=None) for t in trials]
    assert draw_fits({"stack": unknown}).axes[0].get_ylabel() == "misfit of all planes over noise"


def test_planes_beyond_the_stack_are_an_error_of_the_configuration(config):
    with pytest.raises(ConfigError, match="exceeds the stack's 5"):
        fits_of(load(config(BEAD, FEW, "planes = [9]\n")))


def test_the_cells_stack_has_the_configurations_pixels():
    """A specimen without an exact field comes from the finer model, in a wider field than the recorded one."""
    grid, microscope = Grid((3, 32, 30), (2.0, 0.3, 0.3)), Microscope(0.546, Objective(0.4), Condenser(0.2))
    acquisition = Acquisition([Prism((0.0, 0.24), 1.5)])
    images = FinerModel((2, 2, 2), 3, 4).images(CellPhantom(), grid, microscope, acquisition)
    assert images.shape == (1, 1, 32, 30)
    assert float(images.std()) > 0.01
