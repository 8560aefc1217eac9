"""What befalls the folder of a run, its stack and its clock."""

import json
import shutil
import subprocess

import numpy as np
import pytest
from runs import HERE, log, told

from torchdic.files.stack import read_stack, write_stack

pytestmark = [pytest.mark.faults, pytest.mark.slow]


def test_a_folder_that_vanishes_is_made_anew(scene, tmp_path, tell):
    out = tmp_path / "out"
    with scene.started(out) as running:
        running.wait_for_step(4)
        shutil.rmtree(out)
        ended = running.ended()
    print(ended.output)
    assert ended.code == 0
    scene.check_as_whole(out)
    tell("the folder vanishes during the run", "nothing", told(ended.said), ended.code)


@pytest.mark.parametrize("launch", ["tiles"], indirect=True)
@pytest.mark.parametrize("number", [0, 1])
def test_a_folder_that_vanishes_loses_the_tiles_that_were_fitted(scene, tmp_path, number, tell):
    out, tiles = tmp_path / "out", list(json.loads((scene.whole / "metrics.json").read_text())["tiles"]["steps"])
    with scene.started(out) as running:
        running.wait_for(lambda: len(log(out / "tiles" / tiles[number])) >= 4)
        shutil.rmtree(out)
        ended = running.ended()
    print(ended.output)
    assert ended.code == (2 if number else 0)
    assert "Traceback" not in ended.output
    if number:
        scene.check_resumed(out)
    else:
        scene.check_as_whole(out)
    lost = f"{number} of {len(tiles)} tiles"
    tell(f"the folder vanishes during tile {number + 1}", lost, told(ended.said), ended.code)


def test_a_folder_that_cannot_be_written_to_is_refused(scene, disk, tell):
    out = disk / "out"
    out.mkdir()
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    ended = scene.run(out)
    print(ended.output)
    assert ended.code == 2
    assert len(ended.said) == 1
    assert list(out.iterdir()) == []
    tell("the folder is read-only", "nothing", told(ended.said), ended.code)


def test_a_stack_that_changes_during_the_run(scene, tmp_path, tell):
    out, stack = tmp_path / "out", scene.folder / "stack.ome.tif"
    before = stack.read_bytes()
    try:
        with scene.started(out) as running:
            running.wait_for_step(4)
            data = read_stack(stack).data
            write_stack(stack, (data + np.float32(0.1) * data[..., ::-1, :]).astype(data.dtype), (0.2, 0.2), 1.0)
            ended = running.ended()
        print(ended.output)
        assert ended.code == 0
        scene.check_as_whole(out)
        again = scene.run(out, "--resume")
        assert again.code == 2
    finally:
        stack.write_bytes(before)
    assert len(ended.said) == 1
    tell("the stack changes during the run", "nothing", told(ended.said), ended.code)
    tell("the run goes on with a stack that has changed", "nothing", told(again.said), again.code)


def test_a_clock_that_jumps_changes_nothing(scene, tmp_path, tell):
    out = tmp_path / "out"
    ended = scene.run(out, by=(str(HERE / "with_jumping_clock.py"),))
    print(ended.output)
    assert ended.code == 0
    scene.check_as_whole(out)
    tell("the clock jumps back and forth by years", "nothing", told(ended.said), ended.code)


def test_a_second_run_into_the_folder_is_refused(scene, tmp_path, tell):
    out = tmp_path / "out"
    with scene.started(out) as running:
        running.wait_for_step(2)
        second = scene.run(out, "--restart")
        first = running.ended()
    print(second.output, first.output)
    assert (first.code, second.code) == (0, 2)
    assert len(second.said) == 1
    scene.check_as_whole(out)
    tell("a second run into the same folder", "nothing; the first goes on", told(second.said), second.code)
