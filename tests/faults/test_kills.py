"""kill −9 at any moment costs the steps since the last checkpoint, which --resume takes again."""

import random

import pytest
from runs import EVERY, log, saved

KILLS = 20

pytestmark = [pytest.mark.faults, pytest.mark.slow]


@pytest.mark.parametrize("kill", range(KILLS))
def test_a_run_that_is_killed_goes_on_to_the_same_end(scene, tmp_path, kill, tell):
    out, moment = tmp_path / "out", random.Random(kill).uniform(0, scene.seconds)
    with scene.started(out) as running:
        running.let(moment)
        running.kill()
    steps = len(log(out)) - saved(out)
    assert 0 <= steps <= EVERY
    scene.check_resumed(out)
    tell(f"kill −9 at {KILLS} random moments", f"{steps} steps", "nothing", running.process.returncode)
