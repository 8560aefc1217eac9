"""Configuration files from other editors, and values in other units."""

import tomllib

import pytest
import tomli_w
from refusal import the_error

from recon.config import load
from recon.config.plausible.impossible import impossible

TEXT = """
[volume]                       # µm
shape = [20, 64, 64]
spacing = [0.4, 0.2, 0.2]
background = 1.56
[microscope]
wavelength = 0.546
objective = { na = 0.9 }
[acquisition]
focus = [-4.0, 0.0, 2.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }, { shear = [0.24, 0.0], bias = -1.5708 }]
"""


def changed(key, value):
    values = tomllib.loads(TEXT)
    *folders, last = (int(part) if part.isdigit() else part for part in key.split("/"))
    place = values
    for part in folders:
        place = place[part] if isinstance(place, list) else place.setdefault(part, {})
    place[last] = value
    return values


@pytest.fixture
def put(tmp_path):
    """A function from bytes to the path of a file that holds them."""

    def write(content):
        path = tmp_path / "config.toml"
        path.write_bytes(content)
        return path

    return write


# --- encodings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_an_editors_byte_order_mark_is_heeded(put, encoding, end):
    config = load(put(TEXT.replace("\n", end).encode(encoding)))
    assert config.volume.spacing == (0.4, 0.2, 0.2)


def test_big_endian_utf_16_is_read_by_its_mark(put):
    assert load(put(b"\xfe\xff" + TEXT.encode("utf-16-be"))).volume.background == 1.56


@pytest.mark.parametrize("encoding", ["cp1252", "latin-1"])
def test_a_file_in_another_encoding_is_told_with_its_line_and_how_to_save_it(put, encoding):
    message = the_error(put(TEXT.encode(encoding)))
    assert message == (
        "is not TOML: 'utf-8' codec can't decode byte 0xb5 in line 2 (it is 'µ' in Windows-1252); "
        "save the file as UTF-8"
    )


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be", "utf-32-le"])
def test_utf_16_without_its_mark_is_told(put, encoding):
    message = the_error(put(TEXT.replace("µ", "u").encode(encoding)))
    assert "UTF-16 or UTF-32 without a byte-order mark; save the file as UTF-8" in message


def test_half_a_character_of_utf_16_is_told(put):
    message = the_error(put(TEXT.encode("utf-16")[:-1]))
    assert "its byte-order mark says UTF-16" in message
    assert "save the file as UTF-8" in message


@pytest.mark.parametrize(
    ("point", "comma"),
    [
        ("wavelength = 0.546", "wavelength = 0,546"),
        ("{ na = 0.9 }", "{ na = 0,9 }"),
        ("{ length = 0.24, angle_degrees = 0 }", "{ length = 0,24, angle_degrees = 0 }"),
    ],
)
def test_a_decimal_comma_is_told_with_its_line(put, point, comma):
    text = TEXT.replace("[0.0, 0.24]", "{ length = 0.24, angle_degrees = 0 }")
    assert point in text
    message = the_error(put(text.replace(point, comma).encode()))
    wrong = next(word.rstrip(",") for word in comma.split() if word[0] == "0" and "," in word)
    line = text[: text.index(point)].count("\n") + 1
    assert message == f"is not TOML: {wrong} in line {line} has a decimal comma: write {wrong.replace(',', '.')}"


def test_another_fault_is_not_put_down_to_a_comma(put):
    text = TEXT.replace("[volume]", "[volume")
    assert "decimal comma" not in the_error(put(text.encode()))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("path = “stack.tif”", 'line 2 has the quotation mark “: write "'),
        ("path = ‘stack.tif’", 'line 2 has the quotation mark ‘: write "'),
        (r'path = "data\stack.tif"', "line 2 has a single \\ in double quotes: write / between folders, or '…'"),
        (r'path = "C:\Users\me.tif"', "line 2 has a single \\ in double quotes"),
        ('path = "a.tif"\npath = "b.tif"', 'line 3 says again what was said before: path = "b.tif"'),
        ("path = ", "is not TOML: Invalid value (at line 2"),
    ],
)
def test_the_usual_mistakes_of_toml_are_told_with_their_line(put, line, message):
    assert message in the_error(put(f"[data]  # “measured”\n{line}\n".encode()))


# --- units ------------------------------------------------------------------------------------------------------------

SPECIMEN = {"kind": "bead", "radius": 2.5, "contrast": 0.03}


@pytest.mark.parametrize(
    ("key", "value", "named", "meant"),
    [
        ("microscope/wavelength", 546, "microscope.wavelength: 546 µm", "546 nm are 0.546 µm"),
        ("microscope/wavelength", 5.46e-7, "microscope.wavelength: 5.46e-07 µm", "5.46e-07 m are 0.546 µm"),
        ("microscope/wavelength", 5.46e-4, "microscope.wavelength: 0.000546 µm", "0.000546 mm are 0.546 µm"),
        (
            "microscope/spectrum",
            {"wavelengths": [0.5, 546.0]},
            "microscope.spectrum.wavelengths[1]: 546 µm",
            "546 nm are 0.546 µm",
        ),
        ("volume/spacing", [0.4, 160, 160], "volume.spacing[1]: 160 µm", "160 nm are 0.16 µm"),
        ("volume/spacing", [0.4, 43.0, 43.0], "volume.spacing[1]: 43 µm", "43 nm are 0.043 µm"),
        ("volume/spacing", [300, 0.2, 0.2], "volume.spacing[0]: 300 µm", "300 nm are 0.3 µm"),
        ("volume/spacing", [4e-7, 1.6e-7, 1.6e-7], "volume.spacing[1]: 1.6e-07 µm", "1.6e-07 m are 0.16 µm"),
        ("volume/spacing", [0.4, 1.6e-4, 1.6e-4], "volume.spacing[1]: 0.00016 µm", "0.00016 mm are 0.16 µm"),
        ("acquisition/focus", [-2000, 0, 2000], "acquisition.focus[0]: -2000 µm", "-2000 nm are -2 µm"),
        ("acquisition/focus", [-200, 0, 200], "acquisition.focus[0]: -200 µm", "-200 nm are -0.2 µm"),
        ("acquisition/focus", [-2e-6, 0, 2e-6], "acquisition.focus[0]: -2e-06 µm", "-2e-06 m are -2 µm"),
        ("acquisition/prisms/0/shear", [0, 240], "acquisition.prisms[0].shear[1]: 240 µm", "240 nm are 0.24 µm"),
        ("acquisition/prisms/0/shear", [0, 2.4e-7], "prisms[0].shear[1]: 2.4e-07 µm", "2.4e-07 m are 0.24 µm"),
        ("acquisition/prisms/1/bias", 90, "acquisition.prisms[1].bias: 90 rad", "90° are 1.5708 rad"),
        ("acquisition/prisms/1/bias", -90, "acquisition.prisms[1].bias: -90 rad", "-90° are -1.5708 rad"),
        ("acquisition/prisms/1", {"shear": [0, 0.2], "polariser": 45}, "prisms[1].polariser: 45 rad", "0.7854 rad"),
        ("acquisition/prisms/1/axis", 45.0, "acquisition.prisms[1].axis: 45 rad", "45° are 0.7854 rad"),
        (
            "acquisition/prisms/1",
            {"wedge": 0.002, "focal_length": 1.8, "wavelength": 0.546, "material": "quartz"},
            "prisms[1].focal_length: 1.8 µm",
            "1.8 mm are 1800 µm",
        ),
        (
            "acquisition/prisms/1",
            {"wedge": 5, "focal_length": 1800, "wavelength": 0.546, "material": "quartz"},
            "prisms[1].wedge: 5 rad",
            "5° are 0.087266 rad",
        ),
        ("microscope/polarisation", {"analyser_error": 10}, "polarisation.analyser_error: 10 rad", "0.17453 rad"),
        ("microscope/camera", {"pixel_size": 160}, "microscope.camera.pixel_size: 160 µm", "160 nm are 0.16 µm"),
        (
            "microscope/objective",
            {"na": 0.9, "layer": {"thickness": 1.7e-4, "index": 1.5, "design_index": 1.52}},
            "objective.layer.thickness: 0.00017 µm",
            "0.00017 m are 170 µm",
        ),
        ("specimen", {**SPECIMEN, "radius": 2500}, "specimen.radius: 2500 µm", "2500 nm are 2.5 µm"),
        ("specimen", {**SPECIMEN, "radius": 2.5e-6}, "specimen.radius: 2.5e-06 µm", "2.5e-06 m are 2.5 µm"),
        ("specimen", {**SPECIMEN, "centre": [0, 0, 900]}, "specimen.centre[2]: 900 µm", "900 nm are 0.9 µm"),
    ],
)
def test_a_value_in_another_unit_is_named_with_its_key_and_with_the_value_in_the_right_one(
    put, key, value, named, meant
):
    message = the_error(put(tomli_w.dumps(changed(key, value)).encode()))
    assert named in message
    assert meant in message


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("microscope/wavelength", 0.19),
        ("microscope/wavelength", 10.6),
        ("volume/spacing", [50.0, 6.5, 6.5]),
        ("acquisition/focus", [0.0]),
        ("acquisition/focus", [-60.0, 1e-5]),
        ("acquisition/prisms/0/shear", [0.24, 1.5e-17]),
        ("acquisition/prisms/0/shear", [0, 0]),
        ("acquisition/prisms/0/bias", 6.2832),
        ("acquisition/prisms/0/bias", 0),
        ("specimen", {"kind": "layered_medium", "contrast": 0.01, "thickness": 200.0, "bottom": -40}),
        ("specimen", {**SPECIMEN, "radius": 80}),
        ("microscope/camera", {"pixel_size": 6.5, "magnification": 60}),
    ],
)
def test_what_may_be_right_is_allowed(key, value):
    assert impossible(changed(key, value)) is None


def test_a_low_aperture_is_focused_far_away():
    values = changed("acquisition/focus", [-500, 500])
    assert impossible(values) is not None
    values["microscope"]["objective"]["na"] = 0.1
    assert impossible(values) is None
    del values["microscope"]["objective"]  # nothing tells how deep the field is
    assert impossible(values) is None


@pytest.mark.parametrize("value", [0, -0.546, float("nan"), float("inf"), "546", True, None, [], {}])
def test_what_breaks_another_law_is_left_to_it(value):
    assert impossible(changed("microscope/wavelength", value)) is None
    assert impossible(changed("volume", value)) is None
