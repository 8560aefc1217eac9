"""Keys that people think in: each means exactly what the canonical one does, and never stands beside it."""

import math
import tomllib

import pytest
from refusal import the_error

from recon.config import dump, load
from recon.config.media import MEDIA
from recon.config.spelling import direction

CANONICAL = {
    "volume": "spacing = [0.3, 0.1, 0.1]",
    "focus": "focus = [-2.0, -1.9, -1.8, -1.7]",
    "shear": f"shear = [{0.18 * math.sin(math.radians(40))!r}, {0.18 * math.cos(math.radians(40))!r}]",
    "bias": f"bias = {math.radians(70)!r}",
}


def text(**changed):
    given = CANONICAL | changed
    return (
        f"[volume]\nshape = [4, 30, 30]\nbackground = 1.335\n{given['volume']}\n"
        "[microscope]\nwavelength = 0.546\nobjective = { na = 0.9 }\n"
        f"[acquisition]\n{given['focus']}\nprisms = [{{ {given['shear']}, {given['bias']} }}]\n"
    )


@pytest.fixture
def write(tmp_path):
    def put(content, name="config.toml"):
        path = tmp_path / name
        path.write_text(content, encoding="utf-8")
        return path

    return put


@pytest.mark.parametrize(
    "given",
    [
        {"volume": "pixel_size = 0.1\nslice_thickness = 0.3"},
        {"volume": "pixel_size = [0.1, 0.1]\nslice_thickness = 0.3"},
        {"focus": "focus = { first = -2.0, step = 0.1, count = 4 }"},
        {"shear": "shear = { length = 0.18, angle_degrees = 40 }"},
        {"bias": "bias_degrees = 70"},
    ],
    ids=lambda given: next(iter(given)),
)
def test_another_spelling_resolves_to_the_very_same_configuration(write, given):
    assert dump(load(write(text(**given)))) == dump(load(write(text())))


def test_the_resolved_configuration_has_canonical_keys_alone(write):
    other = {
        "volume": "pixel_size = [0.1, 0.2]\nslice_thickness = 0.3",
        "focus": "focus = { first = 1, step = -0.5, count = 3 }",
        "shear": "shear = { length = 0.18, angle_degrees = 90 }",
        "bias": "polariser_degrees = 22.5, axis_degrees = 45",
    }
    resolved = dump(load(write(text(**other))))
    values = tomllib.loads(resolved)
    assert values["volume"]["spacing"] == [0.3, 0.1, 0.2]
    assert values["acquisition"]["focus"] == [1.0, 0.5, 0.0]
    (prism,) = values["acquisition"]["prisms"]
    assert prism == {"shear": [0.18, 0.0], "bias": math.radians(45), "axis": math.radians(45)}
    assert dump(load(write(resolved, "again.toml"))) == resolved
    assert "#" not in resolved


def test_how_closely_angles_are_known_may_be_given_in_degrees(write):
    known = load(write(text() + "[calibration]\nbias_within_degrees = 3\nangle_within = 0.02\n")).calibration
    assert (known.bias_within, known.angle_within) == (pytest.approx(math.radians(3)), 0.02)


@pytest.mark.parametrize(
    ("section", "law"),
    [
        ("bias_within = 10", "bias_within 10 rad, 572.958°, must be within 0 and 90°; bias_within_degrees is in °"),
        ("angle_within_degrees = 100", "angle_within 1.74533 rad, 100°, must be within 0 and 90°"),
        ("length_within = 15", "length_within 15 must be a share from 0 to below 1; 0.1 is 10 %"),
        ("bias_within = 0.1\nbias_within_degrees = 6", "calibration.bias_within and calibration.bias_within_degrees"),
        ("bias_within_degree = 6", "unknown key calibration.bias_within_degree; did you mean 'bias_within_degrees'?"),
    ],
)
def test_how_closely_prisms_are_known_has_limits(write, section, law):
    assert law in the_error(write(f"{text()}[calibration]\n{section}\n"))


@pytest.mark.parametrize(
    ("degrees", "y", "x"), [(0, 0, 1), (90, 1, 0), (180, 0, -1), (-90, -1, 0), (45, 0.5**0.5, 0.5**0.5)]
)
def test_a_shears_angle_is_counted_from_right_to_downward(degrees, y, x):
    assert direction(1.0, degrees) == pytest.approx((y, x), abs=1e-15)
    assert direction(2.0, degrees) == pytest.approx((2 * y, 2 * x), abs=1e-15)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"volume": "spacing = [0.3, 0.1, 0.1]\npixel_size = 0.1"},
            "volume.spacing and volume.pixel_size say the same: leave one out",
        ),
        (
            {"bias": "bias = 1.2, bias_degrees = 70"},
            "acquisition.prisms[0].bias and acquisition.prisms[0].bias_degrees say the same: leave one out",
        ),
        ({"volume": "pixel_size = 0.1"}, "missing key volume.slice_thickness, which goes with pixel_size"),
        ({"volume": "slice_thickness = 0.1"}, "missing key volume.pixel_size, which goes with slice_thickness"),
        (
            {"volume": "pixel_siz = 0.1\nslice_thickness = 0.3"},
            "unknown key volume.pixel_siz; did you mean 'pixel_size'?",
        ),
        ({"bias": "bias_degree = 70"}, "unknown key acquisition.prisms[0].bias_degree; did you mean 'bias_degrees'?"),
        (
            {"shear": "shear = { length = 0.2, angle = 40 }"},
            "unknown key acquisition.prisms[0].shear.angle; did you mean 'angle_degrees'?",
        ),
        ({"shear": "shear = { length = 0.2 }"}, "missing key acquisition.prisms[0].shear.angle_degrees"),
        ({"focus": "focus = { first = -2, step = 0.5 }"}, "missing key acquisition.focus.count"),
        (
            {"focus": "focus = { frist = -2, step = 0.5, count = 3 }"},
            "unknown key acquisition.focus.frist; did you mean 'first'?",
        ),
        ({"focus": "focus = { first = -2, step = 0.5, count = 3.0 }"}, "acquisition.focus.count: 3.0 must be a whole"),
        ({"focus": "focus = { first = -2, step = 0, count = 3 }"}, "acquisition.focus.step: 0 makes 3 planes one"),
        ({"focus": "focus = { first = '-2', step = 0.5, count = 3 }"}, "acquisition.focus.first: '-2' must be a num"),
        ({"bias": "bias_degrees = '70°'"}, "acquisition.prisms[0].bias_degrees: '70°' must be a number"),
        ({"volume": "pixel_size = [0.1]\nslice_thickness = 0.3"}, "volume.pixel_size: [0.1] must be a number, or a"),
    ],
)
def test_what_is_said_twice_half_or_wrongly_is_refused(write, given, message):
    assert the_error(write(text(**given))).startswith(message)


@pytest.mark.parametrize(
    ("given", "named", "meant"),
    [
        ({"volume": "pixel_size = 100\nslice_thickness = 0.3"}, "volume.pixel_size: 100 µm", "100 nm are 0.1 µm"),
        ({"volume": "pixel_size = 1e-7\nslice_thickness = 0.3"}, "volume.pixel_size: 1e-07 µm", "1e-07 m are 0.1 µm"),
        ({"volume": "pixel_size = 0.1\nslice_thickness = 300"}, "volume.slice_thickness: 300 µm", "300 nm are 0.3 µm"),
        (
            {"focus": "focus = { first = -2000, step = 100, count = 3 }"},
            "acquisition.focus.first: -2000 µm",
            "-2000 nm are -2 µm",
        ),
        (
            {"focus": "focus = { first = -2, step = 500, count = 3 }"},
            "acquisition.focus.step: 500 µm",
            "500 nm are 0.5 µm",
        ),
        (
            {"shear": "shear = { length = 180, angle_degrees = 40 }"},
            "acquisition.prisms[0].shear.length: 180 µm",
            "180 nm are 0.18 µm",
        ),
        ({"bias": "bias = 70"}, "acquisition.prisms[0].bias: 70 rad", "or bias_degrees = 70"),
        ({"bias": "bias_degrees = 4000"}, "acquisition.prisms[0].bias_degrees: 4000°", "at most 360°"),
    ],
)
def test_another_unit_is_named_in_the_spelling_that_was_used(write, given, named, meant):
    message = the_error(write(text(**given)))
    assert named in message
    assert meant in message


# --- layers -----------------------------------------------------------------------------------------------------------

OIL_ON_WATER = "{ depth = 10, medium = 'water', design = 'oil' }"


def with_layer(layer):
    return text().replace("{ na = 0.9 }", f"{{ na = 1.2, layer = {layer} }}")


@pytest.mark.parametrize(
    "layer",
    [
        OIL_ON_WATER,
        "{ thickness = 10, medium = 1.3345, design = 1.518 }",
        "{ depth = 10, index = 1.3345, design_index = 1.518 }",
    ],
)
def test_a_layer_by_the_names_of_its_media_is_one_by_their_indices(write, layer):
    found = load(write(with_layer(layer))).microscope.objective.layer
    assert (found.thickness, found.index, found.design_index) == (10.0, 1.3345, 1.518)
    resolved = dump(load(write(with_layer(layer))))
    assert tomllib.loads(resolved)["microscope"]["objective"]["layer"] == {
        "thickness": 10.0,
        "index": 1.3345,
        "design_index": 1.518,
    }


def test_a_background_by_the_name_of_its_medium_is_one_by_its_index(write):
    assert load(write(text().replace("1.335", "'water'"))).volume.background == MEDIA["water"]
    message = the_error(write(text().replace("1.335", "'watre'")))
    assert message.startswith("volume.background: 'watre' must be one of 'air' (1.0003), 'water' (1.3345), ")


def test_an_included_layers_medium_is_replaced_in_either_spelling(write):
    write(with_layer(OIL_ON_WATER), "base.toml")
    path = write('include = "base.toml"\n[microscope.objective.layer]\nindex = 1.4\ndesign = "glass"\n')
    found = load(path).microscope.objective.layer
    assert (found.thickness, found.index, found.design_index) == (10.0, 1.4, 1.5255)


def test_media_are_in_the_order_of_their_indices_and_water_is_water():
    """At 546 nm: of air 277 millionths above vacuum, of water 1.3345, of immersion oil ISO 8036's 1.5180 ± 0.0005."""
    assert list(MEDIA.values()) == sorted(MEDIA.values())
    assert MEDIA["air"] == pytest.approx(1.000277, abs=5e-5)
    assert MEDIA["water"] == pytest.approx(1.3345, abs=1e-4)
    assert MEDIA["oil"] == pytest.approx(1.5180, abs=5e-4)
    # Rheims et al., with λ in µm
    assert MEDIA["glycerol"] == pytest.approx(1.45797 + 0.00598 / 0.5461**2 - 0.00036 / 0.5461**4, abs=1e-4)


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        (
            "{ depth = 10, medium = 'watre', design = 'oil' }",
            "microscope.objective.layer.medium: 'watre' must be one of 'air' (1.0003), 'water' (1.3345), ",
        ),
        (
            "{ depth = 10, medium = true, design = 'oil' }",
            "microscope.objective.layer.medium: True must be the name of a medium, or its index",
        ),
        (
            "{ depth = 10, medium = 'water', index = 1.33, design = 'oil' }",
            "microscope.objective.layer.index and microscope.objective.layer.medium say the same: leave one out",
        ),
        ("{ depth = 10, medum = 'water', design = 'oil' }", "unknown key microscope.objective.layer.medum; did you"),
        ("{ depth = 10, medium = 'water' }", "missing key microscope.objective.layer.design_index"),
        ("{ depth = '10', medium = 'water', design = 'oil' }", "microscope.objective.layer.depth: '10' must be a numb"),
        ("{ depth = 1e-5, medium = 'water', design = 'oil' }", "microscope.objective.layer.depth: 1e-05 µm is no thic"),
        ("{ depth = 10, medium = 'water', design = 'air' }", "microscope.objective: objective NA 1.2 exceeds the"),
    ],
)
def test_a_layer_of_no_known_medium_is_refused(write, layer, message):
    assert the_error(write(with_layer(layer))).startswith(message)
