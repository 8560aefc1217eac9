"""Commands that start processes themselves: `--processes`."""

import json
import multiprocessing
import os
import re
import signal
import sys
import tempfile
import time

import pytest
import tifffile
from popen import python
from several_ranks import forked
from small_bead import CONFIG

from recon.cli import main
from recon.cli.exit_codes import BAD_INPUT, FAILED, INTERRUPTED

WORDS = "error: another process of this run has ended"
ENDED = "torchdic: error: --processes 2: process 1 ended before it could compute"


@pytest.fixture
def bead(tmp_path, monkeypatch, no_pictures):
    """A bead's configuration, its stack, and its volume by one process."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.toml").write_text(CONFIG)
    assert main(["simulate", "run.toml", "--out", "made"]) == 0
    assert main(["reconstruct", "run.toml", "--out", "one"]) == 0
    return tmp_path


def apart(folder, name, one="one", several="several"):
    """How far an image of two folders is apart, over its largest value."""
    a, b = (tifffile.imread(folder / out / name) for out in (one, several))
    return abs(a - b).max() / abs(a).max()


def begun(*words):
    """A command as a shell starts it, in a group of processes of its own."""
    return python("-m", "recon", *words, start_new_session=True)


def others(run):
    """The numbers of the processes that compute with a command's."""
    with open(f"/proc/{run.pid}/task/{run.pid}/children") as file:
        children = file.read().split()
    return [child for child in map(int, children) if "spawn_main" in words_of(child)]


def words_of(process):
    with open(f"/proc/{process}/cmdline") as file:
        return file.read()


def wait_until(what):
    until = time.monotonic() + 120
    while not what():
        assert time.monotonic() < until
        time.sleep(0.05)


@pytest.mark.slow
def test_two_processes_find_the_error_bars_of_one(bead, capsys):
    few = ["error-bars", "one", "--refits", "2", "--copies", "2"]
    assert main(few) == 0
    (bead / "one").rename(bead / "by_one")
    assert main(["reconstruct", "run.toml", "--out", "one"]) == 0
    assert main([*few, "--processes", "2"]) == 0
    for name in ("sd.ome.tif", "error.ome.tif"):
        assert apart(bead, name, "by_one", "one") < 1e-4
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "all"])
def test_a_number_of_processes_is_1_or_more(text, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["reconstruct", str(tmp_path / "run.toml"), f"--processes={text}"])
    assert f"argument --processes: {text!r} must be a number of processes, 1 or more" in capsys.readouterr().err


def test_torchrun_starts_the_processes_where_it_is_there(monkeypatch, tmp_path, capsys):
    from recon.cli import commands
    from recon.cli.processes.torchrun import MARK

    for name, value in {MARK: "a", "RANK": "0", "WORLD_SIZE": "4", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "4"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit, match="2"):
        commands._run(["reconstruct", str(tmp_path / "run.toml"), "--processes", "2"])
    assert "argument --processes: 2: torchrun has started 4 processes already" in capsys.readouterr().err


def test_a_process_that_ends_before_it_computes_ends_the_command_in_one_line(bead, monkeypatch, capsys):
    from recon.cli.processes import started

    monkeypatch.setattr(started, "_compute", sys.exit)  # which is pickled by its name
    assert main(["reconstruct", "run.toml", "--out", "several", "--processes", "2"]) == FAILED
    assert capsys.readouterr().err.splitlines()[-1] == ENDED
    assert not (bead / "several").exists()


def ready_and_gone(place, method, threads, ready):
    """In the place of `started._compute`: a process that is killed while all of them look for each other."""
    ready.send(True)


@pytest.mark.slow
def test_a_process_that_ends_while_they_look_for_each_other_ends_the_command_in_one_line(bead):
    from recon.cli.processes import started

    def run(_):
        started._compute, sys.stderr = ready_and_gone, sys.__stderr__
        return main(["reconstruct", "run.toml", "--out", "several", "--processes", "2"])

    assert forked(run, 1, bead) == [FAILED]
    assert (bead / "0.txt").read_text().splitlines()[-1] == ENDED


def test_without_a_folder_for_temporary_files_a_line_says_so(bead, monkeypatch, capsys):
    for name in ("TMPDIR", "TEMP", "TMP"):
        monkeypatch.setenv(name, str(bead / "missing"))
    monkeypatch.setattr(tempfile, "tempdir", str(bead / "missing"))
    assert main(["reconstruct", "run.toml", "--out", "several", "--processes", "2"]) == BAD_INPUT
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("torchdic: error: --processes 2: there is no folder for temporary files: ")


@pytest.mark.slow
def test_several_processes_calibrate_as_one_does(bead):
    """Each fit is that of one process, and what all do together differs by rounding alone."""
    for out, processes in (("one_calibrated", 1), ("calibrated", 3)):
        words = ["calibrate", "run.toml", "--out", out, "--processes", str(processes)]
        assert main(words) == 0
    told = [json.loads((bead / out / "calibration.json").read_text()) for out in ("one_calibrated", "calibrated")]
    one, several = (re.sub(r"-?[\d.]+(e-?\d+)?", "n", json.dumps(found)) for found in told)
    assert one == several
    pairs = zip(numbers(told[0]), numbers(told[1]), strict=True)
    assert all(a == pytest.approx(b, rel=0.02, abs=2e-3) for a, b in pairs)


def numbers(found):
    if isinstance(found, dict):
        found = list(found.values())
    if isinstance(found, list):
        return [number for part in found for number in numbers(part)]
    return [found] if isinstance(found, float) else []


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/cmdline"), reason="processes are found by Linux's /proc")
@pytest.mark.parametrize("whom", ["the first", "another"])
def test_a_process_that_is_killed_ends_all_and_refits_go_on(bead, whom):
    run = begun("error-bars", "one", "--processes", "2")
    wait_until(lambda: list(bead.glob("one/refits/*")) or run.poll() is not None)
    (other,) = others(run)
    os.kill(run.pid if whom == "the first" else other, signal.SIGKILL)
    printed, _ = run.communicate(timeout=60)
    assert run.returncode == (-signal.SIGKILL if whom == "the first" else FAILED), printed
    assert WORDS in printed
    assert "Traceback" not in printed
    wait_until(lambda: not os.path.exists(f"/proc/{other}"))
    assert main(["error-bars", "one", "--processes", "2"]) == 0


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/cmdline"), reason="processes are found by Linux's /proc")
@pytest.mark.parametrize("moment", ["at once", "within a refit"])
def test_an_interrupt_from_the_terminal_ends_all_in_one_line(bead, moment):
    run = begun("error-bars", "one", "--processes", "2")
    if moment == "within a refit":
        wait_until(lambda: list(bead.glob("one/refits/*")) or run.poll() is not None)
    else:
        wait_until(lambda: others(run) or run.poll() is not None)
    found = others(run)
    os.killpg(run.pid, signal.SIGINT)  # to all, as a terminal does
    printed, _ = run.communicate(timeout=60)
    assert run.returncode == INTERRUPTED, printed
    assert "Traceback" not in printed
    assert "interrupted" in printed.splitlines()[-1]
    wait_until(lambda: not any(os.path.exists(f"/proc/{other}") for other in found))
