"""torchdic new: recorded stacks of several kinds give back what was put in, and the file that is written runs."""

import argparse
import math
import os
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_synthetic import Ellipsoid
from data_synthetic.recorder.drawn import drawn
from data_synthetic.recorder.faults import Faults
from data_synthetic.recorder.record import Finer, record
from data_synthetic.recorder.writing import KINDS, write_recording
from data_synthetic.scenes.any_specimen import solid
from recon.cli import main
from recon.cli.arguments import repeated
from recon.cli.own_stack.new import arguments
from recon.cli.own_stack.options import OPTIONS, SEVERAL
from recon.cli.own_stack.settled import settle, slices_of
from recon.cli.own_stack.table import warnings_of
from recon.config.commented import Line, commented, inline
from recon.config.plausible.unlikely import like_radians
from recon.config.reading import load
from recon.config.schema import UnlikelyWarning
from recon.recording.survey.direction import ShearDirection
from recon.recording.survey.survey import SettingSurvey, Survey
from recon.run.data import load_data
from torchdic import Acquisition, Camera, Condenser, Grid, Microscope, Objective, Prism
from torchdic.files.described.setup import StatedSetup
from torchdic.files.format import Stack
from torchdic.files.gathered import Gathered
from torchdic.files.stack import read_stack, write_stack

FIELD = Grid((6, 40, 44), (0.5, 0.15, 0.15))
CAMERA = Camera(photons=8000.0, read_noise=2.0, gain=0.4, offset=60.0, bits=12)
SPECIMEN = solid(Ellipsoid((0.9, 0.7, 1.3)), 0.02, 1.335)


def recorded(biases=(1.4, -1.4), degrees=40, planes=5):
    angle = math.radians(degrees)
    prisms = [Prism((0.25 * math.sin(angle), 0.25 * math.cos(angle)), bias) for bias in biases]
    focus = [0.4 * (k - (planes - 1) / 2) for k in range(planes)]
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.6), CAMERA)
    faults = Faults(tilt=(0.1, 0.05), flicker=0.01, hot=3, dead=1, dark_current=0.5)
    return record(SPECIMEN, FIELD, microscope, Acquisition(prisms, focus), faults, Finer((1, 1, 1), 12, 8), 3)


@pytest.fixture(scope="module")
def recording():
    return recorded()


def new(*words):
    return main(["new", *map(str, words)])


def written(recording, folder, kind="ome"):
    return write_recording(recording, folder / ("planes" if "micro" in kind or "folder" in kind else "s.tif"), kind)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "pages"])
def test_a_recording_gives_back_what_was_put_in(tmp_path, recording, kind, capsys):
    """Sizes and apertures exactly where the file has them, else they are named as assumed; angle to 5°, signs right."""
    stack = written(recording, tmp_path, kind)
    assert new(stack, "--out", tmp_path / "run.toml") == 0
    config, text = load(tmp_path / "run.toml"), (tmp_path / "run.toml").read_text()
    first, second = config.acquisition.prisms
    assert first is not None
    assert second is not None
    angle = math.degrees(math.atan2(float(first.shear[0]), float(first.shear[1])))
    assert abs((angle - 40 + 180) % 360 - 180) < 5
    assert second.shear == first.shear
    assert float(first.bias) == -float(second.bias) > 0
    assert len(config.acquisition.focus) == 5
    assert config.volume.shape[1:] == (40, 44)
    assert config.data is not None
    assert np.array_equal(read_stack(config.data.path).data, recording.data)
    sized, lens = kind in ("ome", "imagej", "micro-manager"), kind not in ("tiff", "folder")
    assert ("pixel size" in config.assumed) == (not sized)
    assert ("objective's NA" in config.assumed) == (not lens)
    assert ("wavelength" in config.assumed) == (kind != "ome")
    if sized:
        assert config.volume.spacing[1:] == pytest.approx((0.15, 0.15), rel=1e-5)
        assert np.allclose(np.diff(config.acquisition.focus), 0.4)
    if lens:
        assert config.microscope.objective is not None
        assert config.microscope.objective.na == 0.9
    printed = capsys.readouterr().out
    assert "2 prism settings × 5 planes × 40 × 44 pixels" in printed
    assert "3, 1, 0" in printed  # hot, dead, saturated pixels
    origins = ("assumed", "measured", "file", "chosen", "given", "angle: from right")
    assert all(any(word in line for word in origins) for line in values(text))


def values(text):
    """The lines of a configuration that hold a value."""
    return [line for line in text.splitlines() if ("=" in line and not line.startswith("#"))]


def test_what_is_written_reconstructs_as_it_is_and_warns_of_what_is_assumed(tmp_path, recording, capsys):
    assert new(written(recording, tmp_path), "--out", tmp_path / "run.toml") == 0
    text = (tmp_path / "run.toml").read_text()
    (tmp_path / "run.toml").write_text(text.replace("[reconstruction]", "[reconstruction]\nsteps = 2"))
    assert main(["reconstruct", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "volume.ome.tif").exists()
    printed = capsys.readouterr()
    assert "run.toml: assumed, not known: shear's length, bias, condenser's NA, medium's index" in printed.err
    assert "4 stuck pixels" in printed.out


def test_options_fill_in_what_the_file_lacks(tmp_path, recording):
    options = {
        "pixel-size": 0.15,
        "z-step": 0.4,
        "wavelength": 0.546,
        "na": 0.9,
        "condenser-na": 0.6,
        "background": 1.34,
        "shear": 0.25,
        "bias": 80,
        "offset": 60,
    }
    words = [word for name, value in options.items() for word in (f"--{name}", value)]
    assert new(written(recording, tmp_path, "tiff"), "--out", tmp_path / "run.toml", *words) == 0
    config = load(tmp_path / "run.toml")
    assert config.assumed == ("order of the planes", "sign of Δn")
    assert config.microscope.condenser is not None
    assert (config.microscope.wavelength, config.microscope.condenser.na) == (0.546, 0.6)
    assert config.volume.background == 1.34
    assert config.data is not None
    assert config.data.offset == 60
    (first, _), shear = config.acquisition.prisms, 0.25
    assert first is not None
    assert math.hypot(*map(float, first.shear)) == pytest.approx(shear)
    assert float(first.bias) == pytest.approx(math.radians(80))


def test_every_value_that_is_assumed_is_named_as_assumed(tmp_path, recording):
    """In run.toml's comments, by the quantity that they are of."""
    assert new(written(recording, tmp_path, "tiff"), "--out", tmp_path / "run.toml") == 0
    text, config = (tmp_path / "run.toml").read_text(), load(tmp_path / "run.toml")
    names = {
        "length assumed": "shear's length",
        "bias assumed": "bias",
        "step assumed": "focus step",
        "assumed: the first plane": "order of the planes",
        "objective =": "objective's NA",
        "condenser =": "condenser's NA",
        "wavelength =": "wavelength",
        "background =": "medium's index",
        "pixel_size =": "pixel size",
        "offset =": "camera's offset",
        "bounds =": "sign of Δn",
    }
    found = {name for line in values(text) if "assumed" in line for words, name in names.items() if words in line}
    assert set(config.assumed) == found
    assert "camera's offset" in found


def test_floats_have_no_dark_counts_to_be_assumed(tmp_path, recording):
    write_stack(tmp_path / "f.tif", recording.data.astype(np.float32) / 900, (0.15, 0.15), 0.4)
    assert new(tmp_path / "f.tif", "--out", tmp_path / "run.toml") == 0
    assert "camera's offset" not in load(tmp_path / "run.toml").assumed


def test_a_lower_index_turns_the_shear_and_the_bounds(tmp_path, recording):
    assert new(written(recording, tmp_path), "--out", tmp_path / "run.toml", "--lower") == 0
    config = load(tmp_path / "run.toml")
    assert "sign of Δn" not in config.assumed
    assert (config.reconstruction.bounds.lower, config.reconstruction.bounds.upper) == (None, 0.0)
    prism = config.acquisition.prisms[0]
    assert prism is not None
    assert abs(math.degrees(math.atan2(float(prism.shear[0]), float(prism.shear[1]))) - (40 - 180)) < 5


def test_a_shear_that_is_given_reversed_is_warned_of(tmp_path, recording, capsys):
    assert new(written(recording, tmp_path), "--out", tmp_path / "run.toml", "--shear-angle", 220) == 0
    assert "220° is given: reversed, unless Δn has the other sign" in capsys.readouterr().out
    prism = load(tmp_path / "run.toml").acquisition.prisms[0]
    assert prism is not None
    assert math.degrees(math.atan2(float(prism.shear[0]), float(prism.shear[1]))) == pytest.approx(220 - 360)


@pytest.mark.parametrize("files", [1, 2])
def test_pixels_that_are_no_squares_stay_so(tmp_path, recording, files, capsys):
    names = [tmp_path / f"setting{number}.ome.tif" for number in range(files)]
    for name, data in zip(names, np.split(recording.data, files), strict=True):
        write_stack(name, data, (0.2, 0.15), 0.4)
    assert new(*names, "--out", tmp_path / "run.toml") == 0
    assert "0.2 × 0.15 µm (y × x)" in capsys.readouterr().out
    config = load(tmp_path / "run.toml")
    assert config.data is not None
    assert config.volume.spacing[1:] == read_stack(config.data.files[0]).pixel_size == (0.2, 0.15)


def test_init_is_an_alias(tmp_path, recording):
    stack = written(recording, tmp_path)
    assert main(["init", str(stack), "--out", str(tmp_path / "run.toml")]) == 0


def test_several_files_are_joined_beside_the_configuration(tmp_path, recording):
    folder = written(recording, tmp_path, "folder")
    assert new(*sorted(folder.glob("*.tif")), "--out", tmp_path / "runs" / "run.toml", "--pixel-size", 0.15) == 0
    joined = read_stack(tmp_path / "runs" / "run.stack.ome.tif")
    assert np.array_equal(joined.data, recording.data)
    assert joined.pixel_size == (0.15, 0.15)
    assert 'path = "run.stack.ome.tif"' in (tmp_path / "runs" / "run.toml").read_text()


def test_which_file_is_which_setting_is_said(tmp_path, recording, capsys):
    for name, images in zip(("b_plus.tif", "a_minus.tif"), recording.data, strict=True):
        write_stack(tmp_path / name, images, (0.15, 0.15), 0.4)
    assert new(tmp_path / "b_plus.tif", tmp_path / "a_minus.tif", "--out", tmp_path / "run.toml") == 0
    said, text = capsys.readouterr().out, (tmp_path / "run.toml").read_text()
    assert re.search(r"setting 1 +b_plus\.tif .*\n +setting 2 +a_minus\.tif ", said)
    assert "# setting 1, b_plus.tif: length" in text
    assert "# setting 2, a_minus.tif: length" in text
    joined = read_stack(tmp_path / "run.stack.ome.tif")
    assert np.array_equal(joined.data, recording.data)
    assert joined.names == ("b_plus.tif", "a_minus.tif")


def test_a_command_that_is_told_can_be_typed_as_it_is(tmp_path, recording, capsys):
    stack = written(recording, tmp_path).rename(tmp_path / "my cell.tif")
    assert new(stack) == 0
    assert f"torchdic reconstruct '{tmp_path / 'my cell.toml'}' the volume" in capsys.readouterr().out
    assert main(["plan", str(stack)]) == 2
    assert f"torchdic new '{stack}' --out run.toml" in capsys.readouterr().err


def test_one_plane_has_one_slice(tmp_path):
    stack = written(recorded((1.4,), planes=1), tmp_path)
    assert new(stack, "--out", tmp_path / "run.toml") == 0
    config = load(tmp_path / "run.toml")
    assert config.volume.shape[0] == 1
    assert "order of the planes" not in config.assumed


def test_nothing_is_overwritten(tmp_path, recording, capsys):
    stack = written(recording, tmp_path)
    (tmp_path / "run.toml").write_text("mine")
    assert new(stack, "--out", tmp_path / "run.toml") == 2
    assert "run.toml: is there already, and isn't overwritten" in capsys.readouterr().err
    assert (tmp_path / "run.toml").read_text() == "mine"


@pytest.mark.parametrize("named", ["folder", "files"])
def test_all_that_would_be_overwritten_is_said_at_once(tmp_path, recording, capsys, named):
    folder, out = written(recording, tmp_path, "folder"), tmp_path / "run.toml"
    stacks = [folder] if named == "folder" else sorted(folder.glob("*.tif"))
    joined = tmp_path / "run.stack.ome.tif"
    joined.write_text("mine")
    assert new(*stacks, "--out", out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{joined}: is there already, and isn't overwritten; choose another name or remove it" in line
    out.write_text("mine")
    assert new(*stacks, "--out", out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{out} and {joined}: are there already, and aren't overwritten" in line
    # of one file no stack is joined
    assert new(written(recording, tmp_path), "--out", out) == 2
    assert f"error: {out}: is there already" in capsys.readouterr().err
    assert out.read_text() == joined.read_text() == "mine"


def test_a_configuration_below_a_file_is_refused_before_the_stack_is_read(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert new(tmp_path / "missing.tif", "--out", tmp_path / "file" / "run.toml") == 2
    assert "file is a file, not a folder" in capsys.readouterr().err


REFUSALS = {
    (
        "--z-step",
        "640",
    ): "--z-step: 640 µm is no distance between focus planes (0.001 to 100 µm); lengths are in",
    ("--shear-angle", "10", "20", "30"): "--shear-angle 10 20 30: 3 angles, and the images show one axis of shear in 2",
    ("--shear-angle", "999"): "--shear-angle: 999° is no angle of at most a turn",
    ("--bias", "400"): "--bias: 400° is no angle of at most a turn",
    ("--bias", "65", "-65", "65"): "--bias 65 -65 65: 3 biases for 2 prism settings: give one, or one for each",
    ("--wavelength", "546"): "546 µm is no wavelength of light (0.01 to 20 µm); lengths are in µm: 546 nm are 0.546 µm",
    ("--pixel-size", "110"): "--pixel-size: 110 µm is no size of a pixel",
    ("--shear", "180"): "--shear: 180 µm is no shear",
    ("--na", "0"): "--na 0 must be above 0",
    ("--background", "0.9"): "--background 0.9 must be at least 1",
    ("--background", "13.6"): "--background: 13.6 is no refractive index of a transparent medium (at most 6); is the",
    ("--offset", "-1"): "--offset -1 must be at least 0:",
    ("--offset", "2000"): "--offset 2000 must be below the images' background, which is",
    ("--bias", "nan"): "--bias nan must be finite",
    ("--out", "run.txt"): "must end in .toml",
}


@pytest.mark.parametrize("words", REFUSALS)
def test_what_cannot_be_is_one_line_and_leaves_no_file(tmp_path, recording, words, capsys):
    out = [] if "--out" in words else ["--out", tmp_path / "run.toml"]
    assert new(written(recording, tmp_path), *out, *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert REFUSALS[words] in line
    assert not (tmp_path / "run.toml").exists()


def test_what_is_unusual_is_remarked_and_written(tmp_path, recording, capsys):
    words = ("--na", 0.5, "--condenser-na", 1.3, "--background", 2.4)
    assert new(written(recording, tmp_path), "--out", tmp_path / "run.toml", *words) == 0
    printed = capsys.readouterr().out
    assert "warning: microscope.condenser.na: 1.3 is above microscope.objective.na 0.5, which is unusual" in printed
    assert "warning: volume.background: 2.4 is likely wrong" in printed
    with pytest.warns(UnlikelyWarning, match=r"condenser\.na: 1\.3|background: 2\.4"):
        assert load(tmp_path / "run.toml").volume.background == 2.4


@pytest.mark.parametrize("option", [f"--{name}" for name in OPTIONS])
def test_a_decimal_comma_is_refused_with_the_number_in_its_place(tmp_path, capsys, option):
    with pytest.raises(SystemExit) as exit_:
        new(tmp_path / "s.tif", "--out", tmp_path / "run.toml", option, "0,16")
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"torchdic new: error: argument {option}: 0,16 has a decimal comma: write 0.16"
    with pytest.raises(SystemExit):
        new(tmp_path / "s.tif", "--out", tmp_path / "run.toml", option, "much")
    assert f"argument {option}: 'much' is no number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--na", -1), "--na -1 must be above 0"),
        (("--na", 9), "--na: objective NA 9 must be at most 1.8: no immersion has a higher index"),
        (("--condenser-na", 2), "--condenser-na: condenser NA 2 must be at most 1.8: no immersion has a higher index"),
        (("--na", 2.5, "--background", 2.4), "--na: objective NA 2.5 must be at most 2.4: no immersion has a higher"),
    ],
)
def test_options_are_checked_before_the_stack_is_read(tmp_path, capsys, words, told):
    assert new(tmp_path / "missing.tif", "--out", tmp_path / "run.toml", *words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"torchdic: error: {told}")


def test_a_configuration_that_would_break_a_law_is_not_blamed_as_if_it_were_there(tmp_path, recording, capsys):
    """The shear's usual length follows from NA and wavelength."""
    out = tmp_path / "run.toml"
    assert new(written(recording, tmp_path), "--out", out, "--na", 0.001) == 2
    (line,) = capsys.readouterr().err.splitlines()
    told = f"{out} isn't written, because it would say: acquisition.prisms[0].shear.length: 273 µm is no shear"
    assert line.startswith(f"torchdic: error: {told}")
    assert not out.exists()


@pytest.mark.parametrize("name", ["two\nlines.tif", 'it\'s # [a] = "b"\\ & <c> ü 细.tif', "bell\x07.tif"])
def test_a_file_may_have_any_name(tmp_path, recording, name):
    stack = written(recording, tmp_path).rename(tmp_path / name)
    assert new(stack, "--out", tmp_path / "runs" / "run.toml") == 0
    assert load(tmp_path / "runs" / "run.toml").data.path == str(stack)


def in_latin_1(tmp_path, name):
    """A name that is no UTF-8, as other encodings leave it on Linux."""
    path = tmp_path / os.fsdecode(name.encode("latin-1"))
    try:
        path.touch()
    except OSError:
        pytest.skip("this file system has names in UTF-8 alone")
    path.unlink()
    return path


def test_a_name_that_no_configuration_can_hold_is_refused(tmp_path, recording, capsys):
    stack = written(recording, tmp_path).rename(in_latin_1(tmp_path, "café.tif"))
    assert new(stack, "--out", tmp_path / "run.toml") == 2
    assert "is a name that isn't UTF-8, in which a configuration is written; rename it" in capsys.readouterr().err
    assert not (tmp_path / "run.toml").exists()


def test_files_that_are_joined_may_have_names_in_another_encoding(tmp_path, recording):
    for number, images in enumerate(recording.data):
        write_stack(in_latin_1(tmp_path, f"é{number}.tif"), images)
    assert new(*sorted(tmp_path.glob("*.tif")), "--out", tmp_path / "run.toml") == 0
    assert len(load(tmp_path / "run.toml").acquisition.prisms) == 2


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--shear-angle", "40", "130", "s.tif"], [40.0, 130.0]),
        (["--shear-angle", "-40", "--shear-angle=130", "1e2", "--lower", "s.tif"], [-40.0, 130.0, 100.0]),
        (["s.tif", "--shear-angle", "40"], [40.0]),
    ],
)
def test_an_option_of_several_numbers_takes_no_stack_for_one(words, told):
    parser = argparse.ArgumentParser()
    arguments(parser)
    options = parser.parse_args(repeated(["--out", "run.toml", *words], SEVERAL))
    assert options.shear_angle == told
    assert options.stack == [Path("s.tif")]


def test_a_stack_that_is_named_like_a_number_stays_a_stack(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "130").mkdir()
    assert repeated(["--shear-angle", "40", "130"], SEVERAL) == ["--shear-angle", "40", "130"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--bias", 1.57), "warning: --bias 1.57 is taken as 1.57°; if π/2 rad is meant, give 90"),
        (("--bias", -0.785), "warning: --bias -0.785 is taken as -0.785°; if −π/4 rad is meant, give -45"),
        (("--shear-angle", 0.524), "warning: --shear-angle 0.524 is taken as 0.524°; if π/6 rad is meant, give 30"),
    ],
)
def test_an_angle_that_looks_like_radians_is_warned_of_once(tmp_path, recording, capsys, words, line):
    assert new(written(recording, tmp_path), "--out", tmp_path / "run.toml", *words) == 0
    assert capsys.readouterr().out.count(line) == 1
    with pytest.warns(UnlikelyWarning, match="rad is meant") as caught:
        load(tmp_path / "run.toml")
    assert len(caught) == 1


def test_angles_that_are_degrees_are_not_warned_of():
    assert all(like_radians(angle) is None for angle in (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 30.2, 45.0, 85.0, 90.0, 1.6))


def test_a_folder_of_nothing_is_one_line(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert new(tmp_path / "empty", "--out", tmp_path / "run.toml") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "empty: is empty; a folder of planes has files that end in .tif," in line


def test_floats_are_flattened_and_scaled_as_the_same_counts_are(tmp_path, recording):
    measured = []
    for name, data in (("counts", recording.data), ("floats", recording.data.astype(np.float32))):
        write_stack(tmp_path / f"{name}.tif", data, (0.15, 0.15), 0.4)
        assert new(tmp_path / f"{name}.tif", "--offset", 60, "--out", tmp_path / f"{name}.toml") == 0
        config = load(tmp_path / f"{name}.toml")
        assert config.data is not None
        assert "lamp" in config.reconstruction.learn
        measured.append(load_data(config).data)
    counts, floats = measured
    assert np.abs(floats - counts).max() < 1e-6  # float32's rounding


@pytest.mark.parametrize(
    ("planes", "step", "depth", "pixel", "expected"),
    [
        (1, 0.5, 0.9, 0.1, (1, 0.9)),
        (11, 0.3, 0.9, 0.1, (20, 0.3)),  # the step serves, between a quarter and half the depth of field
        (11, 0.1, 0.9, 0.1, (5, 0.45)),  # a finer step doesn't ask for finer slices
        (11, 1.0, 0.9, 0.1, (31, 0.45)),  # nor a coarser one for coarser slices
        (5, 2.0, 8.0, 0.4, (16, 1.0)),  # no thicker than 1 µm
        (11, 0.2, 0.2, 0.15, (19, 0.15)),  # no thinner than a pixel
        (3, 0.5, 2.0, 0.1, (6, 0.5)),  # half a depth of field beyond planes that span little
    ],
)
def test_slices_fill_the_focus_range_and_go_on_beyond_it(planes, step, depth, pixel, expected):
    number, thickness = slices_of(planes, step, depth, pixel)
    assert (number, thickness) == (expected[0], pytest.approx(expected[1]))
    if planes > 1:
        assert number * thickness >= (planes - 1) * step + depth - 1e-9


def test_commented_toml_is_toml():
    value = {"a": 1, "b": [0.25, 3.0, True], "c": 'x "y" \\ µ'}
    elements = (Line("", 1.5, "one"), Line("", 2.0))
    text = commented(["head"], [Line("top", value, "why")], {"t": [Line("list", elements)]})
    assert tomllib.loads(text) == {"top": value, "t": {"list": [1.5, 2.0]}}
    with pytest.raises(TypeError, match="no value of TOML"):
        inline(math.nan)


def test_a_recording_in_few_bits_says_them(tmp_path, recording, capsys):
    assert new(written(replace(recording), tmp_path), "--out", tmp_path / "run.toml") == 0
    assert "12 bits" in capsys.readouterr().out


def setting(degrees, sure=3.0, likeness=(), *, signed=True, level=1000.0):
    """What a setting's images tell; None for degrees shows no direction."""
    direction = None
    if degrees is not None:
        direction = ShearDirection(math.radians(degrees), math.radians(sure), signed, 1)
    return SettingSurvey(level, (0.0, 0.0), 0.0, 0.0, np.ones(3), 10.0, direction, likeness)


LAYOUTS = {
    "one": ([setting(40)], [(40, 90)]),
    "a pair of biases": ([setting(38), setting(222, likeness=(-0.8,))], [(40, 90), (40, -90)]),
    "a pair whose common blur hides the second's dipole": (
        [setting(40, 3), setting(40, 15, likeness=(0.3,))],
        [(40, 90), (40, -90)],
    ),
    "two shears across": ([setting(40), setting(130, likeness=(0.9,))], [(40, 90), (130, 90)]),
    "two pairs": (
        [setting(41), setting(219), setting(309), setting(131)],
        [(40, 90), (40, -90), (310, 90), (310, -90)],
    ),
    "six frames: two shears with three biases": (
        [
            setting(degrees, likeness=likeness)
            for degrees, likeness in (
                *((40, ()), (40, (0.8,)), (220, (0.2, 0.1))),
                *((130, (0.3, 0.3, 0.3)), (130, (0.3, 0.3, 0.3, 0.8)), (310, (0.3, 0.3, 0.3, 0.2, 0.1))),
            )
        ],
        [(40, 90), (40, 90), (40, -90), (130, 90), (130, 90), (130, -90)],
    ),
    "six frames: two shears with bias −, 0, +": (
        [setting(d, level=1000.0 if d else 30.0) for d in (40, None, 220, 130, None, 310)],
        [(40, 90), (40, 0), (40, -90), (130, 90), (130, 0), (130, -90)],
    ),
    "the first is dark": ([setting(None, level=30.0), setting(40)], [(40, 0), (40, 90)]),
    "the second shows none": ([setting(40), setting(None, likeness=(0.2,))], [(40, 90), (40, -90)]),
    "the second is as the first": ([setting(40), setting(None, likeness=(0.9,))], [(40, 90), (40, 90)]),
    "the fourth shows none": (
        [setting(40), setting(220), setting(130), setting(None, likeness=(0.1, 0.2, -0.1))],
        [(40, 90), (40, -90), (130, 90), (130, -90)],
    ),
    "the first shows none": ([setting(None), setting(220, likeness=(0.2,))], [(40, 90), (40, -90)]),
    "none shows any": ([setting(None), setting(None, likeness=(0.9,))], [(45, 90), (45, 90)]),
    "crowded, without a sign": (
        [setting(40, 20, signed=False), setting(44, 20, (-0.7,), signed=False)],
        [(42, 90), (42, -90)],
    ),
    "the surer counts more": ([setting(40, 1.0), setting(230, 3.0)], [(41, 90), (41, -90)]),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_settings_along_one_axis_share_its_angle_and_differ_in_bias(name):
    settings, expected = LAYOUTS[name]
    nothing = np.zeros((4, 4), bool)
    alike = [replace(each, likeness=each.likeness or (0.0,) * number) for number, each in enumerate(settings)]
    stack = Stack(np.ones((len(settings), 3, 4, 4), np.uint16))
    settled = settle(Gathered(stack, (), StatedSetup()), Survey(tuple(alike), 1, None, nothing, nothing, 0), {})
    found = [(angle.value, bias.value) for _, angle, bias in settled.prisms]
    assert found == [(pytest.approx(angle, abs=0.1), bias) for angle, bias in expected]


def settled_of(settings, **given):
    nothing = np.zeros((4, 4), bool)
    alike = [replace(each, likeness=each.likeness or (0.0,) * number) for number, each in enumerate(settings)]
    found = Survey(tuple(alike), 1, None, nothing, nothing, 0)
    gathered = Gathered(Stack(np.ones((len(settings), 3, 4, 4), np.uint16)), (), StatedSetup())
    return gathered, found, settle(gathered, found, given)


TWO_AXES = [setting(41), setting(219), setting(131), setting(309)]
GIVEN_ANGLES = {
    (30.0,): [(30, 90, "given"), (30, -90, "given"), (130, 90, "measured"), (130, -90, "measured")],
    (30.0, 120.0): [(30, 90, "given"), (30, -90, "given"), (120, 90, "given"), (120, -90, "given")],
    # one for each setting: where a pair's second is given reversed, its bias has the first one's sign
    (30.0, 30.0, 120.0, 300.0): [(30, 90, "given"), (30, -90, "given"), (120, 90, "given"), (300, 90, "given")],
}


@pytest.mark.parametrize("angles", GIVEN_ANGLES)
def test_angles_are_given_for_the_first_axis_for_each_or_for_each_setting(angles):
    *_, settled = settled_of(TWO_AXES, shear_angle=angles)
    found = [(angle.value, bias.value, angle.origin) for _, angle, bias in settled.prisms]
    assert found == [(pytest.approx(angle, abs=1.5), bias, origin) for angle, bias, origin in GIVEN_ANGLES[angles]]


def test_an_axis_whose_angle_is_not_given_is_remarked():
    gathered, found, settled = settled_of(TWO_AXES, shear_angle=(45.0,))
    lines = warnings_of(gathered, found, settled)
    assert any("--shear-angle 45 is of the first axis alone; settings 3 and 4 have another" in line for line in lines)
    gathered, found, settled = settled_of(TWO_AXES, shear_angle=(45.0, 310.0))
    said = "\n".join(warnings_of(gathered, found, settled))
    assert "first axis alone" not in said
    assert said.count("310° is given: reversed") == 1
    assert "45° is given" not in said


def test_as_many_angles_as_divide_the_settings_are_taken_in_order_and_remarked():
    """Of two axes the images show one where the first's edges are crowded, or its specimen round."""
    seen = [setting(41), setting(219), setting(38), setting(222)]
    gathered, found, settled = settled_of(seen, shear_angle=(119.0, 209.0))
    expected = [(119, 90), (119, -90), (209, 90), (209, -90)]
    assert [(angle.value, bias.value) for _, angle, bias in settled.prisms] == expected
    said = "\n".join(warnings_of(gathered, found, settled))
    assert "the images show one axis of shear, 2 angles are given: 119° to settings 1 and 2, 209° to settings 3" in said
    *_, settled = settled_of(TWO_AXES, shear_angle=(45.0, 135.0))  # where they show as many, nothing is to be said
    assert not settled.remarks


def test_signs_of_biases_that_the_images_show_are_not_called_given():
    *_, settled = settled_of(TWO_AXES, bias=(65.0,))
    found = [(bias.value, bias.origin) for *_, bias in settled.prisms]
    assert found == [(65, "given"), (-65, "measured"), (65, "given"), (-65, "measured")]
    *_, settled = settled_of(TWO_AXES, bias=(-65.0, 65.0, 0.0, 65.0))
    found = [(angle.value, bias.value, bias.origin) for _, angle, bias in settled.prisms]
    # shear and bias reversed together give the same images
    angles = [pytest.approx(220, abs=1.5)] * 2 + [pytest.approx(310, abs=1.5)] * 2
    assert found == list(zip(angles, (-65, 65, 0, 65), ("given",) * 4, strict=True))


def test_a_bias_that_is_given_is_kept_where_the_field_is_dark():
    seen = [setting(40), setting(None, level=30.0), setting(220)]
    gathered, found, settled = settled_of(seen, bias=(65.0,))
    assert [bias.value for *_, bias in settled.prisms] == [65, 65, -65]
    said = "\n".join(warnings_of(gathered, found, settled))
    assert "setting 2's empty field is dark beside another's, as with bias 0; --bias 65 is kept" in said
    assert "--bias 65 0 -65" in said


@pytest.mark.parametrize("settings", [1, 2])
@pytest.mark.parametrize("left", [0.0, 0.05, -0.3])
def test_a_subtracted_background_is_one_line_and_may_be_put_back(tmp_path, recording, capsys, settings, left):
    data = recording.data[:settings].astype(np.float32)
    level = float(np.median(data))
    write_stack(tmp_path / "sub.tif", data - (1 - left) * level, (0.15, 0.15), 0.4)
    words = (tmp_path / "sub.tif", "--out", tmp_path / "run.toml", "--bias", 80)
    assert new(*words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "background is" in line
    assert "the background has been subtracted; the model needs the raw counts, or what was subtracted put back" in line
    assert not (tmp_path / "run.toml").exists()
    assert new(*words, "--offset", -(1 - left) * level) == 0
    config = load(tmp_path / "run.toml")
    assert config.data is not None
    assert config.data.offset == pytest.approx(-(1 - left) * level)
    angle = math.degrees(math.atan2(*map(float, config.acquisition.prisms[0].shear)))
    assert abs((angle - 40 + 180) % 360 - 180) < 5


def test_a_black_image_with_some_white_is_one_line(tmp_path, capsys):
    image = np.zeros((26, 24), np.uint8)
    image[10:16, 9:13] = 255
    write_stack(tmp_path / "black.tif", image)
    assert new(tmp_path / "black.tif", "--out", tmp_path / "run.toml") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "setting 1's background is 0 " in line


def brightened(recording, share):
    """The recording with a share of its pixels at the camera's full scale, row by row."""
    data = recording.data.copy()
    data[:, :, : round(share * data.shape[2])] = 4095
    return data


def test_saturated_pixels_are_counted_and_most_of_them_refused(tmp_path, recording, capsys):
    """Regions that are always saturated are no hot pixels of the camera."""
    write_stack(tmp_path / "s.tif", brightened(recording, 0.25), (0.15, 0.15), 0.4, bits=12)
    assert new(tmp_path / "s.tif", "--out", tmp_path / "run.toml") == 0
    said = capsys.readouterr().out
    assert f"{10 * 44 * 10}  " in said.partition("hot, dead, saturated pixels")[2]
    assert "warning: 25.0% of the pixels are saturated" in said
    write_stack(tmp_path / "most.tif", brightened(recording, 0.6), (0.15, 0.15), 0.4, bits=12)
    assert new(tmp_path / "most.tif", "--out", tmp_path / "most.toml") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "60.0% of setting 1's pixels are saturated, at 4095: their intensity is unknown, and at most 50% may" in line


def test_a_setting_of_one_value_is_refused(tmp_path, recording, capsys):
    data = recording.data.copy()
    data[1] = 300
    write_stack(tmp_path / "s.tif", data, (0.15, 0.15), 0.4)
    assert new(tmp_path / "s.tif", "--out", tmp_path / "run.toml") == 2
    assert "all pixels of setting 2 are 300: nothing is recorded in them" in capsys.readouterr().err


def test_images_that_show_nothing_are_warned_of_in_one_line(tmp_path, capsys):
    noise = np.random.default_rng(1).normal(500, 23, (2, 5, 48, 48)).astype(np.uint16)
    said = {}
    for name, data in (("noise", noise), ("small", noise[..., :7, :9])):
        write_stack(tmp_path / f"{name}.tif", data, (0.15, 0.15), 0.4)
        assert new(tmp_path / f"{name}.tif", "--out", tmp_path / f"{name}.toml") == 0
        said[name] = capsys.readouterr().out
        assert re.search("sharpest plane +not seen", said[name])
        assert "the sharpest is" not in (tmp_path / f"{name}.toml").read_text()
    assert said["noise"].count("warning:") == said["small"].count("warning:") == 1
    assert (
        "warning: the images show no shear's direction, as of an empty field, of noise or of too faint" in said["noise"]
    )
    assert "warning: images of 7 × 9 pixels are too small to tell background, noise and shear" in said["small"]


def test_a_bias_of_0_on_a_bright_background_is_warned_of(tmp_path, recording, capsys):
    words = (written(recording, tmp_path), "--out", tmp_path / "run.toml", "--bias", 0)
    assert new(*words) == 0
    said = capsys.readouterr().out
    assert "warning: --bias 0 makes an empty field dark, but setting 1's background is" in said
    assert "warning: --bias 0 makes an empty field dark, but setting 2's background is" in said


def test_the_angle_is_as_uncertain_as_its_settings_are_apart():
    nothing = np.zeros((4, 4), bool)
    found = Survey((setting(30, 2), setting(230, 2, (0.0,))), 1, None, nothing, nothing, 0)
    settled = settle(Gathered(Stack(np.ones((2, 3, 4, 4), np.uint16)), (), StatedSetup()), found, {})
    assert settled.prisms[0][1].why.startswith("± 5°")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_drawn_recordings_give_back_their_shears_signs_and_axes(tmp_path, seed):
    """Each specimen, file and microscope: signs right, and axes to three of their uncertainties."""
    found = drawn(seed, finer=Finer((2, 2, 2), 16, 24))
    told, recording = found.told, found.recording
    named = {"na": told.na, "condenser-na": told.condenser_na, "background": told.background}
    words = [word for name, value in named.items() for word in (f"--{name}", value)]
    stack = write_recording(recording, tmp_path / f"s.{found.file_kind}.tif", found.file_kind)
    out = tmp_path / "run.toml"
    assert new(stack, "--out", out, *words, *(["--lower"] if told.lower else [])) == 0
    sure = [float(words.split("°")[0]) for words in out.read_text().split("measured: ± ")[1:]]
    for prism, true, uncertainty in zip(load(out).acquisition.prisms, recording.acquisition.prisms, sure, strict=False):
        assert prism is not None
        assert true is not None
        (y, x), (ty, tx) = (tuple(map(float, each.shear)) for each in (prism, true))
        sign = math.copysign(1.0, float(prism.bias)) * math.copysign(1.0, float(true.bias))
        wrong = math.degrees(math.atan2(sign * (ty * x - tx * y), sign * (ty * y + tx * x)))
        assert abs(wrong) < 3 * uncertainty + 0.5  # which is printed as a whole number


@pytest.mark.filterwarnings("default::torchdic.errors.StackWarning", "ignore::recon.report.verdict.PoorFitWarning")
def test_a_dropped_frame_and_a_file_taken_twice_are_warned_of_before_they_cost_time(tmp_path, recording, capsys):
    data = recording.data.copy()
    data[0, 1] = 0
    data[1, 2] = data[1, 1]
    write_stack(tmp_path / "odd.ome.tif", data, (0.15, 0.15), 0.5)
    assert main(["new", str(tmp_path / "odd.ome.tif"), "--out", str(tmp_path / "run.toml")]) == 0
    said = capsys.readouterr().out
    assert "warning: setting 1, plane 2: all its pixels are 0, nothing is recorded in it" in said
    assert "warning: setting 2, plane 2 and setting 2, plane 3 are the same image, pixel by pixel" in said
    text = (tmp_path / "run.toml").read_text(encoding="utf-8") + "steps = 1\n"
    (tmp_path / "run.toml").write_text(text, encoding="utf-8")
    assert main(["reconstruct", str(tmp_path / "run.toml"), "--out", str(tmp_path / "volume")]) == 0
    said = capsys.readouterr().err
    assert "prism 1, plane 2: all its pixels are 0, nothing is recorded in it" in said
    assert "prism 2, plane 2 and prism 2, plane 3 are the same image" in said
