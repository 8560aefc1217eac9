"""A configuration that is written anew says the same, in the keys that people think in, with its comments."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from recon.config import flat, load
from recon.config.commented import comments_of
from recon.config.rewritten import Source, rewritten, rewritten_microscope
from torchdic import Acquisition, Prism

EXPERIMENTS = Path(__file__).parent.parent / "experiments"

TEXT = """# Written by torchdic new for s.tif.

assumed = ["bias"]

[acquisition]
prisms = [                               # angle: from right towards down
    { shear = { length = 0.3, angle_degrees = 309.6 }, bias_degrees = 90.0 }, # setting 0: length assumed; …
    { shear = { length = 0.3, angle_degrees = 309.6 }, bias_degrees = -90.0 }, # setting 1
]
focus = { first = -0.8, step = 0.4, count = 5 } # step file

[microscope]
objective = { na = 0.9 }                 # file
wavelength = 0.546                       # "green", says # the file

[microscope.condenser]
na = 0.72                                # assumed

[volume]
background = 1.335                       # assumed: water
shape = [7, 40, 44]                      # slices
pixel_size = 0.15                        # file
slice_thickness = 0.4                    # chosen

[data]
path = "data/s #1.tif"                   # given
offset = 0.0                             # assumed: counts

[reconstruction]
bounds = { lower = 0.0 }                 # assumed
"""


def again(config, folder, source, comments=None):
    """A configuration that was written into a folder and read."""
    folder.mkdir(exist_ok=True)
    (folder / "again.toml").write_text(rewritten(config, folder, source, comments or {}), encoding="utf-8")
    return load(folder / "again.toml")


def same(one, other):
    """Whether two configurations hold the same, numbers but for rounding."""
    for a, b in zip(flat(one), flat(other), strict=True):
        (key, _, value), (named, _, further) = a.partition(" = "), b.partition(" = ")
        assert key == named
        if value != further:
            numbers = [float(x) for x in value.strip("[]").split(",")]
            assert numbers == pytest.approx([float(x) for x in further.strip("[]").split(",")], rel=1e-9, abs=1e-12), a
    return True


@pytest.mark.parametrize("name", sorted(path.name for path in EXPERIMENTS.glob("*.toml")))
@pytest.mark.filterwarnings("ignore::recon.config.schema.UnlikelyWarning")
def test_every_configuration_says_the_same_when_it_is_written_anew(tmp_path, name):
    try:
        config = load(EXPERIMENTS / name)
    except ValueError:
        pytest.skip("a part of a configuration, to be included")
    for source in (Source(), Source.of(EXPERIMENTS / name)):
        assert same(again(config, tmp_path, source), config)


@pytest.fixture
def written(tmp_path):
    (tmp_path / "run.toml").write_text(TEXT, encoding="utf-8")
    return load(tmp_path / "run.toml"), Source.of(tmp_path / "run.toml")


def test_what_stays_is_written_as_it_was_with_its_comments(tmp_path, written):
    config, source = written
    text = rewritten(config, tmp_path, source, {})
    told, values = tomllib.loads(TEXT), tomllib.loads(text)
    assert values == told
    comments = comments_of(TEXT)
    comments["microscope.condenser"] = comments.pop("microscope.condenser.na")  # it stands in one line now
    assert comments_of(text) == comments


def test_files_are_named_from_the_folder_in_which_it_is_written(tmp_path, written):
    config, source = written
    below = tmp_path / "out"
    assert tomllib.loads(rewritten(config, below, source, {}))["data"]["path"] == "../data/s #1.tif"
    assert again(config, below, source).data == config.data


def test_a_new_comment_goes_before_the_old_one(tmp_path, written):
    config, source = written
    new = {"volume.background": "calibrated", "acquisition.prisms[1]": "angle calibrated"}
    comments = comments_of(rewritten(config, tmp_path, source, new))
    assert comments["volume.background"] == "calibrated"
    assert comments["acquisition.prisms[1]"] == "angle calibrated"
    assert comments["acquisition.prisms[0]"].startswith("setting 0: length assumed")


def test_changed_prisms_and_planes_keep_their_keys_and_units(tmp_path, written):
    config, source = written
    prisms = [Prism((0.0, -0.25), math.radians(80)), None]
    changed = replace(config, acquisition=Acquisition(prisms, config.acquisition.focus[::-1]))
    told = tomllib.loads(rewritten(changed, tmp_path, source, {}))["acquisition"]
    assert told["prisms"] == [{"shear": {"length": 0.25, "angle_degrees": 180.0}, "bias_degrees": 80.0}, "brightfield"]
    assert told["focus"] == {"first": 0.8, "step": -0.4, "count": 5}
    uneven = replace(config, acquisition=Acquisition(prisms, [0.0, 0.4, 0.9, 1.0, 1.1]))
    assert tomllib.loads(rewritten(uneven, tmp_path, source, {}))["acquisition"]["focus"] == [0.0, 0.4, 0.9, 1.0, 1.1]


def test_prisms_keep_the_files_of_their_images(tmp_path):
    own = TEXT.replace('path = "data/s #1.tif"', "order = 3").replace("90.0 }", '90.0, file = "FILE", channel = 1 }')
    for name in ("plus.tif", "minus.tif"):
        own = own.replace("FILE", name, 1)
    (tmp_path / "run.toml").write_text(own, encoding="utf-8")
    config, source = load(tmp_path / "run.toml"), Source.of(tmp_path / "run.toml")
    assert config.data is not None
    assert same(again(config, tmp_path / "out", source), config)
    told = tomllib.loads((tmp_path / "out" / "again.toml").read_text())
    assert [prism["file"] for prism in told["acquisition"]["prisms"]] == ["../plus.tif", "../minus.tif"]
    assert "paths" not in told["data"]


CALIBRATION = """
[calibration]
bead = { radius = 2.5, index = 1.59 }    # from its maker
one_exposure = true
bias_within_degrees = 3.0                # read twice
angle_within = 0.02                      # rad
"""


def test_how_a_calibration_works_is_kept_with_its_comments(tmp_path, written):
    """In the unit of its file, and in degrees where that says nothing."""
    (tmp_path / "run.toml").write_text(TEXT + CALIBRATION, encoding="utf-8")
    config, source = load(tmp_path / "run.toml"), Source.of(tmp_path / "run.toml")
    text = rewritten(config, tmp_path, source, {})
    told = tomllib.loads(CALIBRATION)["calibration"]
    assert tomllib.loads(text)["calibration"] == told
    comments, before = comments_of(text), comments_of(CALIBRATION)
    assert {key: comments[key] for key in before} == before
    assert same(again(config, tmp_path, source), config)
    assert tomllib.loads(rewritten(config, tmp_path, written[1], {}))["calibration"] == {
        **{key: value for key, value in told.items() if key != "angle_within"},
        "angle_within_degrees": pytest.approx(math.degrees(0.02)),
    }


def test_how_closely_a_bead_tells_has_no_comment_of_what_was_told(tmp_path):
    (tmp_path / "run.toml").write_text(TEXT + CALIBRATION, encoding="utf-8")
    config, source = load(tmp_path / "run.toml"), Source.of(tmp_path / "run.toml")
    text = rewritten_microscope(config, source, {})
    assert not [key for key in comments_of(text) if key.startswith("calibration.")]


def test_the_microscope_alone_is_what_other_stacks_include(tmp_path, written):
    config, source = written
    (tmp_path / "scope.toml").write_text(rewritten_microscope(config, source, {}), encoding="utf-8")
    values = tomllib.loads((tmp_path / "scope.toml").read_text())
    assert set(values) == {"microscope", "acquisition", "calibration"}
    assert set(values["calibration"]) == {"length_within", "bias_within_degrees", "angle_within_degrees"}
    assert set(values["acquisition"]) == {"prisms"}
    rest = TEXT[TEXT.index("[volume]") :]
    (tmp_path / "cell.toml").write_text(f'include = "scope.toml"\n{rest}', encoding="utf-8")
    assert load(tmp_path / "cell.toml").acquisition.prisms[1].shear == config.acquisition.prisms[1].shear


def test_comments_are_told_from_quoted_signs():
    text = "\n".join(
        (
            'a = "x # y" # one',
            r'b = "C:\\" # two',
            "[t]",
            "c = 'it # is' # three",
            "d = [ # four",
            "  1, # five",
            "  # six",
            "  2, # seven",
            "]",
            "# eight",
            "e = 1",
        )
    )
    assert comments_of(text) == {
        "a": "one",
        "b": "two",
        "t.c": "three",
        "t.d": "four",
        "t.d[0]": "five",
        "t.d[1]": "seven",
    }
