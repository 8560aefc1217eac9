"""The command as torchrun starts it, and what becomes of a run one of whose processes is killed."""

import os
import signal
import time

import pytest
import tifffile
from popen import python
from small_bead import CONFIG
from test_tiles import CONFIG as TILES

from recon.cli import main

pytestmark = pytest.mark.slow

LINUX = pytest.mark.skipif(not os.path.exists("/proc/self/environ"), reason="ranks are told apart by Linux's /proc")

# Enough steps to be killed in.
LONG = (
    CONFIG.replace("steps = 4", "steps = 14\ncheckpoint_every = 1")
    .replace("sources = 8", "sources = 24")
    .replace("shape = [6, 26, 24]", "shape = [12, 64, 60]")
)

IN_TILES = TILES.replace("shape = [3, 22, 40]", "shape = [3, 40, 40]")


@pytest.fixture
def bead(tmp_path, monkeypatch, no_pictures):
    """A bead's configuration, its stack, and its volume by one process."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.toml").write_text(LONG)
    assert main(["simulate", "run.toml", "--out", "made"]) == 0
    assert main(["reconstruct", "run.toml", "--out", "one"]) == 0
    return tmp_path


def run_by(number, *options):
    torchrun = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(number), *options)
    return python(*torchrun, "-m", "recon", "reconstruct", "run.toml", "--out", "several", "--resume")


def wait_for_steps(run, folder):
    """Wait until a third of the steps are taken."""
    until = time.monotonic() + 120
    log = folder / "several" / "log.csv"
    while not (log.exists() and len(log.read_text().splitlines()) > 4):
        assert run.poll() is None, run.communicate()[0]
        assert time.monotonic() < until
        time.sleep(0.05)


def kill_one(run, folder, rank):
    wait_for_steps(run, folder)
    with open(f"/proc/{run.pid}/task/{run.pid}/children") as file:
        children = file.read()
    for child in map(int, children.split()):
        with open(f"/proc/{child}/environ", "rb") as file:
            if f"RANK={rank}".encode() in file.read().split(b"\0"):
                os.kill(child, signal.SIGKILL)


def as_by_one(folder):
    one, several = (tifffile.imread(folder / name / "volume.ome.tif") for name in ("one", "several"))
    return abs(several - one).max() / abs(one).max()


@pytest.mark.parametrize("number", [2, 4])
def test_processes_find_the_volume_of_one(number, bead):
    run = run_by(number)
    printed = run.communicate()[0]
    assert run.returncode == 0, printed
    assert printed.count("several/volume.ome.tif: ") == 1
    assert as_by_one(bead) < 1e-4


def test_tiles_that_processes_share_out_make_the_volume_of_one(tmp_path, monkeypatch, no_pictures):
    """Four tiles: the first is fitted by both processes together, and of the others each fits its own."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run.toml").write_text(IN_TILES)
    assert main(["simulate", "run.toml", "--out", "made"]) == 0
    assert main(["reconstruct", "run.toml", "--out", "one"]) == 0
    run = run_by(2)
    printed = run.communicate()[0]
    assert run.returncode == 0, printed
    assert printed.count("4 tiles of ") == 1
    assert not (tmp_path / "several" / "tiles").exists()
    assert as_by_one(tmp_path) < 1e-4


@LINUX
@pytest.mark.parametrize("rank", [0, 1])
def test_a_killed_process_ends_the_run_in_one_line_and_the_checkpoint_serves(rank, bead):
    run = run_by(2)
    kill_one(run, bead, rank)
    printed = run.communicate()[0]
    assert run.returncode != 0
    # once by the command, and once more at the end of torchrun's report
    told = [line for line in printed.splitlines() if "another process of this run has ended" in line]
    assert [line.lstrip().startswith("traceback :") for line in told] == [False, True]
    assert "--resume" in told[0]
    assert main(["reconstruct", "run.toml", "--out", "several", "--resume"]) == 0
    assert as_by_one(bead) < 1e-4


def test_a_run_that_is_asked_to_end_leaves_a_checkpoint(bead):
    run = run_by(2)
    wait_for_steps(run, bead)
    run.terminate()
    printed = run.communicate()[0]
    assert printed.count("torchdic: error: interrupted after step") == 1
    assert "has ended" not in printed
    assert main(["reconstruct", "run.toml", "--out", "several", "--resume"]) == 0
    assert as_by_one(bead) < 1e-4


@LINUX
@pytest.mark.parametrize("rank", [0, 1])
def test_torchrun_starts_a_run_again_that_goes_on(rank, bead):
    run = run_by(2, "--max-restarts", "1")
    kill_one(run, bead, rank)
    printed = run.communicate()[0]
    assert run.returncode == 0, printed
    assert as_by_one(bead) < 1e-4
