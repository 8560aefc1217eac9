"""README.txt of a folder of results says of each file what it is."""

import os

import pytest
from small_bead import CONFIG

from recon.cli import main
from recon.run.folder.index import FILES, INDEX, leave_index
from recon.run.folder.lock import LOCK

COMMANDS = (
    ("made", "simulate", "bead.toml"),
    ("seen", "coverage", "bead.toml", "--suggest"),
    ("volume", "reconstruct", "bead.toml"),
    ("image", "phase", "made/stack.ome.tif"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_each_file_of_a_folder_is_explained(folder, monkeypatch):
    monkeypatch.chdir(folder)
    (folder / "bead.toml").write_text(CONFIG)
    for out, *words in COMMANDS:
        assert main([*words, "--out", out]) == 0
    assert main(["error-bars", "volume", "--refits", "2", "--copies", "2"]) == 0
    for out, *_ in COMMANDS:
        there = {path.name for path in (folder / out).iterdir()} - {INDEX, LOCK}
        assert there <= set(FILES)
        lines = (folder / out / INDEX).read_text(encoding="utf-8").splitlines()[2:]
        assert [line.split()[0] for line in lines] == [name for name in FILES if name in there]


def test_a_readme_of_the_users_stays(tmp_path):
    (tmp_path / "stack.png").touch()
    (tmp_path / INDEX).write_text("my notes")
    leave_index(tmp_path)
    assert (tmp_path / INDEX).read_text() == "my notes"
    (tmp_path / INDEX).unlink()
    leave_index(tmp_path)
    (tmp_path / "coverage.json").touch()
    leave_index(tmp_path)  # its own is renewed
    assert "coverage.json" in (tmp_path / INDEX).read_text()


def test_error_bars_of_an_earlier_volume_are_said_to_be(tmp_path):
    for name, seconds in (("sd.ome.tif", 10), ("volume.ome.tif", 20), ("error_bars.json", 30)):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (seconds, seconds))
    leave_index(tmp_path)
    lines = {line.split()[0]: line for line in (tmp_path / INDEX).read_text().splitlines()[2:]}
    assert [name for name, line in lines.items() if line.endswith("(of an earlier volume)")] == ["sd.ome.tif"]


def test_a_folder_without_results_has_no_index(tmp_path):
    (tmp_path / "mine.txt").write_text("precious")
    leave_index(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
