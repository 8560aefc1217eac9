"""A configuration that includes others: theirs are the values that it doesn't say itself."""

import tomllib

import pytest
from refusal import the_error

from recon.config import ConfigError, dump, load

MICROSCOPE = """
[microscope]
wavelength = 0.546
objective = { na = 1.2, aberrations = { 11 = 0.1 } }
condenser = { na = 0.9 }
[data]
path = "nothing.tif"
mask = "dust.tif"
offset = 100.0
"""

SPECIMEN = """
[volume]
shape = [4, 30, 30]
spacing = [0.3, 0.1, 0.1]
background = 1.335
[acquisition]
focus = [-1.0, 0.0]
prisms = [{ shear = [0.0, 0.2], bias = 1.5 }]
"""


@pytest.fixture
def write(tmp_path):
    def put(name, content):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding="utf-8")
        return path

    return put


def test_the_including_file_wins_key_by_key(write):
    write("microscope.toml", MICROSCOPE)
    own = SPECIMEN + '[microscope]\ncondenser = { na = 0.5 }\nobjective = { na = 1.3 }\n[data]\npath = "cell.tif"\n'
    config = load(write("cell.toml", f'include = "microscope.toml"\n{own}'))
    assert config.microscope.wavelength == 0.546
    assert (config.microscope.objective.na, config.microscope.objective.aberrations) == (1.3, {11: 0.1})
    assert config.microscope.condenser.na == 0.5
    assert (config.data.path.rpartition("/")[2], config.data.offset) == ("cell.tif", 100.0)


def test_a_relative_path_starts_from_the_folder_of_the_file_that_says_it(write, tmp_path):
    write("scope/microscope.toml", MICROSCOPE)
    config = load(write("cells/a.toml", f'include = "../scope/microscope.toml"\n{SPECIMEN}[data]\npath = "a.tif"\n'))
    assert config.data.path == str(tmp_path / "cells" / "a.tif")
    assert config.data.mask == str(tmp_path / "scope" / "dust.tif")


def test_of_several_files_a_later_one_goes_before_an_earlier_one_and_includes_nest(write):
    write("lamp.toml", "[microscope]\nwavelength = 0.6\ncondenser = { na = 0.3 }\n")
    write("lens.toml", 'include = "lamp.toml"\n[microscope]\nobjective = { na = 0.8 }\ncondenser = { na = 0.4 }\n')
    write("again.toml", "[microscope]\nobjective = { na = 0.7 }\n")
    config = load(write("a.toml", f'include = ["lens.toml", "again.toml"]\n{SPECIMEN}'))
    found = config.microscope
    assert (found.wavelength, found.condenser.na, found.objective.na) == (0.6, 0.4, 0.7)


def test_one_file_may_be_included_along_two_ways(write):
    write("microscope.toml", MICROSCOPE)
    write("b.toml", 'include = "microscope.toml"\n')
    write("c.toml", 'include = "microscope.toml"\n')
    assert load(write("a.toml", f'include = ["b.toml", "c.toml"]\n{SPECIMEN}')).microscope.objective.na == 1.2


def test_another_spelling_of_a_value_replaces_the_included_one(write):
    write("base.toml", MICROSCOPE + SPECIMEN)
    volume = "[volume]\npixel_size = 0.2\nslice_thickness = 0.4\n"
    planes = "[acquisition]\nfocus = { first = 0, step = 1, count = 2 }\n"
    config = load(write("a.toml", f'include = "base.toml"\n{volume}{planes}'))
    assert config.volume.spacing == (0.4, 0.2, 0.2)
    assert config.acquisition.focus == (0.0, 1.0)


def test_the_resolved_configuration_includes_nothing(write):
    write("microscope.toml", MICROSCOPE)
    resolved = dump(load(write("a.toml", f'include = "microscope.toml"\n{SPECIMEN}')))
    assert "include" not in tomllib.loads(resolved)
    assert dump(load(write("elsewhere/config.toml", resolved))) == resolved


def test_a_wrong_value_of_an_included_file_is_told_with_all_files(write):
    write("microscope.toml", MICROSCOPE.replace("0.546", "546"))
    path = write("a.toml", f'include = "microscope.toml"\n{SPECIMEN}')
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path} (with microscope.toml): microscope.wavelength: 546 µm")


def test_a_missing_file_is_named(write, tmp_path):
    message = the_error(write("a.toml", f'include = "microscop.toml"\n{SPECIMEN}'))
    assert message == f"include: {tmp_path / 'microscop.toml'}: No such file or directory"


def test_a_link_to_itself_is_named(write, tmp_path):
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    error = the_error(write("run.toml", 'include = "loop.toml"'))
    assert error == f"include: {tmp_path / 'loop.toml'}: Too many levels of symbolic links"


def test_a_folder_that_results_cannot_name_is_refused(write, tmp_path):
    """Its name isn't UTF-8, and config.resolved.toml says where the stack is."""
    try:
        (tmp_path / "caf\udce9").mkdir()
    except OSError:
        pytest.skip("this file system has names in UTF-8 alone")
    error = the_error(write("caf\udce9/run.toml", f'{SPECIMEN}\n[data]\npath = "s.tif"'))
    assert error.endswith("s.tif is a name that isn't UTF-8, in which a configuration is written; rename it")


def test_a_file_that_is_not_toml_is_named(write, tmp_path):
    write("microscope.toml", "[microscope\n")
    message = the_error(write("a.toml", f'include = "microscope.toml"\n{SPECIMEN}'))
    assert message.startswith(f"include: {tmp_path / 'microscope.toml'}: is not TOML: ")


@pytest.mark.parametrize(
    ("files", "circle"),
    [
        ({"a.toml": "a.toml"}, "a.toml → a.toml"),
        ({"a.toml": "b.toml", "b.toml": "c.toml", "c.toml": "b.toml"}, "b.toml → c.toml → b.toml"),
        ({"a.toml": "b.toml", "b.toml": "c.toml", "c.toml": "a.toml"}, "a.toml → b.toml → c.toml → a.toml"),
    ],
)
def test_a_circle_is_told_file_by_file(write, files, circle):
    for name, included in files.items():
        path = write(name, f'include = "{included}"\n')
    path = path.parent / "a.toml"
    assert the_error(path) == f"include: {circle} is a circle: a file can't include itself"


@pytest.mark.parametrize("value", ["3", "[3]", "{ file = 'a' }", "true"])
def test_what_is_no_name_is_refused(write, value):
    message = the_error(write("a.toml", f"include = {value}\n{SPECIMEN}"))
    assert message.endswith("must be the name of a file, or an array of names")


def test_an_include_within_a_table_is_told_where_it_belongs(write):
    message = the_error(write("a.toml", f'{MICROSCOPE}{SPECIMEN}include = "b.toml"\n'))
    assert message == "unknown key acquisition.include; it stands at the top of a file, before its first table"
