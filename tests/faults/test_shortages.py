"""Memory that a run has not got: what is foreseen is refused, and what isn't ends in one line; its steps are kept."""

import re
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from runs import CONFIG, ENV, HERE, log, said_in, saved, told

from torchdic.files.stack import write_stack

pytestmark = [
    pytest.mark.faults,
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="no other process's memory can be limited here"),
]

NEED = "need at least"
# Each command, with what is changed in the configuration, MiB that are free, and what is said. A calibration's parts of
# a stack are so small that there is hardly room to foresee what doesn't fit.
FORESEEN = {
    "simulate": ("", 72, f"Pictures and files of the results {NEED}"),
    "simulate, exact": ("[simulation]\nexact = true\n", 112, f"Images from the exact field on 640×640 pixels {NEED}"),
    "plan, of a stack": ("", 112, f"A volume of 8×320×320 voxels by method 'linear' {NEED}"),
    "calibrate": ("", 48, "the memory ran out"),
    "reconstruct": ('tiles = "none"\n', 160, f"Steps of a reconstruction of 8×320×320 voxels {NEED}"),
    # their tiles would have room, their results have none
    "reconstruct, in tiles": ("", 160, f"Pictures and files of the results {NEED}"),
    "reconstruct, planned": ("", 160, f"Pictures and files of the results {NEED}"),
    "reconstruct, linear": ('method = "linear"\n', 160, f"A volume of 8×320×320 voxels by method 'linear' {NEED}"),
    "reconstruct, opl": ('method = "opl"\n', 96, f"Pictures and files of the results {NEED}"),
}


def size(running):
    """The address space of a process, in bytes."""
    return int(Path(f"/proc/{running.pid}/statm").read_text().split()[0]) * resource.getpagesize()


@pytest.mark.parametrize("case", FORESEEN)
def test_what_has_no_room_is_refused_before_it_begins(tmp_path, case, tell):
    command, _, kind = case.partition(", ")
    more, room, wanted = FORESEEN[case]
    config = re.sub(r"shape = .*", "shape = [8, 320, 320]", CONFIG) + more
    if kind == "of a stack":
        config = re.sub(r"\[specimen\](.*\n)*?(?=\[data\])", "", config)
    if kind == "planned":
        config = "tolerance = 0.05\n" + re.sub(r"\[fidelity\]\nsources = .*\n", "", config)
    (tmp_path / "run.toml").write_text(config, encoding="utf-8")
    images = 0.5 + 0.02 * np.random.default_rng(0).standard_normal((2, 3, 320, 320))
    write_stack(tmp_path / "stack.ome.tif", images.astype(np.float32), (0.2, 0.2), 1.0)
    words = [HERE / "with_little_memory.py", str(room), command, tmp_path / "run.toml", "--out", tmp_path / "out"]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, env=ENV)
    said = said_in(done.stderr)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert wanted in said[-1]
    assert not (tmp_path / "out").exists()
    tell(f"{case}: too large for the memory", "nothing is begun", told(said), done.returncode)


def test_memory_that_runs_out_during_a_step_loses_no_step(scene, tmp_path, tell):
    out = tmp_path / "out"
    with scene.started(out) as running:
        running.wait_for_step(4)
        resource.prlimit(running.pid, resource.RLIMIT_AS, (size(running),) * 2)
        ended = running.ended()
    assert ended.code == 2, ended.output
    assert len(ended.said) == 1
    steps = len(log(out)) - saved(out)
    scene.check_resumed(out)
    tell("memory runs out during a step", f"{steps} steps", told(ended.said), ended.code)
