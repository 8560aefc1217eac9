"""A sample of the faults, small enough for every day."""

import shutil
import sys
from collections import Counter

import pytest
from runs import Launch, Running, Scene, log, saved
from small_bead import CONFIG

from recon.cli import main
from recon.run import recorded

pytestmark = pytest.mark.faults


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A scene whose run to which nothing happens takes place here, without a process of its own."""
    folder = tmp_path_factory.mktemp("small")
    config = CONFIG.replace("made/stack", "stack").replace("steps = 4", "steps = 6\ncheckpoint_every = 2")
    (folder / "run.toml").write_text(config, encoding="utf-8")
    assert main(["simulate", str(folder / "run.toml"), "--out", str(folder / "made")]) == 0
    shutil.copy(folder / "made" / "stack.ome.tif", folder)
    assert main(["reconstruct", str(folder / "run.toml"), "--out", str(folder / "whole")]) == 0
    return Scene(folder, Launch(config=config), 0.0)


def test_a_run_that_is_killed_goes_on_to_the_same_end(small, tmp_path):
    out = tmp_path / "out"
    with small.started(out) as running:
        running.wait_for_file("checkpoint.pt")
        running.kill()
    assert saved(out) >= 2
    assert len(log(out)) - saved(out) <= 2
    (out / ".partial-of-the-run-that-was-killed.pt").write_bytes(b"half")
    assert main(["reconstruct", str(small.folder / "run.toml"), "--out", str(out), "--resume"]) == 0
    small.check_as_whole(out)


@pytest.mark.filterwarnings("default::recon.run.checkpoint.UnsavedWarning")
def test_a_folder_that_vanishes_is_made_anew(small, tmp_path, monkeypatch, capsys):
    out, minimise, removed = tmp_path / "out", recorded.minimise, Counter()

    def removing(*arguments):
        for step in minimise(*arguments):
            if step.number == 4:
                shutil.rmtree(out)
                removed[step.number] += 1
            yield step

    monkeypatch.setattr(recorded, "minimise", removing)
    assert main(["reconstruct", str(small.folder / "run.toml"), "--out", str(out)]) == 0
    assert removed[4] == 1
    assert capsys.readouterr().err.count("out: the folder was removed during the run; it is made anew") == 1
    small.check_as_whole(out)


@pytest.mark.slow
def test_a_folder_that_another_run_has_made_anew_is_left_to_it(small, tmp_path, monkeypatch, capsys):
    """As when the folder of a run is removed, and the same command is given once more."""
    out, minimise = tmp_path / "out", recorded.minimise
    holds = (
        "import sys, time; from pathlib import Path; from recon.run.folder.prepared import prepare_folder; "
        "from recon.run.folder.lock import folders_released\n"
        "with folders_released():\n"
        "    prepare_folder(Path(sys.argv[1])); (Path(sys.argv[1]) / 'held').touch(); time.sleep(600)"
    )
    others = []

    def removing(*arguments):
        for step in minimise(*arguments):
            if step.number == 4:
                shutil.rmtree(out)
                others.append(Running([sys.executable, "-c", holds, str(out)], out))
                others[0].wait_for_file("held")
            yield step

    monkeypatch.setattr(recorded, "minimise", removing)
    try:
        assert main(["reconstruct", str(small.folder / "run.toml"), "--out", str(out)]) == 2
    finally:
        others[0].kill()
    assert "out: another run is writing into it" in capsys.readouterr().err
    assert {path.name for path in out.iterdir()} == {".lock", "held"}
