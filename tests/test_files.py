import json
import os
import stat

import pytest

from torchdic.files.whole import write_json, write_text, written_whole


def test_a_file_appears_whole_at_the_end(tmp_path):
    path = tmp_path / "result.txt"
    with written_whole(path) as partial:
        partial.write_text("half", encoding="utf-8")
        assert not path.exists()
        partial.write_text("whole", encoding="utf-8")
    assert path.read_text(encoding="utf-8") == "whole"
    assert list(tmp_path.iterdir()) == [path]


def test_an_earlier_file_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "result.txt"
    path.write_text("earlier", encoding="utf-8")
    with written_whole(path) as partial:
        partial.write_text("new", encoding="utf-8")
        assert path.read_text(encoding="utf-8") == "earlier"
    assert path.read_text(encoding="utf-8") == "new"


@pytest.mark.parametrize("error", [ValueError, OSError, KeyboardInterrupt])
def test_a_failure_leaves_the_earlier_file_and_no_partial_one(tmp_path, error):
    path = tmp_path / "result.txt"
    path.write_text("earlier", encoding="utf-8")

    def fail():
        with written_whole(path) as partial:
            partial.write_text("half", encoding="utf-8")
            raise error

    with pytest.raises(error):
        fail()
    assert path.read_text(encoding="utf-8") == "earlier"
    assert list(tmp_path.iterdir()) == [path]


def test_the_partial_file_is_beside_the_final_one_hidden_and_of_its_suffix(tmp_path):
    with written_whole(tmp_path / "volume.ome.tif") as partial:
        assert partial.parent == tmp_path
        assert partial.suffix == ".tif"
        assert partial.name.startswith(".")


def test_permissions_are_those_of_any_new_file(tmp_path):
    before = os.umask(0o027)
    try:
        with written_whole(tmp_path / "result.txt"):
            pass
    finally:
        assert os.umask(before) == 0o027  # and the mask is left as it was
    assert stat.S_IMODE((tmp_path / "result.txt").stat().st_mode) == 0o640


@pytest.mark.parametrize("place", ["none", "file"])
def test_a_folder_that_is_none_is_an_os_error(tmp_path, place):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(OSError, match=place), written_whole(tmp_path / place / "result.txt"):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_path_may_be_a_string(tmp_path):
    with written_whole(str(tmp_path / "result.txt")) as partial:
        partial.write_text("whole", encoding="utf-8")
    assert (tmp_path / "result.txt").read_text(encoding="utf-8") == "whole"


def test_json_and_text_are_what_they_hold(tmp_path):
    write_text(tmp_path / "text.txt", "Δn µm\n")
    assert (tmp_path / "text.txt").read_bytes() == "Δn µm\n".encode()
    write_json(tmp_path / "values.json", {"error": 0.5, "rows": [1, None]})
    assert json.loads((tmp_path / "values.json").read_text(encoding="utf-8")) == {"error": 0.5, "rows": [1, None]}


def test_values_that_json_does_not_know_leave_the_file_as_it_was(tmp_path):
    write_json(tmp_path / "values.json", [1])
    with pytest.raises(TypeError):
        write_json(tmp_path / "values.json", [object()])
    assert json.loads((tmp_path / "values.json").read_text(encoding="utf-8")) == [1]
