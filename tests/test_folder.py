"""The folder of a run: a file in its place is seen first, and results are replaced only where the user says so."""

import argparse
import subprocess
import sys

import numpy as np
import pytest

from recon.cli import main
from recon.cli.commands import COMMANDS
from recon.config.schema import ConfigError
from recon.run.folder.index import FILES
from recon.run.folder.lock import folders_released, hold
from recon.run.folder.prepared import check_folder, prepare_folder
from recon.run.folder.results import FinishedError, check_no_results
from torchdic.files.stack import write_stack

# Of each command the files that a finished run leaves, each of which it would replace.
LEAVES = {
    "demo": ("comparison.png", "comparison.json"),
    "simulate": ("stack.ome.tif",),
    "phase": ("phase.json",),
    "calibrate": ("calibrated.toml", "calibration.json", "microscope.toml"),
    "work-precision": ("work_precision.json",),
    "coverage": ("coverage.json",),
}
# Commands whose folder takes more than one look: what is interrupted goes on.
RESUMED = {"reconstruct"}
# It takes a few seconds, and prints all that it leaves.
REPEATED = {"plan"}


def said_no(capsys, *words):
    """The one line with which a command refuses."""
    try:
        code = main([str(word) for word in words])
    except SystemExit as exit_:
        code = exit_.code
    assert code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def typed(command, tmp_path, out):
    """A command whose input doesn't matter where its folder is refused."""
    return (command, *([] if command == "demo" else [tmp_path / "in.toml"]), "--out", out)


def test_every_command_with_a_folder_is_looked_at_here():
    parsers = {name: argparse.ArgumentParser() for name in COMMANDS}
    for name, parser in parsers.items():
        COMMANDS[name].add_arguments(parser)
    dirs = {n for n, p in parsers.items() if any(a.dest == "out" and a.metavar == "DIR" for a in p._actions)}
    assert dirs == set(LEAVES) | RESUMED | REPEATED
    assert {name for names in LEAVES.values() for name in names} <= set(FILES)


@pytest.mark.parametrize("command", [*LEAVES, *RESUMED, *REPEATED])
def test_a_file_in_the_folders_place_is_seen_before_anything_is_read(tmp_path, capsys, command):
    (tmp_path / "file").write_text("precious")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        line = said_no(capsys, *typed(command, tmp_path, out))
        assert f"{out}: can't be written to: {tmp_path / 'file'} is a file, not a folder" in line
    assert (tmp_path / "file").read_text() == "precious"


@pytest.mark.parametrize(("command", "name"), [(c, name) for c, names in LEAVES.items() for name in names])
def test_results_are_not_replaced_unasked(tmp_path, capsys, command, name):
    (tmp_path / "in.toml").write_text("[volume]\n[data]")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("precious")
    if command == "calibrate":
        (tmp_path / "in.toml").write_text(CONFIG)
    line = said_no(capsys, *typed(command, tmp_path, tmp_path / "out"))
    assert f"{name}: the folder has results; name another one, or replace them with --restart" in line
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]


CONFIG = """
volume = { shape = [2, 8, 8], spacing = [1.0, 0.2, 0.2], background = 1.4 }
microscope = { wavelength = 0.5, objective = { na = 0.8 }, condenser = { na = 0.5 } }
acquisition = { prisms = [{ shear = [0.0, 0.2], bias = 1.5 }] }
data = { path = "missing.tif" }
"""


@pytest.mark.parametrize("name", ["volume.ome.tif", "images.ome.tif"])
def test_a_reconstruction_replaces_no_volume_unasked_that_came_from_elsewhere(tmp_path, capsys, name):
    (tmp_path / "in.toml").write_text(CONFIG.replace("missing.tif", "stack.tif"))
    write_stack(tmp_path / "stack.tif", np.random.default_rng(0).normal(0.5, 0.1, (1, 1, 8, 8)).astype(np.float32))
    (tmp_path / name).write_text("precious")
    line = said_no(capsys, "reconstruct", tmp_path / "in.toml", "--out", tmp_path)
    assert f"{name}: the folder has results; name another one, or replace them with --restart" in line
    assert (tmp_path / name).read_text() == "precious"


@pytest.mark.parametrize("key", ["path", "mask", "empty"])
def test_a_reconstruction_never_replaces_what_it_reads(tmp_path, capsys, key):
    named = {"path": "missing.tif", key: "link/images.ome.tif"}
    data = ", ".join(f'{name} = "{file}"' for name, file in named.items())
    (tmp_path / "in.toml").write_text(CONFIG.replace('path = "missing.tif"', data))
    (tmp_path / "out").mkdir()
    (tmp_path / "link").symlink_to("out")
    (tmp_path / "out" / "images.ome.tif").write_text("precious")
    for asked in ("--restart", "--resume"):
        line = said_no(capsys, "reconstruct", tmp_path / "in.toml", "--out", tmp_path / "out", asked)
        assert "images.ome.tif: is read, and a result of that name would replace it; name another folder" in line
    assert (tmp_path / "out" / "images.ome.tif").read_text() == "precious"


def test_no_other_command_replaces_what_it_reads(tmp_path, capsys):
    for name, words in {
        "phase.ome.tif": ("phase", tmp_path / "phase.ome.tif", "--out", tmp_path, "--restart"),
        "sd.ome.tif": ("error-bars", tmp_path, "--regions", tmp_path / "sd.ome.tif"),
    }.items():
        (tmp_path / name).write_text("precious")
        assert f"{name}: is read, and a result of that name would replace it" in said_no(capsys, *words)
        assert (tmp_path / name).read_text() == "precious"


def test_only_results_stand_in_the_way_and_only_unasked(tmp_path):
    check_no_results(tmp_path, ("a.json", "b.json"), restart=False)
    (tmp_path / "b.json").write_text("{}")
    check_no_results(tmp_path, ("a.json",), restart=False)
    check_no_results(tmp_path, ("a.json", "b.json"), restart=True)
    with pytest.raises(FinishedError, match=r"b\.json: the folder has results"):
        check_no_results(tmp_path, ("a.json", "b.json"), restart=False)


def test_a_folder_is_looked_at_without_being_made(tmp_path):
    check_folder(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    prepare_folder(tmp_path / "a" / "b")
    check_folder(tmp_path / "a" / "b")
    (tmp_path / "file").touch()
    for prepare in (check_folder, prepare_folder):
        with pytest.raises(ConfigError, match="can't be written to"):
            prepare(tmp_path / "file" / "b")


def test_a_link_to_nothing_is_called_so(tmp_path):
    (tmp_path / "out").symlink_to("gone")
    for out in (tmp_path / "out", tmp_path / "out" / "below"):
        with pytest.raises(ConfigError, match=r"out is a link to gone, which isn't there"):
            check_folder(out)


@pytest.fixture
def other_run(tmp_path):
    """Another process that holds a folder, until it is killed."""
    (tmp_path / "out").mkdir()
    program = (
        "import sys, time; from pathlib import Path; from recon.run.folder.lock import folders_released, hold\n"
        "with folders_released():\n"
        "    hold(Path(sys.argv[1])); hold(Path(sys.argv[1])); print('held', flush=True); time.sleep(600)"
    )
    words = [sys.executable, "-c", program, tmp_path / "out"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_two_runs_in_one_folder_are_one_too_many(tmp_path, capsys, other_run):
    """The second one says so in a line and leaves all as it is; a run that was killed holds nothing."""
    out = tmp_path / "out"
    (tmp_path / "in.toml").write_text(CONFIG.replace('data = { path = "missing.tif" }', SPECIMEN))
    command = ("simulate", tmp_path / "in.toml", "--out", out)
    line = said_no(capsys, *command)
    assert f"{out}: another run is writing into it; wait for its end, or name another folder" in line
    assert [path.name for path in out.iterdir()] == [".lock"]
    other_run.kill()
    other_run.wait()
    assert main([str(word) for word in command]) == 0
    assert not (out / ".lock").exists()
    with folders_released():  # the command has released it
        hold(out)
        prepare_folder(out)  # and this one may hold it twice


def test_a_run_that_is_going_on_is_not_called_interrupted(tmp_path, capsys, other_run):
    (tmp_path / "in.toml").write_text(CONFIG)
    (tmp_path / "out" / "checkpoint.pt").write_text("of the run that goes on")
    line = said_no(capsys, "reconstruct", tmp_path / "in.toml", "--out", tmp_path / "out")
    assert "another run is writing into it" in line


def test_outside_a_command_nothing_is_held(tmp_path, other_run):
    hold(tmp_path / "out")


SPECIMEN = 'specimen = { kind = "bead", radius = 0.5, contrast = 0.02, background = 1.4 }\nfidelity = { sources = 2 }'
