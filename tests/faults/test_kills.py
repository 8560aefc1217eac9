"""kill −9 at any moment costs the steps since the last checkpoint, which --resume takes again."""

import os
import random

import pytest
from runs import EVERY, told

KILLS = {"one process": 20, "tiles": 20, "torchrun": 5}

pytestmark = [pytest.mark.faults, pytest.mark.slow]


def kills(*launches):
    return [(name, kill) for name in launches for kill in range(KILLS[name])]


@pytest.mark.parametrize(("launch", "kill"), kills("one process", "tiles", "torchrun"), indirect=["launch"])
def test_a_run_that_is_killed_goes_on_to_the_same_end(scene, tmp_path, launch, kill, tell):
    out, moment = tmp_path / "out", random.Random(kill).uniform(0, scene.seconds)
    with scene.started(out) as running:
        running.let(moment)
        running.kill()
    steps = check_goes_on(scene, out)
    tell(f"kill −9 at {KILLS[launch]} random moments", f"{steps} steps", "nothing", running.process.returncode)


@pytest.mark.skipif(not os.path.exists("/proc/self/environ"), reason="ranks are told apart by Linux's /proc")
@pytest.mark.parametrize(("launch", "kill"), kills("torchrun"), indirect=["launch"])
def test_a_run_one_rank_of_which_is_killed_goes_on_to_the_same_end(scene, tmp_path, launch, kill, tell):
    out, random_ = tmp_path / "out", random.Random(kill)
    moment, rank = random_.uniform(0, scene.seconds), random_.choice((0, 1))
    with scene.started(out) as running:
        running.let(moment)
        running.wait_for(lambda: running.process.poll() is not None or running.kill_rank(rank))
        ended = running.ended()
    print(ended.output)
    assert "Traceback" not in ended.output
    steps = check_goes_on(scene, out)
    case = f"kill −9 of one rank of two, at {KILLS[launch]} random moments"
    tell(case, f"{steps} steps", told(sorted(set(ended.said))), ended.code)


def check_goes_on(scene, out):
    """The steps that a killed run has lost; checks that it goes on to the same end."""
    steps = scene.taken(out) - scene.saved(out)
    assert 0 <= steps <= EVERY
    if scene.is_finished(out):
        scene.check_as_whole(out)
    else:
        scene.check_resumed(out)
    return steps
