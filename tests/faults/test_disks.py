"""A disk that fills costs what has no room on it; once there is room, --resume brings all of it."""

import pytest
from on_full_disk import BALLAST
from results import RESULTS
from runs import HERE, told

# What a run writes, how often it has done so when the disk is full, and what it returns then.
FILLED = [
    ("log.csv", 1, 2),
    ("checkpoint.pt", 1, 2),
    ("checkpoint.pt", 2, 2),
    ("volume.ome.tif", 1, 2),
    ("metrics.json", 1, 2),
    ("config.resolved.toml", 1, 2),
    ("images.ome.tif", 1, 2),
    ("images.png", 1, 2),
    ("sections.png", 1, 2),
    ("misfit.png", 1, 2),
    ("run.json", 1, 2),
    ("report.html", 1, 2),
    ("README.txt", 1, 0),
]
# What a run by tiles writes besides, and results, which it writes while it still has its tiles.
FILLED_BY_TILES = [
    ("layout.json", 1, 2),
    ("log.csv", 1, 2),
    ("checkpoint.pt", 1, 2),
    ("checkpoint.pt", 2, 2),
    ("fitted.pt", 1, 2),
    ("fitted.pt", 2, 2),
    ("volume.ome.tif", 1, 2),
    ("misfit.png", 1, 2),
    ("report.html", 1, 2),
]
CASES = [
    *(("one process", *filled) for filled in FILLED),
    *(("tiles", *filled) for filled in FILLED_BY_TILES),
]

pytestmark = [pytest.mark.faults, pytest.mark.slow]


def test_every_file_is_filled_at():
    assert {name for name, *_ in FILLED} == RESULTS


@pytest.mark.parametrize(("launch", "name", "time", "code"), CASES, indirect=["launch"])
def test_a_disk_that_fills_at_a_file_loses_what_has_no_room(scene, disk, name, time, code, tell):
    out = disk / "out"
    ended = scene.run(out, by=(str(HERE / "on_full_disk.py"), name, str(time)))
    assert ended.code == code, ended.output
    results = scene.launch.results - {"log.csv", "checkpoint.pt"}
    missing = sum(not (out / kind).exists() for kind in results)
    steps = scene.steps() - scene.saved(out) if missing == len(results) else 0
    (disk / BALLAST).unlink()
    scene.check_resumed(out)
    lost = f"{missing} of {len(results)} results" + (f", {steps} of {scene.steps()} steps" if steps else "")
    nth = f"{name}, {time}" if time > 1 else name
    tell(f"the disk is full from {nth} on", lost, told(ended.said), ended.code)
