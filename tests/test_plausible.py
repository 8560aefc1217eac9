"""Values that can't be are refused with their key; values that are likely wrong are warned of, and used."""

import tomllib
import warnings

import pytest
import tomli_w
from refusal import the_error

from recon.config import load
from recon.config.plausible.impossible import impossible
from recon.config.plausible.unlikely import unlikely
from recon.config.reading import parse
from recon.config.schema import UnlikelyWarning

TEXT = """
[volume]
shape = [20, 64, 64]
spacing = [0.4, 0.16, 0.16]
background = 1.36
[microscope]
wavelength = 0.546
objective = { na = 0.9 }
condenser = { na = 0.7 }
[acquisition]
focus = [-4.0, 0.0, 2.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }]
[data]
path = "stack.ome.tif"
[reconstruction]
bounds = { lower = -0.1, upper = 0.2 }
[calibration]
bead = { radius = 1.0, index = 1.59 }
"""


def changed(**changes):
    values = tomllib.loads(TEXT)
    for key, value in changes.items():
        *folders, last = key.split("__")
        place = values
        for part in folders:
            place = place.setdefault(part, {})
        place[last] = value
    return values


def lines(values):
    return list(unlikely(parse(tomli_w.dumps(values).encode(), "run.toml")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"volume__background": 13.6}, "volume.background: 13.6 is no refractive index of a transparent medium"),
        ({"volume__background": 136}, "is the decimal point in the wrong place? 1.36 would do"),
        ({"calibration__bead": {"radius": 1.0, "index": 15.9}}, "calibration.bead.index: 15.9"),
        (
            {"microscope__objective__layer": {"depth": 10, "medium": 13.3, "design": "oil"}},
            "microscope.objective.layer.medium: 13.3",
        ),
        ({"reconstruction__bounds": {"lower": 0.0, "upper": 48}}, "reconstruction.bounds.upper: 48 is no difference"),
        ({"reconstruction__bounds": {"lower": -48}}, "reconstruction.bounds.lower: -48 is no difference"),
        ({"specimen": {"kind": "bead", "radius": 2.5, "contrast": 30}}, "specimen.contrast: 30; "),
        ({"microscope__objective": {"na": 14}}, "objective NA 14 must be at most 1.8"),
        ({"microscope__condenser": {"na": 5.5}}, "condenser NA 5.5 must be at most 1.8"),
    ],
)
def test_what_cannot_be_is_refused_with_its_key_and_value(tmp_path, changes, message):
    (tmp_path / "run.toml").write_text(tomli_w.dumps(changed(**changes)), encoding="utf-8")
    said = the_error(tmp_path / "run.toml")
    assert message.rstrip("; ") in said
    assert "\n" not in said


@pytest.mark.parametrize(
    "changes",
    [
        {"volume__background": 1.0, "calibration__bead": {"radius": 1.0, "index": 1.46}},
        {"volume__background": 1.78, "microscope__objective": {"na": 1.65}},  # the densest immersion oil
        {"reconstruction__bounds": {"lower": -0.4, "upper": 0.0}, "calibration__bead": {"radius": 1.0, "index": 1.0}},
        {"microscope__wavelength": 1.55, "volume__background": 3.48, "calibration": {}},  # silicon
        {"microscope__wavelength": 2.0, "volume__background": 4.05, "calibration": {}},  # germanium
        {"volume__spacing": [0.4, 0.0325, 0.0325], "microscope__objective": {"na": 1.4}},
        {"microscope__condenser": {"na": 0.9}},
        {"microscope__condenser": {"na": 0.0}},
    ],
)
def test_what_microscopists_use_is_neither_refused_nor_warned_of(changes):
    assert impossible(changed(**changes)) is None
    assert lines(changed(**changes)) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"volume__background": 2.4}, "volume.background: 2.4 is likely wrong"),
        ({"tolerance": 5.0}, "if 5 % is meant, that is 0.05"),
        ({"fidelity": {"memory": 3}}, "fidelity.memory: 3 bytes is likely wrong"),
        ({"microscope__wavelength": 1.3, "volume__background": 4.8, "calibration": {}}, "volume.background: 4.8"),
        ({"microscope__wavelength": 5.46}, "microscope.wavelength: 5.46 µm is likely wrong"),
        ({"microscope__objective": {"na": 0.08}, "microscope__condenser": {"na": 0.05}}, "objective.na: 0.08"),
        ({"microscope__condenser": "none"}, "microscope.condenser: none is likely wrong: all light would come along"),
        ({"microscope__condenser": {"na": 1.3}}, "microscope.condenser.na: 1.3 is above microscope.objective.na 0.9"),
        (
            {"volume__spacing": [0.4, 1.6, 1.6]},
            "volume.pixel_size (or spacing): 1.6 µm is likely wrong: that is 5 times the",
        ),
        ({"volume__spacing": [0.4, 0.016, 0.016]}, "pixel_size (or spacing): 0.016 µm is likely wrong: that is a 19th"),
        (
            {"microscope__camera": {"pixel_size": 6.5}},
            "microscope.camera.pixel_size: 6.5 µm in the specimen is",
        ),
        ({"acquisition__prisms": [{"shear": [0.0, 2.4], "bias": 1.5}] * 2}, "acquisition.prisms[0].shear: 2.4 µm"),
        (
            {"volume__spacing": [27.4, 0.16, 0.16]},
            "volume.slice_thickness (or spacing): 27.4 µm is likely wrong: the planes of focus span 6 µm",
        ),
        (
            {"acquisition__prisms": [{"shear": [0.0, 0.2], "bias": 1.5}, {"shear": [0.0, 0.0], "bias": 1.5}]},
            "acquisition.prisms[1].shear: 0 is likely wrong among others of 0.2 µm",
        ),
        ({"reconstruction__bounds": {"lower": 0.0, "upper": 4.8}}, "reconstruction.bounds.upper: 4.8 is likely wrong"),
        ({"calibration__bead": {"radius": 1.0, "index": 2.59}}, "calibration.bead.index: 2.59 is likely wrong"),
    ],
)
def test_what_is_unlikely_is_warned_of_in_one_line_and_used(tmp_path, changes, message):
    (line, *others) = lines(changed(**changes))
    assert message in line
    assert all("bead" in other or "shear" in other or "pixel" in other for other in others)
    path = tmp_path / "run.toml"
    path.write_text(tomli_w.dumps(changed(**changes)), encoding="utf-8")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        config = load(path)
    said = [str(each.message) for each in caught if each.category is UnlikelyWarning]
    assert said == [f"{path}: {each}" for each in (line, *others)]
    assert config.data is not None


def test_a_simulation_may_be_as_fine_and_as_sheared_as_it_likes():
    values = changed(volume__spacing=[0.01, 0.01, 0.01], acquisition__prisms=[{"shear": [0.0, 2.4], "bias": 1.5}])
    del values["data"]
    assert lines(values) == []
