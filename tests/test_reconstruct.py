import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile
import tomli_w
import torch
from absolute import Absolute
from matplotlib import image as pictures
from results import BESIDE, RESULTS

from data_synthetic import GaussianBall
from recon.cli import main
from recon.config.reading import load
from recon.misfit.gaussian import GaussianMisfit
from recon.report import figures
from recon.report.metrics import volume_error
from recon.report.verdict import PoorFitWarning
from recon.run import reconstruct, recorded, results
from recon.run.checkpoint import CheckpointError
from torchdic import Grid, ShortOfMemoryError, Volume, image
from torchdic.files.stack import read_stack, read_volume, write_stack

GRID = Grid((5, 14, 12), (0.5, 0.2, 0.21))
CONFIG = {
    "volume": {"shape": list(GRID.shape), "spacing": list(GRID.spacing), "background": 1.5},
    "microscope": {"wavelength": 0.546, "objective": {"na": 0.7}, "condenser": {"na": 0.4}},
    "acquisition": {
        "focus": [-1.0, 0.0, 1.0],
        "prisms": [{"shear": [0.0, 0.24], "bias": 1.5}, {"shear": [0.24, 0.0], "bias": -1.2}],
    },
    "fidelity": {"sources": 6, "order": 1},
    "reconstruction": {"checkpoint_every": 5, "draft_sources": 3},
    "specimen": {"kind": "gaussian_ball", "sigma": 0.5, "contrast": 0.02, "centre": [0.3, -0.3, 0.4]},
    "data": {"path": "simulated/stack.ome.tif"},
}


def merged(changes):
    """The configuration with changes {section: {key: value}}, as TOML."""
    values = {section: {**table, **changes.get(section, {})} for section, table in CONFIG.items()}
    return tomli_w.dumps(values | {k: v for k, v in changes.items() if k not in values})


def command(*arguments):
    """Run a command; returns (exit code, stderr)."""
    err = io.StringIO()
    with redirect_stderr(err), redirect_stdout(io.StringIO()):
        code = main([str(a) for a in arguments])
    return code, err.getvalue()


def content(folder):
    """Every file below a folder, hidden ones too, with its bytes."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def rows(folder):
    with (folder / "log.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def volume(folder):
    return read_volume(folder / "volume.ome.tif")[0]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the configuration, its simulated stack, and an uninterrupted reconstruction in `whole`."""
    folder = tmp_path_factory.mktemp("workplace")
    (folder / "config.toml").write_text(merged({}), encoding="utf-8")
    assert command("simulate", folder / "config.toml", "--out", folder / "simulated") == (0, "")
    code, err = command("reconstruct", folder / "config.toml", "--out", folder / "whole")
    assert code == 0
    assert "misfit=" in err  # the progress bar
    assert "warning" not in err
    return folder


@pytest.fixture(params=["newton", "adam"])
def method(request):
    return request.param


@pytest.fixture(autouse=True)
def _pictures_in_the_workplace_only(workplace, no_pictures):
    pass


@pytest.fixture
def other(workplace, tmp_path):
    """A function from changes of the configuration to a file of its own, on the same stack unless it says otherwise."""

    def put(changes=None):
        changes = dict(changes or {})
        changes["data"] = {"path": str(workplace / "simulated" / "stack.ome.tif")} | changes.get("data", {})
        path = tmp_path / "other.toml"
        path.write_text(merged(changes), encoding="utf-8")
        return path

    return put


# what simulate leaves


def test_simulate_leaves_a_stack_and_its_picture(workplace):
    assert set(content(workplace / "simulated")) == {"stack.ome.tif", "stack.png", "config.resolved.toml", *BESIDE}
    assert pictures.imread(workplace / "simulated" / "stack.png").std() > 0


def test_the_simulated_stacks_axes_are_prism_and_focus(workplace):
    path = workplace / "simulated" / "stack.ome.tif"
    with tifffile.TiffFile(path) as tif:
        assert tif.series[0].axes == "CZYX"
        assert tif.series[0].shape == (2, 3, 14, 12)
    stack = read_stack(path)
    assert stack.data.dtype == np.float32
    assert stack.pixel_size == (0.2, 0.21)
    assert stack.focus_step == 1.0


def test_the_simulated_stack_is_the_models_images(workplace):
    config = load(workplace / "config.toml")
    truth = GaussianBall(0.5, 0.02, 1.5, (0.3, -0.3, 0.4)).delta(GRID, dtype=torch.float32)
    with torch.no_grad():
        expected = image(Volume(GRID, truth, 1.5), config.microscope, config.acquisition, config.fidelity)
    assert np.array_equal(read_stack(workplace / "simulated" / "stack.ome.tif").data, expected.numpy())


@pytest.mark.parametrize(
    ("focus", "step"),
    [([0.5], None), ([0.88, 0.44, 0.0, -0.44], 0.44), ([0.0, 0.5, 2.0], None), ([0.1, 0.2, 0.3], 0.1)],
)
def test_a_focus_step_is_written_only_where_there_is_one(other, tmp_path, focus, step):
    """Its size, also where the planes run backwards, without the rounding of a difference."""
    path = other({"acquisition": {"focus": focus}})
    assert command("simulate", path, "--out", tmp_path / "out")[0] == 0
    stack = read_stack(tmp_path / "out" / "stack.ome.tif")
    assert stack.data.shape[1] == len(focus)
    assert stack.focus_step == step


def test_the_same_seed_gives_the_same_noise_and_another_one_another(other, tmp_path):
    camera = {**CONFIG["microscope"], "camera": {"photons": 2000, "read_noise": 3.0}}
    made = {}
    for name, seed in (("first", 5), ("again", 5), ("else", 6)):
        path = other({"microscope": camera, "simulation": {"seed": seed}})
        assert command("simulate", path, "--out", tmp_path / name)[0] == 0
        made[name] = read_stack(tmp_path / name / "stack.ome.tif").data
    assert np.array_equal(made["first"], made["again"])
    assert not np.array_equal(made["first"], made["else"])


def test_simulated_noise_is_that_of_photons_and_read_out(other, workplace, tmp_path):
    photons, read_noise = 2000, 30.0
    camera = {**CONFIG["microscope"], "camera": {"photons": photons, "read_noise": read_noise}}
    assert command("simulate", other({"microscope": camera}), "--out", tmp_path / "noisy")[0] == 0
    clean = read_stack(workplace / "simulated" / "stack.ome.tif").data
    noise = read_stack(tmp_path / "noisy" / "stack.ome.tif").data - clean
    expected = clean / photons + (read_noise / photons) ** 2
    # 5 standard errors of the mean, and of the variance
    assert abs(noise.mean()) < 5 * np.sqrt(expected.mean() / noise.size)
    assert noise.var() == pytest.approx(expected.mean(), rel=5 * np.sqrt(2 / noise.size))


# what reconstruct leaves


def test_reconstruct_leaves_its_results_and_nothing_else(workplace):
    assert set(content(workplace / "whole")) == RESULTS


def test_the_volume_is_float32_with_the_voxel_size(workplace):
    delta, grid = read_volume(workplace / "whole" / "volume.ome.tif")
    assert grid == GRID
    with tifffile.TiffFile(workplace / "whole" / "volume.ome.tif") as tif:
        assert tif.series[0].dtype == np.float32
        assert np.array_equal(tif.asarray().squeeze(), delta.numpy())
        pixels = ElementTree.fromstring(tif.ome_metadata).find(".//{*}Pixels")
    sizes = [float(pixels.get(f"PhysicalSize{axis}")) for axis in "ZYX"]
    assert sizes == list(GRID.spacing)
    assert {pixels.get(f"PhysicalSize{axis}Unit", "µm") for axis in "ZYX"} == {"µm"}
    assert [int(pixels.get(f"Size{axis}")) for axis in "ZYX"] == list(GRID.shape)


def test_a_range_that_ends_at_minus_0_ends_at_0():
    assert [f"{value:g}" for value in results.summary(torch.tensor([[[-0.02, -0.0]]])).values()] == [
        "-0.02",
        "0",
        "-0.01",
    ]


def test_the_volume_is_the_specimen_as_far_as_it_can_be_seen(workplace):
    truth = GaussianBall(0.5, 0.02, 1.5, (0.3, -0.3, 0.4)).delta(GRID, dtype=torch.float32)
    found = volume(workplace / "whole")
    assert volume_error(found, truth) < 0.7
    assert float(found.min()) >= 0
    for axis in range(3):
        assert volume_error(found.flip(axis), truth) > volume_error(found, truth) + 0.1


def test_the_metrics_are_those_of_the_volume_left(workplace):
    def never(name):
        raise AssertionError(f"{name} is no JSON")

    text = (workplace / "whole" / "metrics.json").read_text(encoding="utf-8")
    metrics = json.loads(text, parse_constant=never)
    found = volume(workplace / "whole")
    config = load(workplace / "config.toml")
    data = torch.from_numpy(read_stack(workplace / "simulated" / "stack.ome.tif").data)
    with torch.no_grad():
        images = image(Volume(GRID, found, 1.5), config.microscope, config.acquisition, config.fidelity)
    images = images * torch.tensor(metrics["learned"]["brightness"])[..., None, None]
    assert metrics["misfit"] == pytest.approx(GaussianMisfit(data)(images).item(), rel=1e-5)
    assert metrics["misfit"] < 0.02
    assert metrics["residual_rms"] == pytest.approx(((images - data) ** 2).mean((1, 2, 3)).sqrt().tolist(), rel=1e-4)
    assert metrics["delta"]["max"] == float(found.max())
    assert metrics["steps"] == len(rows(workplace / "whole"))
    assert metrics["method"] == "newton"
    assert metrics["tv"] == metrics["weights"][-1]["tv"] > 0
    assert metrics["propagation"] == "wave"
    assert [report["bias"] for report in metrics["prisms"]] == [1.5, -1.2]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["newton", "adam"])
def test_another_misfit_is_in_the_metrics_and_the_log_by_its_own_value(other, workplace, tmp_path, method):
    given = {"newton": {"steps": 12}, "adam": {"steps": 8, "tv": [60.0, 5.0], "prior": "tv"}}[method]
    path, out = other({"reconstruction": {"method": method, **given}}), tmp_path / "out"
    reconstruct.reconstruct(load(path), out, torch.device("cpu"), misfit=Absolute)
    config, found = load(path), volume(out)
    data = torch.from_numpy(read_stack(workplace / "simulated" / "stack.ome.tif").data)
    with torch.no_grad():
        images = image(Volume(GRID, found, 1.5), config.microscope, config.acquisition, config.fidelity)
    metrics = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    images = images * torch.tensor(metrics["learned"]["brightness"])[..., None, None]
    assert metrics["misfit"] == pytest.approx(Absolute(data)(images).item(), rel=1e-5)
    log = [float(row["misfit"]) for row in rows(out)]
    assert metrics["misfit"] < 0.6 * log[0]
    assert log[-1] < 0.6 * log[0]


def test_the_log_has_every_step_once(workplace):
    log = rows(workplace / "whole")
    assert list(log[0]) == ["step", "misfit", "loss", "seconds"]
    assert [int(row["step"]) for row in log] == list(range(1, len(log) + 1))
    assert 7 < len(log) <= 20
    assert float(log[-1]["misfit"]) < 0.1 * float(log[0]["misfit"])
    assert all(float(row["loss"]) >= float(row["misfit"]) > 0 for row in log)


def test_the_resolved_configuration_gives_the_same_volume(workplace, tmp_path):
    whole = workplace / "whole"
    values = tomllib.loads((whole / "config.resolved.toml").read_text(encoding="utf-8"))
    expected = {"method": "newton", "steps": 20, "learning_rate": 5e-3, "tv": "auto", "l1": 0.25, "margin": "auto"}
    assert values["reconstruction"].items() >= expected.items()  # defaults, spelled out
    assert command("reconstruct", whole / "config.resolved.toml", "--out", tmp_path / "again")[0] == 0
    assert torch.equal(volume(tmp_path / "again"), volume(whole))
    again = (tmp_path / "again" / "config.resolved.toml").read_bytes()
    assert again == (whole / "config.resolved.toml").read_bytes()


def test_the_pictures_are_pictures(workplace):
    for name in ("images.png", "sections.png", "misfit.png"):
        picture = pictures.imread(workplace / "whole" / name)
        assert min(picture.shape[:2]) > 100
        assert picture[..., :3].std() > 0.01


def test_a_run_in_a_folder_of_results_replaces_them_where_asked(other, tmp_path):
    few = other({"reconstruction": {"steps": 3}})
    assert command("reconstruct", few, "--out", tmp_path / "out")[0] == 0
    few = other({"reconstruction": {"steps": 4}})
    assert command("reconstruct", few, "--out", tmp_path / "out", "--restart")[0] == 0
    assert len(rows(tmp_path / "out")) == 4
    assert json.loads((tmp_path / "out" / "metrics.json").read_text(encoding="utf-8"))["steps"] == 4
    assert set(content(tmp_path / "out")) == RESULTS


def test_without_a_fidelity_the_recommended_wave_is_used_and_recorded(workplace, tmp_path, method):
    values = tomllib.loads(merged({"reconstruction": {"steps": 2, "method": method}}))
    del values["fidelity"]
    values["data"]["path"] = str(workplace / "simulated" / "stack.ome.tif")
    (tmp_path / "plain.toml").write_text(tomli_w.dumps(values), encoding="utf-8")
    assert command("reconstruct", tmp_path / "plain.toml", "--out", tmp_path / "out")[0] == 0
    recommended = {"newton": reconstruct.RECOMMENDED, "adam": reconstruct.RECOMMENDED_FOR_ADAM}[method]
    assert load(tmp_path / "out" / "config.resolved.toml").fidelity == recommended
    assert recommended.propagation == "wave"


@pytest.mark.parametrize(
    "acquisition",
    [
        {"focus": [0.0], "prisms": [{"shear": [0.1, 0.2], "bias": -1.2}]},
        {"focus": [-0.5, 0.5], "prisms": ["brightfield"]},
    ],
    ids=["one image", "bright field"],
)
@pytest.mark.parametrize("method", [pytest.param("newton", marks=pytest.mark.slow), "adam"])
def test_any_acquisition_goes_from_specimen_to_volume(other, tmp_path, acquisition, method):
    path = other(
        {
            "acquisition": acquisition,
            "data": {"path": str(tmp_path / "simulated" / "stack.ome.tif")},
            "reconstruction": {"steps": 5, "method": method},
        }
    )
    assert command("simulate", path, "--out", tmp_path / "simulated")[0] == 0
    assert command("reconstruct", path, "--out", tmp_path / "out")[0] == 0
    assert set(content(tmp_path / "out")) == RESULTS
    assert float(rows(tmp_path / "out")[-1]["misfit"]) < 1


def test_one_slice_of_one_2d_image_is_reconstructed(other, workplace, tmp_path, method):
    plane = read_stack(workplace / "simulated" / "stack.ome.tif").data[0, 1]
    write_stack(tmp_path / "plane.tif", plane)
    path = other(
        {
            "volume": {"shape": [1, 14, 12]},
            "acquisition": {"focus": [0.0], "prisms": [{"shear": [0.0, 0.24], "bias": 1.5}]},
            "data": {"path": str(tmp_path / "plane.tif")},
            "reconstruction": {"steps": 5, "method": method},
        }
    )
    assert command("reconstruct", path, "--out", tmp_path / "out")[0] == 0
    assert read_volume(tmp_path / "out" / "volume.ome.tif")[1] == Grid((1, 14, 12), (0.5, 0.2, 0.21))


# a camera's stack


def test_a_cameras_counts_are_flattened_and_scaled_to_the_models_unit(other, tmp_path):
    wide = {"volume": {"shape": [5, 36, 32]}, "reconstruction": {"steps": 5}}
    simulated = {"data": {"path": str(tmp_path / "simulated" / "stack.ome.tif")}}
    assert command("simulate", other(wide), "--out", tmp_path / "simulated")[0] == 0
    assert command("reconstruct", other(wide | simulated), "--out", tmp_path / "clean")[0] == 0
    # a lamp uneven by a third, 100 dark counts
    data = read_stack(tmp_path / "simulated" / "stack.ome.tif").data
    lamp = 1 + 0.1 * np.linspace(-1, 1, 36)[:, None] - 0.06 * np.linspace(-1, 1, 32)
    path = tmp_path / "counts.ome.tif"
    write_stack(path, np.round(20000 * lamp * data + 100).astype(np.uint16), (0.2, 0.21), 1.0, compression="zlib")
    likeness = {}
    for name, options in (("flat", {}), ("uneven", {"flatten": False})):
        config = other(wide | {"data": {"path": str(path), "offset": 100, **options}})
        code, err = command("reconstruct", config, "--out", tmp_path / name)
        assert code == 0
        assert "warning" not in err  # the file's sizes agree
        pair = volume(tmp_path / name).flatten(), volume(tmp_path / "clean").flatten()
        likeness[name] = float(torch.cosine_similarity(*pair, 0))
    assert likeness["flat"] > 0.99
    assert likeness["uneven"] < 0.8
    report = json.loads((tmp_path / "flat" / "metrics.json").read_text(encoding="utf-8"))["prisms"][0]
    assert report["scale"] == pytest.approx(20000, rel=0.005)
    assert report["background"] == pytest.approx(20000 * np.sin(0.75) ** 2, rel=0.005)
    assert report["unevenness"] == pytest.approx(0.32, abs=0.01)


@pytest.mark.filterwarnings("default::torchdic.tiff.StackWarning")
def test_a_pixel_size_that_disagrees_is_warned_of_and_the_configs_wins(other, workplace, tmp_path):
    data = read_stack(workplace / "simulated" / "stack.ome.tif").data
    write_stack(tmp_path / "other.ome.tif", data, (0.3, 0.21), 1.0)
    path = other({"data": {"path": str(tmp_path / "other.ome.tif")}, "reconstruction": {"steps": 2}})
    code, err = command("reconstruct", path, "--out", tmp_path / "out")
    assert code == 0
    assert err.count("torchdic: warning: ") == 1
    assert "0.3 × 0.21 µm" in err
    assert "the config's are used; correct volume.spacing or pixel_size if the file is right" in err
    assert read_volume(tmp_path / "out" / "volume.ome.tif")[1] == GRID


# failures


@pytest.fixture
def earlier(other, tmp_path):
    """A folder with the results of an earlier run."""
    assert command("reconstruct", other({"reconstruction": {"steps": 3}}), "--out", tmp_path / "out")[0] == 0
    return tmp_path / "out"


def test_bad_input_leaves_earlier_results_alone(other, earlier, tmp_path):
    before = content(earlier)
    (tmp_path / "bad.tif").write_bytes(b"no stack")
    for path in (other({"data": {"path": str(tmp_path / "bad.tif")}}), other({"microscope": {"wavelength": -1}})):
        assert command("reconstruct", path, "--out", earlier)[0] == 2
        assert content(earlier) == before


def test_a_descent_that_diverges_leaves_earlier_results_alone(other, earlier):
    before = content(earlier)
    path = other({"reconstruction": {"method": "adam", "learning_rate": 1e30}})
    code, err = command("reconstruct", path, "--out", earlier, "--restart")
    assert code == 1
    assert "torchdic: error: the descent diverged at step 2: " in err
    assert "a smaller learning_rate" in err
    assert "Traceback" not in err
    after = content(earlier)
    assert set(after) == RESULTS
    assert [name for name in RESULTS - {"log.csv"} if after[name] != before[name]] == []


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ValueError("no light"), "no light"),
        (
            MemoryError("Unable to allocate 2.5 GiB for an array"),
            "the memory ran out: another 2.5 GiB were .* need less,.*",
        ),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 2147483648 bytes."),
            "memory .* 2 GiB .*",
        ),
        (FloatingPointError("diverged"), "diverged"),
    ],
)
def test_a_descent_that_fails_leaves_the_volume_of_its_last_good_step(other, tmp_path, monkeypatch, error, told):
    """Where the fit diverges, the last step may be what made it: the one before has a volume that was judged."""
    original, out = recorded.minimise, tmp_path / "out"

    def minimise(*arguments):
        for step in original(*arguments):
            if step.number == 4:
                raise error
            yield step

    monkeypatch.setattr(recorded, "minimise", minimise)
    good = 2 if isinstance(error, FloatingPointError) else 3
    kind = ShortOfMemoryError if "memory" in told else type(error)
    with pytest.raises(kind, match=rf"{told}; stopped after step {good} of 8; go on with --resume; volume.ome"):
        reconstruct.reconstruct(load(other({"reconstruction": {"steps": 8}})), out, torch.device("cpu"))
    assert set(content(out)) == {"log.csv", "checkpoint.pt", "volume.ome.tif"}
    assert read_stack(out / "volume.ome.tif").names == (f"delta n, interrupted after step {good}",)
    monkeypatch.setattr(recorded, "minimise", original)
    prolonged = load(other({"reconstruction": {"steps": 4}}))
    result = reconstruct.reconstruct(prolonged, out, torch.device("cpu"), resume=True)
    assert result.metrics["steps"] == 4


def test_a_volume_that_cannot_be_judged_is_left(other, tmp_path, monkeypatch):
    def no_images(*_):
        raise ValueError("no light")

    monkeypatch.setattr(results, "model_images", no_images)
    with pytest.raises(ValueError, match=r"no light; go on with --resume; volume\.ome\.tif holds Δn so far"):
        reconstruct.reconstruct(load(other({"reconstruction": {"steps": 2}})), tmp_path / "out", torch.device("cpu"))


# interruptions

# Far more than a signal's sender may miss on a busy machine.
LONG = 120


@pytest.fixture(scope="module")
def long(workplace):
    """(configuration, folder of results) of an uninterrupted run that takes long enough to be hit on its way."""
    path = workplace / "long.toml"
    path.write_text(merged({"reconstruction": {"method": "adam", "steps": LONG}}), encoding="utf-8")
    assert command("reconstruct", path, "--out", workplace / "long")[0] == 0
    return path, workplace / "long"


def interrupted(path, out, number, wanted=12):
    """Run `torchdic reconstruct` in a process, send it a signal when its log has so many rows; its exit code."""
    script = Path(sys.executable).with_name("torchdic")
    env = {**os.environ, "OMP_NUM_THREADS": str(torch.get_num_threads()), "OMP_WAIT_POLICY": "PASSIVE"}
    process = subprocess.Popen(
        [script, "reconstruct", path, "--out", out],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=env,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background inherits a deaf ear
    )
    try:
        limit = time.monotonic() + 100
        while not (out / "log.csv").exists() or (out / "log.csv").read_bytes().count(b"\n") < wanted + 1:
            assert process.poll() is None, process.stderr.read().decode()
            assert time.monotonic() < limit
            time.sleep(0.002)
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    return process.returncode, err.decode("utf-8", "replace")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::recon.report.verdict.PoorFitWarning")  # 120 steps of Adam leave 2 % unexplained
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_a_killed_run_goes_on_and_ends_where_an_uninterrupted_one_does(long, tmp_path, name):
    path, whole = long
    out = tmp_path / "out"
    code, err = interrupted(path, out, getattr(signal, name))
    done = len(rows(out))
    assert 12 <= done < LONG
    kept = torch.load(out / "checkpoint.pt", weights_only=True)["step"]["number"]
    early = {"log.csv", "checkpoint.pt"} | (
        set() if name == "SIGKILL" else {"volume.ome.tif", "README.txt"}
    )  # the volume so far
    assert RESULTS & set(content(out)) == early  # no other result is there before its time
    if name == "SIGKILL":
        assert code == -signal.SIGKILL
        assert done - kept <= 5  # at most one interval
    else:
        assert code == 130
        assert f"torchdic: error: interrupted after step {kept} of {LONG}; go on with --resume" in err
        assert "Traceback" not in err
        assert kept == done
    assert command("reconstruct", path, "--out", out, "--resume")[0] == 0
    assert torch.equal(volume(out), volume(whole))
    assert [row["step"] for row in rows(out)] == [str(number) for number in range(1, LONG + 1)]
    for column in ("misfit", "loss"):
        assert [row[column] for row in rows(out)] == [row[column] for row in rows(whole)]
    assert {name for name in content(out) if not name.startswith(".")} == RESULTS


def interrupt_at(patch, number):
    """Make the next descent stop with KeyboardInterrupt when it would take a step."""
    original = recorded.minimise

    def minimise(*arguments):
        for step in original(*arguments):
            if step.number == number:
                patch.setattr(recorded, "minimise", original)
                raise KeyboardInterrupt
            yield step

    patch.setattr(recorded, "minimise", minimise)


@pytest.fixture
def interrupt(monkeypatch):
    """A function from a step to where the next descent stops."""
    return lambda number: interrupt_at(monkeypatch, number)


class Doomed:
    """Python ignores what is raised while it is destroyed."""

    def __del__(self):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_is_heeded_where_python_ignores_what_it_raises(other, tmp_path, monkeypatch, method):
    original = recorded.minimise

    def minimise(*arguments):
        for step in original(*arguments):
            yield step
            if step.number == 3:
                Doomed()

    monkeypatch.setattr(recorded, "minimise", minimise)
    out = tmp_path / "out"
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    try:
        code, err = command("reconstruct", other({"reconstruction": {"method": method, "steps": 8}}), "--out", out)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 130
    assert "torchdic: error: interrupted after step 4 of 8; go on with --resume" in err
    assert len(rows(out)) == 4


@pytest.fixture(scope="module")
def eight(workplace):
    """The folders of a run of 8 steps that was interrupted after its third, and of one that was not."""
    path = workplace / "eight.toml"
    path.write_text(merged({"reconstruction": {"steps": 8}}), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "save", lambda _, picture: picture.touch())
        interrupt_at(patch, 4)
        assert command("reconstruct", path, "--out", workplace / "stopped")[0] == 130
        assert set(content(workplace / "stopped")) == {"log.csv", "checkpoint.pt", "volume.ome.tif", "README.txt"}
        assert command("reconstruct", path, "--out", workplace / "eight")[0] == 0
    return workplace / "stopped", workplace / "eight"


@pytest.fixture
def stopped(other, eight, tmp_path):
    """(configuration, folder) of a run of 8 steps that was interrupted after its third."""
    shutil.copytree(eight[0], tmp_path / "out")
    return other({"reconstruction": {"steps": 8}}), tmp_path / "out"


@pytest.mark.slow
def test_a_run_that_dies_between_checkpoints_goes_on_from_the_last(other, monkeypatch, workplace, tmp_path):
    """As a killed one does: nothing is saved on its way out."""
    path, out = other(), tmp_path / "out"
    original = recorded.minimise

    def minimise(*arguments):
        for step in original(*arguments):
            if step.number == 9:
                raise SystemError("out of memory")
            yield step

    with monkeypatch.context() as patch:
        patch.setattr(recorded, "minimise", minimise)
        with pytest.raises(SystemError):
            command("reconstruct", path, "--out", out)
    assert set(content(out)) == {"log.csv", "checkpoint.pt"}
    assert len(rows(out)) == 8
    assert torch.load(out / "checkpoint.pt", weights_only=True)["step"]["number"] == 5
    assert command("reconstruct", path, "--out", out, "--resume")[0] == 0
    assert torch.equal(volume(out), volume(workplace / "whole"))
    for column in ("step", "misfit", "loss"):
        assert [row[column] for row in rows(out)] == [row[column] for row in rows(workplace / "whole")]


def test_an_interrupted_run_leaves_the_volume_so_far(stopped, other, tmp_path):
    _, out = stopped
    assert command("reconstruct", other({"reconstruction": {"steps": 3}}), "--out", tmp_path / "short")[0] == 0
    assert torch.equal(volume(out), volume(tmp_path / "short"))
    assert read_volume(out / "volume.ome.tif")[1] == GRID
    assert read_stack(out / "volume.ome.tif").names == ("delta n, interrupted after step 3",)


def test_an_interrupted_run_leaves_earlier_results_alone(other, interrupt, tmp_path):
    out = tmp_path / "out"
    assert command("reconstruct", other({"reconstruction": {"steps": 2}}), "--out", out)[0] == 0
    before = content(out)
    interrupt(3)
    path = other({"reconstruction": {"steps": 5}})
    code, err = command("reconstruct", path, "--out", out, "--restart")
    assert code == 130
    assert "interrupted after step 2 of 5; go on with --resume; volume.interrupted.ome.tif holds Δn so far" in err
    after = content(out)
    assert after.keys() - before.keys() == {"volume.interrupted.ome.tif"}
    assert {name for name in before if before[name] != after[name]} <= {"log.csv", "checkpoint.pt", "README.txt"}
    code, err = command("reconstruct", path, "--out", out)
    assert code == 2
    assert "an interrupted run; go on with --resume" in err
    assert command("reconstruct", path, "--out", out, "--resume")[0] == 0
    assert set(content(out)) == RESULTS


def test_an_interrupted_run_is_not_overwritten_unasked(stopped):
    path, out = stopped
    before = content(out)
    code, err = command("reconstruct", path, "--out", out)
    assert code == 2
    assert err.count("\n") == 1
    assert "--resume" in err
    assert "--restart" in err
    assert content(out) == before


@pytest.mark.parametrize("option", ["--resume", "--restart"])
def test_an_interrupted_run_goes_on_or_begins_anew_where_asked(stopped, eight, option):
    path, out = stopped
    assert command("reconstruct", path, "--out", out, option)[0] == 0
    assert torch.equal(volume(out), volume(eight[1]))
    assert [row["step"] for row in rows(out)] == list("12345678")
    assert set(content(out)) == RESULTS


def test_a_finished_run_is_not_overwritten_unasked(other, tmp_path):
    path, out = other({"reconstruction": {"steps": 2}}), tmp_path / "out"
    assert command("reconstruct", path, "--out", out)[0] == 0
    before = content(out)
    code, err = command("reconstruct", path, "--out", out)
    assert code == 2
    assert err.count("\n") == 1
    assert "checkpoint.pt: a finished run; go on with more steps and --resume, or begin anew with --restart" in err
    assert content(out) == before
    (out / "checkpoint.pt").unlink()
    code, err = command("reconstruct", path, "--out", out, "--resume")
    assert code == 2
    assert "metrics.json: the folder has results; name another one, or replace them with --restart" in err
    assert command("reconstruct", path, "--out", out, "--restart")[0] == 0


def test_a_finished_run_goes_on_with_more_steps(other, workplace, tmp_path):
    """As if it had had them from the start: the weight follows the noise, not the number of steps."""
    out = tmp_path / "out"
    whole = rows(workplace / "whole")
    half = len(whole) - 3
    assert command("reconstruct", other({"reconstruction": {"steps": half}}), "--out", out)[0] == 0
    assert len(rows(out)) == half
    assert command("reconstruct", other(), "--out", out, "--resume")[0] == 0
    assert torch.equal(volume(out), volume(workplace / "whole"))
    assert [row["misfit"] for row in rows(out)] == [row["misfit"] for row in whole]
    assert command("reconstruct", other(), "--out", out, "--resume")[0] == 0  # nothing is left to do
    assert torch.equal(volume(out), volume(workplace / "whole"))
    assert len(rows(out)) == len(whole)


def test_resume_without_an_interrupted_run_begins_one(other, tmp_path):
    path = other({"reconstruction": {"steps": 2}})
    assert command("reconstruct", path, "--out", tmp_path / "out", "--resume")[0] == 0
    assert len(rows(tmp_path / "out")) == 2


@pytest.mark.filterwarnings("ignore::recon.report.verdict.PoorFitWarning")  # seven steps of Adam
@pytest.mark.slow
@pytest.mark.parametrize("method", ["newton", "adam"])
def test_a_run_may_be_interrupted_again_and_again(other, interrupt, tmp_path, method):
    path, out = other({"reconstruction": {"method": method, "steps": 7}}), tmp_path / "out"
    assert command("reconstruct", path, "--out", tmp_path / "whole")[0] == 0
    last = len(rows(tmp_path / "whole"))
    for number in (2, 3, last):
        interrupt(number)
        assert command("reconstruct", path, "--out", out, "--resume")[0] == 130
        assert [int(row["step"]) for row in rows(out)] == list(range(1, number))
    assert command("reconstruct", path, "--out", out, "--resume")[0] == 0
    assert torch.equal(volume(out), volume(tmp_path / "whole"))


def test_an_interruption_before_the_first_step_leaves_nothing_to_go_on_with(other, interrupt, tmp_path):
    path, out = other({"reconstruction": {"steps": 3}}), tmp_path / "out"
    interrupt(1)
    code, err = command("reconstruct", path, "--out", out)
    assert code == 130
    assert "interrupted before the first step" in err
    assert command("reconstruct", path, "--out", out)[0] == 0


def test_an_interruption_among_the_results_goes_on_from_the_last_checkpoint(other, monkeypatch, tmp_path):
    path, out = other({"reconstruction": {"steps": 7}}), tmp_path / "out"

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(figures, "draw_sections", stop)
        code, err = command("reconstruct", path, "--out", out)
    assert code == 130
    assert "Traceback" not in err
    assert command("reconstruct", path, "--out", out, "--resume")[0] == 0
    assert command("reconstruct", path, "--out", tmp_path / "whole")[0] == 0
    assert torch.equal(volume(out), volume(tmp_path / "whole"))
    assert set(content(out)) == RESULTS


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        pytest.param(
            {"reconstruction": {"steps": 8, "tv": [50.0, 5.0]}},
            "reconstruction.tv was 'auto', is [50.0, 5.0]",
            marks=pytest.mark.slow,
        ),
        ({"reconstruction": {"steps": 8, "method": "adam"}}, "reconstruction.method was 'newton', is 'adam'"),
        ({"reconstruction": {"steps": 8, "bounds": {"lower": "none"}}}, "bounds.lower was 0.0, is 'none'"),
        ({"volume": {"background": 1.51}}, "volume.background was 1.5, is 1.51"),
        pytest.param({"fidelity": {"sources": 6, "order": 2}}, "fidelity.order was 1, is 2", marks=pytest.mark.slow),
    ],
)
def test_a_changed_configuration_does_not_go_on_with_anothers_run(stopped, other, changes, named):
    _, out = stopped
    before = content(out)
    code, err = command("reconstruct", other({"reconstruction": {"steps": 8}} | changes), "--out", out, "--resume")
    assert code == 2
    assert err.count("\n") == 1
    assert named in err
    assert content(out) == before


def test_a_run_with_another_misfit_is_not_gone_on_with(stopped):
    path, out = stopped
    with pytest.raises(CheckpointError, match="misfit was gaussian, is absolute"):
        reconstruct.reconstruct(load(path), out, torch.device("cpu"), resume=True, misfit=Absolute)


def test_what_the_descent_does_not_see_may_change_before_it_goes_on(stopped, eight, other, workplace, tmp_path):
    _, out = stopped
    moved = tmp_path / "moved.tif"
    moved.write_bytes((workplace / "simulated" / "stack.ome.tif").read_bytes())
    changes = {
        "data": {"path": str(moved)},
        "reconstruction": {"steps": 8, "checkpoint_every": 2},
        "specimen": {"contrast": 0.01},
        "simulation": {"seed": 5},
    }
    assert command("reconstruct", other(changes), "--out", out, "--resume")[0] == 0
    assert torch.equal(volume(out), volume(eight[1]))


def test_changed_data_do_not_go_on_with_anothers_run(workplace, other, interrupt, tmp_path):
    data = read_stack(workplace / "simulated" / "stack.ome.tif").data.copy()
    write_stack(tmp_path / "data.ome.tif", data)
    path = other({"data": {"path": str(tmp_path / "data.ome.tif")}, "reconstruction": {"steps": 8}})
    interrupt(4)
    assert command("reconstruct", path, "--out", tmp_path / "out")[0] == 130
    data[0, 0, 0, 0] += 0.001
    write_stack(tmp_path / "data.ome.tif", data)
    code, err = command("reconstruct", path, "--out", tmp_path / "out", "--resume")
    assert code == 2
    assert err.count("\n") == 1
    assert "data's sha256 was" in err


# scenes that can't be computed as asked


@pytest.mark.parametrize(
    ("microscope", "named"),
    [
        ({"condenser_prism": False}, "microscope.condenser_prism is false"),
        ({"polarisation": {"pupil": {"depolarisation": True}}}, "microscope.polarisation.pupil"),
    ],
    ids=["no condenser prism", "pupil of matrices"],
)
def test_what_needs_a_linear_transfer_is_refused_in_one_line_where_there_is_none(other, tmp_path, microscope, named):
    refused = [
        ({"method": "newton"}, "reconstruction.method: 'newton' needs", "use method 'adam' with start 'zero'"),
        ({"method": "linear"}, "reconstruction.method: 'linear' needs", "use method 'adam' with start 'zero'"),
        ({"method": "adam"}, "reconstruction.start: 'linear' needs", "use 'zero'"),
    ]
    for recipe, asks, instead in refused:
        code, err = command(
            "reconstruct", other({"microscope": microscope, "reconstruction": recipe}), "--out", tmp_path / "out"
        )
        assert code == 2
        assert err.count("\n") == 1
        assert named in err
        assert asks in err
        assert instead in err
        assert not (tmp_path / "out").exists()
    zero = other({"microscope": microscope, "reconstruction": {"method": "adam", "start": "zero", "steps": 2}})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PoorFitWarning)  # two steps, and a stack of another microscope
        reconstruct.reconstruct(load(zero), tmp_path / "out", torch.device("cpu"))
    assert (tmp_path / "out" / "volume.ome.tif").exists()


@pytest.mark.parametrize("method", ["newton", "linear"])
def test_prisms_without_bias_are_refused_in_one_line(other, tmp_path, method):
    prisms = [{"shear": [0.0, 0.24], "bias": 0.0}, {"shear": [0.24, 0.0], "bias": 0.0}]
    path = other({"acquisition": {"prisms": prisms}, "reconstruction": {"method": method}})
    code, err = command("reconstruct", path, "--out", tmp_path / "out")
    assert code == 2
    assert err.count("\n") == 1
    assert f"reconstruction.method: '{method}' needs a linear response" in err
    assert "acquisition.prisms have biases 0, 0" in err
    assert not (tmp_path / "out").exists()


def test_rays_that_turn_are_told_in_one_line(other, tmp_path):
    changes = {
        "microscope": {"condenser": {"na": 1.4}, "objective": {"na": 1.4}},
        "volume": {"spacing": [0.5, 0.09, 0.09]},
        "fidelity": {"propagation": "rays"},
        "specimen": {"contrast": -0.2, "centre": [0.0, 0.0, 0.0]},
    }
    code, err = command("simulate", other(changes), "--out", tmp_path / "out")
    assert code == 2
    assert err.count("\n") == 1
    assert "rays can't go on toward +z" in err
    assert not list((tmp_path / "out").iterdir())


# warnings


def test_a_volume_that_explains_less_than_empty_medium_is_warned_of(other, tmp_path):
    path = other({"reconstruction": {"method": "adam", "steps": 3, "learning_rate": 0.04}})
    with pytest.warns(PoorFitWarning, match="empty medium would explain the stack better"):
        reconstruct.reconstruct(load(path), tmp_path / "out", torch.device("cpu"))


def test_voxels_coarser_than_the_light_are_warned_of_once_and_computed(other, tmp_path):
    path = other(
        {
            "volume": {"spacing": [0.5, 0.2, 0.4]},
            "data": {"path": str(tmp_path / "out" / "stack.ome.tif")},
            "reconstruction": {"steps": 3},
        }
    )
    with pytest.warns(UserWarning, match="coarser than λ"):  # here every call warns
        load_and_simulate(path, tmp_path / "out")
    code, err = command("reconstruct", path, "--out", tmp_path / "out")
    assert code == 0
    assert err.count("warning") == 1
    assert any(line.startswith("torchdic: warning: ") for line in err.replace("\r", "\n").split("\n"))
    assert "torchdic: warning: voxels of 0.4 µm are coarser than λ/(2(NA_o + NA_c)) = 0.248 µm" in err
    assert (tmp_path / "out" / "volume.ome.tif").exists()


def load_and_simulate(path, out):
    config = load(path)
    truth = GaussianBall(0.5, 0.02, 1.5).delta(config.volume.grid, dtype=torch.float32)
    with torch.no_grad():
        images = image(Volume(config.volume.grid, truth, 1.5), config.microscope, config.acquisition, config.fidelity)
    out.mkdir()
    write_stack(out / "stack.ome.tif", images, config.volume.spacing[1:], 1.0)
