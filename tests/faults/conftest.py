"""What the tests of faults share: a scene for each way to start a run, disks that may fill, and the table of rows."""

import shutil
import subprocess
from functools import cache

import pytest
from runs import LAUNCHES, Scene

TITLES = ("case", "what is lost until --resume", "what is said", "exit code")


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """A function that makes the scene of a launch, once."""
    return cache(lambda name: Scene.made(tmp_path_factory.mktemp("scene"), LAUNCHES[name]))


@pytest.fixture
def launch(request):
    """The name of the launch that a test is of; one process, where its parameters don't say."""
    return getattr(request, "param", "one process")


@pytest.fixture
def scene(scenes, launch):
    return scenes(launch)


@pytest.fixture
def tell(record_property, launch):
    """A function that adds a row to the table of faults."""
    prefix = "" if launch == "one process" else f"{launch}: "
    return lambda case, lost, said, code: record_property("fault", (prefix + case, lost, said, str(code)))


@pytest.fixture
def disk(tmp_path):
    """A disk of 16 MiB of its own."""
    path = tmp_path / "disk"
    path.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", path], check=False, capture_output=True
    )
    if not mounted or mounted.returncode != 0:
        pytest.skip("no right to mount a small disk; make faults asks for it by unshare, where the system allows that")
    yield path
    subprocess.run(["umount", "--lazy", path], check=True)


def pytest_terminal_summary(terminalreporter):
    """With --table, a row for each fault: what was lost, what was said, the exit code; of one that came often, each."""
    if not terminalreporter.config.getoption("--table"):
        return
    reports = [r for outcome in ("passed", "failed") for r in terminalreporter.getreports(outcome) if r.when == "call"]
    rows: dict[str, list[set[str]]] = {}
    for report in sorted(reports, key=lambda report: (*report.location[:2], report.nodeid)):
        for name, value in report.user_properties:
            if name == "fault":
                case, *cells = value
                for cell, known in zip(cells, rows.setdefault(case, [set(), set(), set()]), strict=True):
                    known.add(cell)
    if rows:
        terminalreporter.section("faults")
        lines = [[case, *(" or ".join(sorted(cell)) for cell in cells)] for case, cells in rows.items()]
        for line in (TITLES, ["---"] * 4, *lines):
            terminalreporter.write_line(f"| {' | '.join(line)} |")
