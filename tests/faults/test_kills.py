"""kill −9 at any moment costs the steps since the last checkpoint, which --resume takes again."""

import os
import random
import re

import pytest
from runs import EVERY, told

KILLS = {"one process": 20, "tiles": 20, "torchrun": 3}

pytestmark = [pytest.mark.faults, pytest.mark.slow]


# A line of a traceback through the package. torchrun's own report has one, through torch.
OURS = re.compile(r'File ".*/(?:recon|torchdic)/')


def kills(*launches):
    return [(name, kill) for name in launches for kill in range(KILLS[name])]


@pytest.mark.parametrize(("launch", "kill"), kills("one process", "tiles"), indirect=["launch"])
def test_a_run_that_is_killed_goes_on_to_the_same_end(scene, tmp_path, launch, kill, tell):
    out, moment = tmp_path / "out", random.Random(kill).uniform(0, scene.seconds)
    with scene.started(out) as running:
        running.let(moment)
        running.kill()
    steps = check_goes_on(scene, out)
    tell(f"kill −9 at {KILLS[launch]} random moments", f"{steps} steps", "nothing", running.process.returncode)


@pytest.mark.skipif(not os.path.exists("/proc/self/environ"), reason="ranks are told apart by Linux's /proc")
@pytest.mark.parametrize("which", ["all", "rank 0", "rank 1"])
@pytest.mark.parametrize(("launch", "kill"), kills("torchrun"), indirect=["launch"])
def test_a_run_whose_ranks_are_killed_goes_on_to_the_same_end(scene, tmp_path, launch, kill, which, tell):
    """At a random step: most of so short a run is the processes' start."""
    out, number = tmp_path / "out", random.Random(f"{which} {kill}").randrange(1, scene.steps())
    with scene.started(out) as running:
        running.wait_for_step(number)
        if which == "all":
            running.kill()
            said, code = [], running.process.returncode
        else:
            assert running.kill_rank(int(which[-1]))
            ended = running.ended()
            said, code = ended.said, ended.code
            assert OURS.search(ended.output) is None, ended.output
    steps = check_goes_on(scene, out)
    words = re.sub(r"after step \d+", "after step …", told(said[:1]))
    tell(f"kill −9 of {which} at {KILLS[launch]} random steps", f"{steps} steps", words, code)


def check_goes_on(scene, out):
    """Check that a killed run goes on to the same end, or was at it; returns the steps that it lost."""
    steps = scene.taken(out) - scene.saved(out)
    assert 0 <= steps <= EVERY
    if scene.is_finished(out):
        scene.check_as_whole(out, killed=True)
    else:
        scene.check_resumed(out)
    return steps
