import argparse
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tifffile
import tomli_w

import torchdic
from recon.cli import main
from recon.cli.arguments import repeated
from recon.cli.commands import COMMANDS
from recon.cli.specimens import SPECIMENS
from recon.config.reading import load
from recon.run.data import load_data
from torchdic.files.stack import read_stack, write_stack

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
focus = [-0.5, 0.0, 0.5]
prisms = [{ shear = [0.0, 0.24], bias = 1.5 }, { shear = [0.24, 0.0], bias = -1.2 }]
[fidelity]
sources = 3
[reconstruction]
steps = 2
[specimen]
kind = "gaussian_ball"
sigma = 0.4
contrast = 0.02
centre = [0.2, 0.3, -0.4]
[data]
path = "stack.ome.tif"
"""
SHAPE = (2, 3, 14, 12)


@pytest.fixture
def write(tmp_path):
    """A function from changes {key: value} of the configuration to its file; `...` takes a key away."""

    def put(changes=None):
        values = tomllib.loads(CONFIG)
        for key, value in (changes or {}).items():
            *folders, last = key.split(".")
            place = values
            for part in folders:
                place = place.setdefault(part, {})
            if value is ...:
                del place[last]
            else:
                place[last] = value
        path = tmp_path / "config.toml"
        path.write_text(tomli_w.dumps(values), encoding="utf-8")
        return path

    return put


@pytest.fixture
def run(tmp_path, capsys):
    """A function that runs a command and returns (exit code, lines on stderr); results go to tmp_path/out."""

    def call(*arguments, out=tmp_path / "out"):
        try:
            code = main([*map(str, arguments), "--out", str(out)])
        except SystemExit as stop:  # argparse's way
            code = stop.code
        return code, capsys.readouterr().err.splitlines()

    return call


@pytest.fixture
def refused(run, tmp_path):
    """A function that runs a command, checks that it is refused without a trace, and returns the one line."""

    def call(*arguments, out=tmp_path / "out"):
        before = sorted(tmp_path.rglob("*"))
        code, lines = run(*arguments, out=out)
        assert code == 2
        assert len(lines) == 1
        assert "error: " in lines[0]
        assert sorted(tmp_path.rglob("*")) == before
        return lines[0]

    return call


# between the empty fields of both prisms, sin²(bias/2), neither of which is far
LEVEL = 0.39


def stack(seed=0, shape=SHAPE, dtype=np.float32):
    return (LEVEL + 0.02 * np.random.default_rng(seed).standard_normal(shape)).astype(dtype)


# a stack that can't be used


def missing(path):
    pass


def text(path):
    path.write_text("x,y\n1,2\n" * 100, encoding="utf-8")


def empty_file(path):
    path.write_bytes(b"")


def folder(path):
    path.mkdir()


def truncated(path):
    write_stack(path, stack())
    path.write_bytes(path.read_bytes()[:-200])


def nan_pixels(path):
    data = stack()
    data[1, 2, 3, 4] = np.nan
    tifffile.imwrite(path, data, ome=True, photometric="minisblack", metadata={"axes": "CZYX"})


def one_more_plane(path):
    write_stack(path, stack(shape=(2, 4, 14, 12)))


def one_more_prism(path):
    write_stack(path, stack(shape=(3, 3, 14, 12)))


def one_plane(path):
    write_stack(path, stack(shape=(14, 12)))


def swapped_pixels(path):
    write_stack(path, stack(shape=(2, 3, 12, 14)))


def swapped_prism_and_focus(path):
    write_stack(path, stack(shape=(3, 2, 14, 12)))


def five_dimensions(path):
    tifffile.imwrite(path, stack(shape=(2, 2, 3, 14, 12)), ome=False, photometric="minisblack")


def time_points(path):
    data = stack(shape=(4, 2, 3, 14, 12))
    tifffile.imwrite(path, data, ome=True, photometric="minisblack", metadata={"axes": "TCZYX"})


def rgb(path):
    tifffile.imwrite(path, np.zeros((14, 12, 3), np.uint8), photometric="rgb")


def empty_stack(path):
    with pytest.warns(UserWarning, match="zero-size"):
        tifffile.imwrite(path, np.zeros((0, 14, 12), np.float32), ome=False, photometric="minisblack")


def no_pages(path):
    path.write_bytes(b"II*\0\0\0\0\0")


def uniform(path):
    write_stack(path, np.full(SHAPE, LEVEL, np.float32))


def uniform_counts(path):
    write_stack(path, np.full(SHAPE, 1234, np.uint16))


def dark(path):
    write_stack(path, np.zeros(SHAPE, np.uint16))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (missing, ["no such file"]),
        (text, ["no TIFF"]),
        (empty_file, ["empty"]),
        (folder, ["folder"]),
        (truncated, ["truncated"]),
        (nan_pixels, ["1 of 1008 pixels are not finite", "1 NaN"]),
        (one_more_plane, ["2 prisms × 4 planes", "2 × 3"]),
        (one_more_prism, ["3 prisms × 3 planes", "2 × 3"]),
        (one_plane, ["1 prism × 1 plane", "2 × 3"]),
        (swapped_prism_and_focus, ["3 prisms × 2 planes", "2 × 3"]),
        (swapped_pixels, ["12 × 14 pixels", "14 × 12"]),
        (five_dimensions, ["more dimensions"]),
        (time_points, ["4 time points"]),
        (rgb, ["colour image", "3 samples"]),
        (empty_stack, ["empty"]),
        (no_pages, ["no pages"]),
        (uniform, ["uniform", "nothing to fit"]),
        (uniform_counts, ["uniform", "nothing to fit"]),
        (dark, ["must stay above 0"]),
    ],
)
def test_a_stack_that_cannot_be_used_is_refused_in_one_line(write, refused, tmp_path, make, words):
    make(tmp_path / "stack.ome.tif")
    line = refused("reconstruct", write())
    assert str(tmp_path / "stack.ome.tif") in line
    assert [word for word in words if word not in line] == []


def test_a_stack_among_several_is_taken_by_its_number(write, run, tmp_path):
    data = LEVEL * (0.9 + 0.2 * np.random.default_rng(0).random((3, *SHAPE), np.float32))
    with tifffile.TiffWriter(tmp_path / "stack.ome.tif", ome=True) as tif:
        for stack in data:
            tif.write(stack, photometric="minisblack", metadata={"axes": "CZYX"})
    code, (line,) = run("reconstruct", write())
    assert code == 2
    assert "holds 3 equal series (2 × 3 × 14 × 12 each)" in line
    assert "series = 0 … 2 in [data]" in line
    read = load_data(load(write({"data.series": 1})))
    assert np.allclose(read.data, data[1])


def test_counts_of_extinct_prisms_alone_ask_for_a_scale(write, refused, tmp_path):
    write_stack(tmp_path / "stack.ome.tif", (1000 * stack()).astype(np.uint16))
    prisms = [{"shear": [0.0, 0.24], "bias": 0.0}, {"shear": [0.24, 0.0], "bias": 0.01}]
    assert "give scale" in refused("reconstruct", write({"acquisition.prisms": prisms}))


# a configuration that can't be used

BAD_VALUES = [
    ("microscope.wavelength", -0.546, ["microscope", "wavelength -0.546", "above 0"]),
    ("microscope.objective", {"na": 1.9}, ["objective NA 1.9", "at most 1.8"]),
    ("microscope.condenser", {"na": 1.9}, ["condenser NA 1.9", "at most 1.8"]),
    ("microscope.wavelenght", 0.5, ["microscope.wavelenght", "did you mean 'wavelength'"]),
    ("volume.shape", [4, 0, 12], ["volume", "(4, 0, 12)", "at least 1"]),
    ("volume.shape", [0, 0, 0], ["volume", "(0, 0, 0)", "at least 1"]),
]


@pytest.mark.parametrize("command", ["reconstruct", "simulate"])
@pytest.mark.parametrize(("key", "value", "words"), BAD_VALUES)
def test_a_bad_configuration_is_refused_in_one_line(write, refused, tmp_path, command, key, value, words):
    write_stack(tmp_path / "stack.ome.tif", stack())
    line = refused(command, write({key: value}))
    assert str(tmp_path / "config.toml") in line
    assert [word for word in words if word not in line] == []


@pytest.mark.parametrize("command", ["reconstruct", "simulate"])
def test_a_missing_configuration_is_refused(refused, tmp_path, command):
    line = refused(command, tmp_path / "none.toml")
    assert str(tmp_path / "none.toml") in line
    assert "No such file" in line


def test_a_reconstruction_without_data_is_refused(write, refused):
    path = write({"data": ...})
    line = refused("reconstruct", path)
    assert str(path) in line
    assert "missing key data.path" in line


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"specimen": ...}, ["missing key specimen"]),
        ({"specimen.kind": ...}, ["missing key specimen.kind", *map(repr, SPECIMENS)]),
        ({"specimen.kind": "beed"}, ["specimen.kind", "'beed'", "'bead'"]),
        ({"specimen.kind": ["bead"]}, ["specimen.kind", "['bead']", "'bead'"]),
        ({"specimen.sgima": 1}, ["unknown key specimen.sgima", "did you mean 'sigma'"]),
        ({"specimen.sigma": ...}, ["missing key specimen.sigma"]),
        ({"specimen.sigma": "wide"}, ["specimen.sigma", "'wide'", "a number"]),
        ({"specimen.sigma": -1.0}, ["specimen", "sigma -1.0", "above 0"]),
        ({"specimen.contrast": -1.0}, ["specimen", "1.5", "-1.0", "at least 1"]),
        ({"specimen.background": 1.4}, ["specimen.background 1.4", "volume.background 1.5"]),
        ({"specimen": {"kind": "cell"}, "simulation.exact": True}, ["simulation.exact", "isn't known"]),
    ],
)
def test_a_specimen_that_cannot_be_used_is_refused(write, refused, changes, words):
    path = write(changes)
    line = refused("simulate", path)
    assert str(path) in line
    assert [word for word in words if word not in line] == []


# a command that can't be used


def test_an_unknown_device_is_refused(write, refused):
    assert "'gpu9' is no device here" in refused("simulate", write(), "--device", "gpu9")
    assert "'meta' is no device here" in refused("simulate", write(), "--device", "meta")


def test_resume_and_restart_exclude_each_other(write, refused):
    line = refused("reconstruct", write(), "--resume", "--restart")
    assert "--restart" in line
    assert "--resume" in line


@pytest.mark.parametrize("arguments", [["simulate"], ["deconvolve"], []])
def test_an_incomplete_command_is_refused(refused, arguments):
    refused(*arguments)


@pytest.mark.parametrize("command", ["reconstruct", "simulate"])
@pytest.mark.parametrize("out", ["file", "file/deeper", "file/deeper/still"])
def test_a_folder_that_cannot_be_written_to_is_refused(write, refused, tmp_path, command, out):
    write_stack(tmp_path / "stack.ome.tif", stack())
    (tmp_path / "file").write_text("precious", encoding="utf-8")
    line = refused(command, write(), out=tmp_path / out)
    assert str(tmp_path / out) in line
    assert "can't be written to" in line
    assert (tmp_path / "file").read_text(encoding="utf-8") == "precious"


def test_demo_checks_its_folder_before_it_begins(refused, tmp_path):
    (tmp_path / "file").write_text("precious", encoding="utf-8")
    assert "can't be written to" in refused("demo", out=tmp_path / "file")


@pytest.mark.parametrize("command", ["calibrate", "reconstruct", "simulate", "plan", "work-precision"])
@pytest.mark.parametrize("name", ["stack.ome.tif", "planes"])
def test_images_in_a_configurations_place_point_to_new(refused, tmp_path, command, name):
    write_stack(tmp_path / "stack.ome.tif", stack())
    (tmp_path / "planes").mkdir()
    line = refused(command, tmp_path / name)
    kind = "a folder" if name == "planes" else "an image"
    assert f"{name}: is {kind}, not a configuration; torchdic new {tmp_path / name} --out run.toml writes" in line


# what works


@pytest.mark.parametrize(
    "specimen",
    [
        {"kind": "bead", "radius": 0.6, "contrast": 0.03},
        {"kind": "gaussian_ball", "sigma": 0.4, "contrast": -0.02, "centre": [0, 0.1, 0.2]},
        {"kind": "etched_glass", "height": 0.3, "glass": 1.52},
        {"kind": "etched_grating", "height": 0.3, "glass": 1.52, "period": 0.8, "duty": 0.4},
        {
            "kind": "cell",
            "cytoplasm": {"shape": {"semi_axes": [0.9, 1.2, 1.0]}, "contrast": 0.02},
            "nucleus": {"shape": {"semi_axes": [0.4, 0.4, 0.4], "centre": [0.0, 0.2, 0.1]}, "contrast": 0.03},
            "nucleoli": [],
            "vacuole": "none",
            "lipid": "none",
        },
    ],
    ids=lambda specimen: specimen["kind"],
)
@pytest.mark.usefixtures("no_pictures")
def test_each_specimen_is_simulated_from_its_file(write, run, tmp_path, specimen):
    assert run("simulate", write({"specimen": specimen})) == (0, [])
    written = read_stack(tmp_path / "out" / "stack.ome.tif")
    assert written.data.shape == SHAPE
    assert written.data.std(axis=(2, 3)).min() > 1e-4  # the specimen shows in every image


def test_version_is_the_projects(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"torchdic {torchdic.__version__}\n"


def test_a_folder_in_a_folder_that_is_not_there_yet_is_made(write, run, tmp_path):
    assert run("simulate", write(), out=tmp_path / "a" / "b")[0] == 0
    assert "stack.ome.tif" in {p.name for p in (tmp_path / "a" / "b").iterdir()}


def test_the_installed_command_answers_with_one_line_and_exit_code_2(write, tmp_path):
    script = Path(sys.executable).with_name("torchdic")
    done = subprocess.run(
        [script, "reconstruct", write({"microscope.wavelenght": 1}), "--out", tmp_path / "out"],
        capture_output=True,
        text=True,
        encoding="utf-8",
        env={**os.environ, "PYTHONIOENCODING": "utf-8"},
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert "did you mean 'wavelength'?" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("propagation", "glass", "law"),
    [
        ("rays", 1.86, r"rays leave sideways: .* displaced by up to \d+ voxels"),
        ("rays", 2.16, r"\d+ of 1320 rays can't go on toward \+z: .*; the wave may cross it$"),
        ("wave", 1.86, r"slabs of 0\.4 µm are too thick for Δn .*; use more than 8 steps$"),
    ],
)
def test_light_that_cannot_be_followed_is_one_line_and_exit_code_2(run, write, propagation, glass, law):
    grid = {"shape": [8, 16, 18], "spacing": [0.4, 0.2, 0.2], "background": 1.36}
    wall = {"kind": "etched_glass", "height": 3.2, "glass": glass}
    lens = {"microscope.objective.na": 0.75, "microscope.condenser.na": 0.6}
    path = write({"specimen": wall, "volume": grid, "fidelity.propagation": propagation, **lens})
    code, lines = run("simulate", path)
    assert code == 2
    assert len(lines) == 1
    assert re.search(rf"error: {re.escape(str(path))}: {law}", lines[0])


# --- memory ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("free", "wanted"),
    [(2000, "2 arrays of 4×14×12 voxels"), (10_000, "2 prism settings × 3 focus planes of 4×14×12 voxels")],
)
def test_a_simulation_without_room_is_refused_in_one_line(write, refused, monkeypatch, free, wanted):
    monkeypatch.setattr("torchdic.memory.free.available", lambda: free)
    line = refused("simulate", write())
    assert wanted in line
    assert "GiB are free" in line


@pytest.mark.parametrize(
    "room",
    [
        (2000, "Images of 2×3×14×12 pixels, prepared", 4),
        (50_000, "4 arrays of 40×14×12 voxels", 40),
        (45_000, "reconstruction of 4×14×12 voxels", 4),
        (45_000_000, "Pictures and files of the results", 4),
    ],
    ids=["2 kB", "50 kB", "45 kB", "45 MB"],
)
@pytest.mark.parametrize("recipe", [{}, {"method": "adam"}, {"method": "adam", "start": "zero"}], ids=str)
@pytest.mark.usefixtures("no_pictures")
def test_a_reconstruction_without_room_is_refused_before_it_begins(
    write, run, refused, monkeypatch, tmp_path, recipe, room
):
    free, wanted, slices = room
    run("simulate", write())
    (tmp_path / "stack.ome.tif").write_bytes((tmp_path / "out" / "stack.ome.tif").read_bytes())
    before = sorted((tmp_path / "out").iterdir())
    monkeypatch.setattr("torchdic.memory.free.available", lambda: free)
    recipe = {f"reconstruction.{key}": value for key, value in recipe.items()}
    line = refused("reconstruct", write({"volume.shape": [slices, 14, 12], **recipe}))
    assert wanted in line
    assert sorted((tmp_path / "out").iterdir()) == before


OIL = {"volume.background": 1.335, "volume.spacing": [0.5, 0.1, 0.1], "microscope.condenser.na": 0.7}


@pytest.mark.filterwarnings("ignore::torchdic.WrapAroundWarning")
@pytest.mark.parametrize(("na", "lines"), [(1.33, 0), (1.4, 1), (1.45, 1)])
def test_an_oil_objective_on_cells_in_medium_simulates_and_one_line_says_what_is_dark(write, run, na, lines):
    code, said = run("simulate", write(OIL | {"microscope.objective.na": na}))
    assert code == 0
    assert len(said) == lines
    for line in said:
        assert line.startswith(f"torchdic: warning: objective NA {na} exceeds the medium's index 1.335")
        assert "dark" in line


LONG = "x" * 300


@pytest.mark.parametrize("typed", [("simulate", f"{LONG}.toml"), ("phase", f"{LONG}.tif"), ("error-bars", LONG)])
def test_a_name_that_no_file_can_have_is_one_line(tmp_path, monkeypatch, capsys, typed):
    monkeypatch.chdir(tmp_path)
    assert main([*typed, *([] if typed[0] == "error-bars" else ["--out", "out"])]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"torchdic: error: {LONG}")
    assert line.endswith(": File name too long")


def test_a_folder_whose_name_is_too_long_is_one_line(write, run, tmp_path):
    code, said = run("simulate", write(), out=tmp_path / LONG)
    assert code == 2
    assert said[-1] == f"torchdic: error: {tmp_path / LONG}: File name too long"


def test_a_simulation_is_replaced_by_another_one(write, run, tmp_path):
    """It can be made again in seconds."""
    assert run("simulate", write())[0] == 0
    first = (tmp_path / "out" / "stack.ome.tif").read_bytes()
    assert run("simulate", write({"microscope.objective.na": 0.6}))[0] == 0
    assert (tmp_path / "out" / "stack.ome.tif").read_bytes() != first


@pytest.mark.parametrize("others", [{"reconstruct"}, {"simulate", "reconstruct"}, set()])
def test_a_stack_of_other_results_or_from_elsewhere_is_replaced_only_on_request(write, run, tmp_path, others):
    out = tmp_path / "out"
    out.mkdir()
    for name in ("stack.ome.tif", "config.resolved.toml"):  # a reconstruction leaves the latter beside any stack
        (out / name).write_text("precious")
    (out / "run.json").write_text(json.dumps({name: {"command": f"torchdic {name}"} for name in others}))
    code, said = run("simulate", write())
    assert code == 2
    assert "stack.ome.tif: the folder has results; name another one, or replace them with --restart" in said[-1]
    assert (out / "stack.ome.tif").read_text() == "precious"
    assert run("simulate", write(), "--restart")[0] == 0
    assert (out / "stack.ome.tif").read_bytes()[:2] == b"II"


@pytest.mark.filterwarnings("ignore::torchdic.WrapAroundWarning")
@pytest.mark.parametrize("more", [{}, pytest.param({"fidelity": ..., "tolerance": 0.3}, marks=pytest.mark.slow)])
def test_a_reconstruction_above_the_index_says_so_once(write, run, tmp_path, more):
    """With oil behind 3 µm of water, the condenser's too, and with a planned fidelity."""
    layer = {"thickness": 3.0, "index": 1.335, "design_index": 1.515}
    path = write(OIL | {"microscope.objective": {"na": 1.4, "layer": layer}, "microscope.condenser.na": 1.4} | more)
    assert run("simulate", path, out=tmp_path)[0] == 0
    code, said = run("reconstruct", path)
    assert code == 0
    dark = [line for line in said if "is dark" in line]
    assert len(dark) == 1
    assert "objective NA 1.4" in dark[0]
    assert "condenser NA 1.4" in dark[0]


@pytest.mark.parametrize("command", ["demo", "phase"])  # of the latter the arguments are imported, too
def test_ctrl_c_while_torch_is_loaded_ends_in_one_line(command, tmp_path):
    code = f"""
import os, signal, sys
from recon.cli import main
signal.signal(signal.SIGINT, signal.default_int_handler)
class Stops:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Stops())
sys.exit(main([{command!r}, "--out", {str(tmp_path / "somewhere")!r}]))
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 130
    assert ended.stderr == "torchdic: error: interrupted\n"


@pytest.mark.parametrize("words", [["--help"], ["reconstruct", "--help"], ["nonsense"]])
def test_help_does_not_wait_for_torch(words):
    """It would take seconds; so would a mistyped command."""
    code = f"""
import sys
from recon.cli import main
try:
    main({words!r})
except SystemExit:
    pass
print(*sorted({{"torch", "numpy", "scipy"}} & set(sys.modules)), file=sys.stderr)
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stderr.splitlines()[-1] == ""
    assert ("torchdic" in said.stdout) == ("--help" in words)


@pytest.mark.parametrize("command", COMMANDS)
def test_each_commands_help_shows_an_example_that_it_can_read(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([command, "--help"])
    assert stopped.value.code == 0
    example = COMMANDS[command].example
    assert f"example: torchdic {example}" in " ".join(capsys.readouterr().out.split())
    parser = argparse.ArgumentParser()
    COMMANDS[command].add_arguments(parser)
    assert example.split()[0] == command
    parser.parse_args(repeated(example.split()[1:], COMMANDS[command].several))


@pytest.mark.parametrize(
    ("words", "out"),
    [
        (["reconstruct", "runs/cell.toml"], "runs/cell_volume"),
        (["calibrate", "cell.v2.toml"], "cell.v2_calibration"),
        (["simulate", "cell.toml"], "cell_simulated"),
        (["coverage", "cell.toml"], "cell_coverage"),
        (["work-precision", "cell.toml"], "cell_work_precision"),
        (["phase", "runs/image.ome.tif"], "runs/image_phase"),
        (["phase", "planes"], "planes_phase"),
        (["phase", "run.2"], "run.2_phase"),
        (["phase", "cell_40x_1.4"], "cell_40x_1.4_phase"),
        (["phase", "BIG.OME.TIFF"], "BIG_phase"),
        (["phase", "run.2/.."], None),
        (["phase", "."], None),
        (["demo"], "demo"),
        (["reconstruct", "cell.toml", "--out", "here"], "here"),
    ],
)
def test_results_go_beside_the_input_where_no_folder_is_named(words, out, tmp_path, monkeypatch):
    (tmp_path / "run.2").mkdir()
    monkeypatch.chdir(tmp_path)
    out = tmp_path.with_name(f"{tmp_path.name}_phase") if out is None else out
    seen = []
    monkeypatch.setattr("recon.cli.running.run", lambda _, options: seen.append(options.out) or 0)
    assert main(words) == 0
    assert seen == [Path(out)]
    assert [path.name for path in tmp_path.iterdir()] == ["run.2"]


def test_a_usual_folder_that_is_a_file_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell_volume").write_text("precious")
    with pytest.raises(SystemExit) as stopped:
        main(["reconstruct", "cell.toml"])
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert "cell_volume: can't be written to" in said
    assert said.strip().endswith("name another folder by --out")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "a command is wanted; torchdic --help lists them"),
        (["reconstuct", "x.toml"], "reconstuct: no such command; did you mean reconstruct?"),
        (["xyz"], "xyz: no such command; there are demo, doctor, simulate"),
        (["--device", "cpu", "reconstruct", "x.toml"], "--device: options come after the command"),
    ],
)
def test_what_is_no_command_is_told_in_one_line(words, said, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f"torchdic: error: {said}")
    assert len(err.splitlines()) == 1


def test_a_number_below_0_with_an_exponent_is_no_option():
    assert repeated(["--offset", "-1e9", "s.tif"], ()) == ["--offset=-1e9", "s.tif"]
    assert repeated(["--bias", "-6e1", "65", "s.tif"], ("--bias",)) == ["--bias=-6e1", "--bias", "65", "s.tif"]
    assert repeated(["--offset", "-5", "s.tif"], ()) == ["--offset", "-5", "s.tif"]
    assert repeated(["--bias", "65", "−65"], ("--bias",)) == ["--bias", "65", "--bias", "-65"]  # copied from a text


@pytest.mark.parametrize("package", ["torchdic", "recon"])
def test_a_package_is_run_as_the_command(package):
    said = subprocess.run([sys.executable, "-m", package, "--version"], capture_output=True, text=True, check=True)
    assert said.stdout == f"torchdic {torchdic.__version__}\n"
    wrong = subprocess.run([sys.executable, "-m", package, "nonsense"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert len(wrong.stderr.splitlines()) == 1
