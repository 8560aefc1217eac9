"""torchdic calibrate, from a file to a folder."""

import json
import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
import torch

from data_synthetic import Bead
from recon.calibration.trials.declared import Otherwise, all_mistakes
from recon.calibration.trials.orders import Orders, Round, Tried
from recon.calibration.trials.profile import Least, least_misfit
from recon.cli import main
from recon.config import load
from recon.config.commented import comments_of
from recon.config.spelling import direction
from recon.run.calibration import by_specimen
from recon.run.calibration.assumed import corrected, foreknowledge
from recon.run.calibration.found import FoundQuantity, left
from recon.run.calibration.provenance import provenance
from recon.run.calibration.stack import CalibrationStack
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import write_stack

pytestmark = [
    pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning"),
    pytest.mark.filterwarnings("ignore::torchdic.errors.StackWarning"),
]
FOCUS = [-1.2, 0.0, 1.2]
TOLD = {
    "volume": {"shape": [8, 40, 36], "spacing": [0.5, 0.2, 0.2], "background": 1.4},
    "microscope": {"wavelength": 0.546, "objective": {"na": 0.8}, "condenser": {"na": 0.5}},
    "data": {"path": "stack.ome.tif", "offset": 100.0},
}
FEW = (("recon.calibration.trials.orders.ROUNDS", (Round(16, 4, 2, 6), Round(2, 5, 3, 6))),)


def prisms(length, degrees, bias):
    angle = math.radians(degrees)
    return [{"shear": [length * math.sin(angle), length * math.cos(angle)], "bias": b} for b in (bias, -bias)]


@pytest.fixture(scope="module")
def recorded():
    """A bead's counts, with a bias of ±1.3, a shear of 0.2 µm at 20°."""
    fine = Grid((10, 80, 72), (0.24, 0.1, 0.1))
    bead = Bead(1.2, 0.05, 1.4, (0.1, 0.3, -0.4))
    acquisition = Acquisition([Prism(tuple(p["shear"]), p["bias"]) for p in prisms(0.2, 20, 1.3)], FOCUS)
    volume = Volume(fine, bead.delta(fine, dtype=torch.float32), 1.4)
    with torch.no_grad():
        images = image(volume, Microscope(0.546, Objective(0.8), Condenser(0.5)), acquisition, Fidelity(sources=24))
    pixels = Camera(pixel_size=0.2).integrate(images, (0.1, 0.1))
    camera = Camera(photons=10000, read_noise=2.0, gain=2.0, offset=100.0, bits=16)
    return camera.record(pixels, torch.Generator().manual_seed(0))


def calibrated(folder, recorded, monkeypatch, told, patches=FEW):
    """Run the command; the exit code, the calibrated configuration and the record."""
    for name, value in patches:
        monkeypatch.setattr(name, value)
    write_stack(folder / "stack.ome.tif", recorded, (0.2, 0.2), 1.2)
    (folder / "run.toml").write_text(tomli_w.dumps({**TOLD, **told}), encoding="utf-8")
    code = main(["calibrate", str(folder / "run.toml"), "--out", str(folder / "out"), "--device", "cpu"])
    assert code == 0
    return load(folder / "out" / "calibrated.toml"), json.loads((folder / "out" / "calibration.json").read_text())


@pytest.mark.slow
def test_a_bead_leaves_a_microscope_to_be_reused(tmp_path, recorded, monkeypatch, capsys):
    told = {
        "acquisition": {"focus": FOCUS, "prisms": prisms(0.22, 26, 1.4)},  # too long, turned, too much
        "calibration": {"bead": {"radius": 1.2, "index": 1.45}},
    }
    patches = (
        ("recon.calibration.known_specimen.ROUNDS", ((6, 3), (8, 1))),
        ("recon.run.calibration.stack.CalibrationStack.orders", lambda *_: None),
    )
    config, record = calibrated(tmp_path, recorded, monkeypatch, told, patches)
    assert not record["signs and orders"]["found"]
    shear = config.acquisition.prisms[0].shear
    assert math.degrees(math.atan2(*shear)) == pytest.approx(20, abs=3)
    for name in ("bias", "shear's length", "shear's angle", "condenser na", "bead's z", "brightness", "drift"):
        assert {"value", "uncertainty", "how", "before"} <= set(record[name]), name
    assert record["shear's length"]["before"] == pytest.approx([0.22])
    assert "focus against z" in " ".join(record["not told by any image"])
    said = capsys.readouterr().out
    assert "shear and bias reversed together" in said
    # another stack's configuration takes the optics from it
    other = {**TOLD, "include": "out/microscope.toml", "acquisition": {"focus": [0.0]}}
    del other["microscope"]
    (tmp_path / "cell.toml").write_text(tomli_w.dumps(dict(sorted(other.items(), key=lambda i: i[0] != "include"))))
    assert load(tmp_path / "cell.toml").acquisition.prisms[0].shear == pytest.approx(shear)
    reused = tomllib.loads((tmp_path / "out" / "microscope.toml").read_text())
    assert set(reused) == {"microscope", "acquisition", "calibration"}
    # and weighs its images against how well the bead tells them
    known = load(tmp_path / "cell.toml").calibration
    unsure = record["shear's length"]["uncertainty"][0] / record["shear's length"]["value"][0]
    assert known.length_within == pytest.approx(math.sqrt(3) * unsure, rel=0.1)
    assert known.bias_within == pytest.approx(math.sqrt(3) * max(record["bias"]["uncertainty"]), rel=0.1)
    assert 0 < known.length_within < 0.2


@pytest.mark.slow
def test_an_unknown_specimen_tells_direction_and_the_product_of_length_and_bias(
    tmp_path, recorded, monkeypatch, capsys
):
    assumed = ["bias", "shear's angle", "order of the planes", "sign of Δn"]
    told = {"assumed": assumed, "acquisition": {"focus": FOCUS[::-1], "prisms": prisms(0.2, 14, 1.3)}}
    config, record = calibrated(tmp_path, recorded, monkeypatch, told)
    assert record["signs and orders"]["value"] == "focus"
    assert [float(f) for f in config.acquisition.focus] == FOCUS
    assert config.assumed == ("sign of Δn",)  # the others are found
    assert math.degrees(record["shear's angle"]["value"][0]) == pytest.approx(20, abs=3)
    assert record["bias"]["value"] == pytest.approx([1.3, -1.3], rel=0.1)
    assert "its product with the shear's length" in record["bias"]["how"]
    assert record["shear's length"]["found"]
    assert record["shear's length"]["value"] == pytest.approx([0.2], rel=0.12)
    assert "gauge" in record["focus zero"]["how"]
    assert not (tmp_path / "out" / "microscope.toml").exists()
    said = capsys.readouterr().out
    assert "left as told" in said
    assert "misfit / noise" in said


@pytest.mark.parametrize("alone", [False, True])
def test_the_length_shares_what_is_found_with_biases_that_are_not_known(tmp_path, recorded, monkeypatch, alone):
    write_stack(tmp_path / "stack.ome.tif", recorded, (0.2, 0.2), 1.2)
    told = {**TOLD, "acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)}}
    (tmp_path / "run.toml").write_text(tomli_w.dumps(told), encoding="utf-8")
    stack = CalibrationStack.read(load(tmp_path / "run.toml"), torch.device("cpu"))
    monkeypatch.setattr(by_specimen, "find_length", lambda _: Least(-0.3, 0.01, ((-0.3, 0.1), (0.0, 0.2))))
    changed, found = by_specimen._length(stack, alone=alone)
    assert [quantity.name for quantity in found] == ["shear's length", "bias"][: 1 if alone else 2]
    for prism, bias in zip(changed.config.acquisition.prisms, (1.3, -1.3), strict=True):
        length = math.hypot(*map(float, prism.shear))
        product = length / 0.2 * math.tan(1.3 / 2) / math.tan(abs(prism.bias) / 2)
        # the images' deviation is 5 % by the slabs and 1 % by the trials, beside what was known beforehand
        before = 0.15**2 / 3 + (0 if alone else (math.radians(10) / math.sin(1.3)) ** 2 / 3)
        believed = before / (before + 0.05**2 + 0.01**2)
        assert math.log(product) == pytest.approx(-0.3 * believed, abs=2e-3)
        assert (prism.bias == bias) is alone
        assert prism.bias * bias > 0


@pytest.mark.parametrize(
    ("section", "law"),
    [
        ({"bead": {"radius": 0.0, "index": 1.5}}, "radius 0.0 must be above 0"),
        ({"bead": {"radius": 1.0, "index": 1.4}}, "index 1.4 is the medium's"),
        ({"bead": {"radius": 1.0, "index": 0.9}}, "index 0.9 must be a refractive index"),
        ({"aberrations": [11]}, "give bead too"),
        ({"bead": {"radius": 1.0, "index": 1.5}, "aberrations": [4]}, "defocus is where the bead lies"),
        ({"bead": {"radius": 1.0, "index": 1.5}, "aberrations": [5, 5]}, "names one twice"),
        ({"bead": {"radius": 1.0}}, "missing key calibration.bead.index"),
        ({"bead": {"radius": 30.0, "index": 1.5}}, "too large for a field"),
    ],
)
def test_what_cannot_be_a_bead_is_refused_in_one_line(tmp_path, recorded, monkeypatch, capsys, section, law):
    monkeypatch.setattr("recon.run.calibration.stack.CalibrationStack.orders", lambda *_: None)
    write_stack(tmp_path / "stack.ome.tif", recorded, (0.2, 0.2), 1.2)
    told = {**TOLD, "acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)}, "calibration": section}
    (tmp_path / "run.toml").write_text(tomli_w.dumps(told), encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert law in said


@pytest.mark.parametrize(
    ("microscope", "section", "law"),
    [
        ({}, {"bead": {"radius": 30.0, "index": 1.5}}, "radius: 30 µm is too large for a field of 7.2 µm"),
        ({"camera": {"pixel_size": 0.1}}, {"bead": {"radius": 3.1, "index": 1.5}}, "3.1 µm is too large for a field"),
        (
            {"objective": "none"},
            {"bead": {"radius": 1.0, "index": 1.5}, "aberrations": [11]},
            "aberrations: [11] are of an objective, and microscope.objective isn't given",
        ),
    ],
)
def test_what_no_bead_of_this_field_can_tell_is_refused_before_the_stack_is_read(
    tmp_path, capsys, microscope, section, law
):
    told = {
        **TOLD,
        "microscope": TOLD["microscope"] | microscope,
        "acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)},
        "calibration": section,
    }
    (tmp_path / "run.toml").write_text(tomli_w.dumps(told), encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out")]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert law in said
    assert not (tmp_path / "out").exists()


def test_a_finished_calibration_is_not_overwritten_unasked(tmp_path, recorded, monkeypatch, capsys):
    monkeypatch.setattr("recon.run.calibration.stack.CalibrationStack.orders", lambda *_: None)
    monkeypatch.setattr("recon.run.calibration.calibrate.by_specimen", lambda stack, _: (stack, []))
    told = {"acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)}}
    calibrated(tmp_path, recorded, monkeypatch, told)
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    typed = ["calibrate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out"), "--device", "cpu"]
    assert main(typed) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "calibration.json: the folder has results; name another one, or replace them with --restart" in said
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before
    assert main([*typed, "--restart"]) == 0


RUN = """# Written by torchdic new.

assumed = ["shear's length", "bias", "condenser's NA", "medium's index", "sign of Δn", "order of the planes"]

[acquisition]
prisms = [                               # angle: from right towards down
    { shear = { length = 0.3, angle_degrees = 300.0 }, bias_degrees = 90.0 }, # SAID
    { shear = { length = 0.3, angle_degrees = 300.0 }, bias_degrees = -90.0 }, # mine
]
focus = { first = -1.2, step = 1.2, count = 3 } # step file; assumed: the first is first; measured: the sharpest is 2

[microscope]
objective = { na = 0.8 }                 # file
condenser = { na = 0.5 }                 # assumed: the ring
wavelength = 0.546                       # file

[volume]
background = 1.4                         # assumed: water
shape = [8, 40, 36]                      # slices
pixel_size = 0.2                         # file
slice_thickness = 0.5                    # chosen

[data]
path = "stack.ome.tif"                   # given
offset = 100.0                           # given

[reconstruction]
bounds = { lower = 0.0 }                 # assumed: Δn is above 0
""".replace("SAID", "a: length assumed: usual; told; angle measured: ± 2°; bias assumed: a guess; so")


def test_a_calibrated_configuration_is_the_old_one_with_what_was_found(tmp_path, recorded, monkeypatch, capsys):
    """The same keys and units, the file from its folder, and behind each value where it comes from."""

    def turned(stack, _):
        """As beside a specimen: 10° further, with another condenser."""
        config = stack.config
        prisms = [Prism(direction(0.3, 310.0), bias) for bias in (math.pi / 2, -math.pi / 2)]
        changed = replace(config, acquisition=replace(config.acquisition, prisms=prisms))
        microscope = replace(config.microscope, condenser=replace(config.microscope.condenser, na=0.45))
        angle = FoundQuantity("shear's angle", "rad", [math.radians(-60)], [math.radians(-50)], [0.01], "so")
        na = FoundQuantity("condenser na", "", 0.5, 0.45, 0.02, "so")
        return stack.with_config(replace(changed, microscope=microscope)), [angle, na, left("bias", "rad", [1.5], "no")]

    monkeypatch.setattr("recon.run.calibration.calibrate.by_specimen", turned)
    monkeypatch.setattr("recon.calibration.trials.orders.ROUNDS", (Round(2, 2, 1, 3),))
    write_stack(tmp_path / "stack.ome.tif", recorded, (0.2, 0.2), 1.2)
    run = f"{RUN}\n[calibration]\nlength_within = 0.3 # read in the dark\nbias_within_degrees = 5.0\n"
    (tmp_path / "run.toml").write_text(run, encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out"), "--device", "cpu"]) == 0
    said = capsys.readouterr()
    assert "shear's angle: 310 ± 0.57°, told 300°" in said.out
    assert "signs and orders, round 1 of 1: 100%" in said.err
    text = (tmp_path / "out" / "calibrated.toml").read_text(encoding="utf-8")
    told, values, comments = tomllib.loads(run), tomllib.loads(text), comments_of(text)
    chosen = json.loads((tmp_path / "out" / "calibration.json").read_text())["signs and orders"]["value"]
    expected = {**told, "assumed": ["shear's length", "bias", "medium's index", "sign of Δn"]}
    expected["microscope"]["condenser"]["na"] = 0.45
    expected["data"]["path"] = "../stack.ome.tif"
    for prism in expected["acquisition"]["prisms"]:
        prism["shear"]["angle_degrees"] = 310.0
    if "focus" in chosen:
        expected["acquisition"]["focus"] |= {"first": 1.2, "step": -1.2}
    assert values | {"assumed": sorted(values["assumed"])} == expected | {"assumed": sorted(values["assumed"])}
    assert set(values["assumed"]) >= {"shear's length", "bias"}
    angle = "angle calibrated: ± 0.57°, told "
    assert comments["acquisition.prisms[0]"].startswith(f"a: length assumed: usual; told; {angle}")
    assert comments["acquisition.prisms[0]"].endswith("; bias assumed: a guess; so")
    assert comments["acquisition.prisms[1]"].startswith(f"mine; {angle}")
    assert comments["microscope.condenser"] == "calibrated: ± 0.02, told 0.5"
    unchanged = ("microscope.objective", "volume.background", "data.path", "reconstruction.bounds")
    for key in (*unchanged, "calibration.length_within"):
        assert comments[key] == comments_of(run)[key]
    assert load(tmp_path / "out" / "calibrated.toml").data == load(tmp_path / "run.toml").data


def test_what_the_user_has_corrected_is_no_longer_said_to_be_assumed():
    comments = comments_of(RUN)
    assert corrected(comments, tomllib.loads(RUN)["assumed"]) == comments
    told = corrected(comments, ["bias", "order of the planes"])
    assert told["acquisition.prisms[0]"] == "a: length told; angle measured: ± 2°; bias assumed: a guess; so"
    assert told["acquisition.prisms[1]"] == "mine"
    for key in ("microscope.condenser", "volume.background", "reconstruction.bounds"):
        assert told[key] == "told"
    for key in ("acquisition.focus", "microscope.objective", "volume.shape"):
        assert told[key] == comments[key]
    step = "step assumed: half; assumed: the first plane is first; measured: the sharpest is 2"
    assert corrected({"acquisition.focus": step}, ["order of the planes"]) == {
        "acquisition.focus": "step told; assumed: the first plane is first; measured: the sharpest is 2"
    }


def test_what_is_assumed_is_hardly_known_beforehand(tmp_path):
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    config = load(tmp_path / "run.toml")
    length, bias, angle = foreknowledge(config).limits  # of these the angle was measured
    assert (length, math.degrees(bias), math.degrees(angle)) == pytest.approx((0.5, 40, 10))
    told = replace(config, assumed=(), calibration=replace(config.calibration, bias_within=math.radians(3)))
    length, bias, angle = foreknowledge(told).limits
    assert (length, math.degrees(bias), math.degrees(angle)) == pytest.approx((0.15, 3, 10))


def orders(what, acquisition, mistakes):
    return Orders((), 0.0, Otherwise(what, what, "", acquisition, mistakes), told=True)


def test_provenance_says_what_was_calibrated_and_how_well(tmp_path):
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    config, comments = load(tmp_path / "run.toml"), comments_of(RUN)
    found = [
        FoundQuantity("signs and orders", "", "as declared", "focus", None, "so"),
        FoundQuantity("shear's length", "µm", [0.3], [0.25], [0.011], "so"),
        FoundQuantity("bias", "rad", [1.5, -1.5], [1.4, -1.4], [0.1, 0.2], "so"),
        FoundQuantity("condenser na", "", 0.5, 0.49, 0.02, "agrees"),
        left("shear's angle", "rad", [0.1], "no"),
    ]
    reversed_ = replace(config.acquisition, focus=config.acquisition.focus[::-1])
    prisms = [replace(p, shear=tuple(s * 0.25 / 0.3 for s in p.shear)) for p in config.acquisition.prisms]
    changed = replace(config, acquisition=replace(reversed_, prisms=prisms))
    made = provenance(config, changed, orders("planes reversed", reversed_, 1), found, comments)
    first, second = made["acquisition.prisms[0]"], made["acquisition.prisms[1]"]
    assert first == (
        "a: length calibrated: ± 0.011 µm, told 0.3 µm; angle measured: ± 2°; bias calibrated: ± 5.7°, told 90°"
    )
    assert second == "mine; length calibrated: ± 0.011 µm, told 0.3 µm; bias calibrated: ± 11°, told -90°"
    assert made["microscope.condenser"] == "assumed: the ring; calibrated: 0.49 ± 0.02 agrees with it"
    assert made["acquisition.prisms"] == "angle: from right towards down; calibrated: planes reversed"
    assert made["acquisition.focus"] == "step file; calibrated: the planes' order, which was told reversed"
    as_told = provenance(config, config, orders("all is as declared", config.acquisition, 0), found[:1], comments)
    assert as_told == {
        "acquisition.focus": "step file; measured: the sharpest is 2; calibrated: the planes' order, as told"
    }
    zero = [FoundQuantity("compensator's zero", "rad", 0.0, 0.1, 0.01, "so")]
    added = provenance(config, config, None, zero, {})["acquisition.prisms[1]"]
    assert added == "bias calibrated: the zero, 5.73° ± 0.57°, is added to the told -90°"
    assert provenance(config, config, None, [left("bias", "rad", None, "no")], comments) == {}


def test_what_was_measured_of_a_told_angle_is_not_said_of_another(tmp_path):
    (tmp_path / "run.toml").write_text(RUN, encoding="utf-8")
    config, comments = load(tmp_path / "run.toml"), comments_of(RUN)
    turned = Acquisition([Prism(direction(0.3, 30.0), p.bias) for p in config.acquisition.prisms], FOCUS)
    found = [FoundQuantity("signs and orders", "", "as declared", "turned", None, "so")]
    now = replace(config, acquisition=turned)
    made = provenance(config, now, orders("images turned", turned, 1), found, comments)["acquisition.prisms[0]"]
    assert made.startswith("a: length assumed: usual; told; angle calibrated: images turned, told 300°; bias assumed")
    angle = [*found, FoundQuantity("shear's angle", "rad", [math.radians(30)], [math.radians(31)], [0.05], "so")]
    made = provenance(config, now, orders("images turned", turned, 1), angle, comments)["acquisition.prisms[0]"]
    assert "angle calibrated: images turned, told 300°, then calibrated: ± 2.9°, told 30°; bias" in made
    told = provenance(config, config, None, angle[1:], comments)["acquisition.prisms[0]"]
    assert "angle calibrated: ± 2.9°, told 300°; bias" in told


def trials(to, noise, fall, lowest=1.0):
    """The least misfit of trials with a parabola about a value, which falls by a share of the noise from 0 to there."""

    def misfits_at(values):
        return [np.full(4, noise * (lowest + fall * (value / to - 1) ** 2)) for value in values]

    return least_misfit(misfits_at, 0.0, 0.12, noise, 60000, (-1, 1))


@pytest.mark.parametrize(
    ("lowest", "found", "words"),
    [(1.0, True, "misfit 1.000 × the noise's, 1.004 as told"), (0.983, False, "absorb 1.7% of the noise")],
)
def test_noise_that_volumes_absorb_makes_values_unsure(tmp_path, recorded, monkeypatch, capsys, lowest, found, words):
    """The misfit falls by as much from the told aperture, which stays then, and the angle, which turns by less."""
    beside = "recon.run.calibration.by_specimen"

    def aperture(stack):
        return trials(-0.2, stack.alone, 0.004, lowest)

    monkeypatch.setattr("recon.calibration.beside_volume.Beside.held", lambda self: self)
    monkeypatch.setattr(f"{beside}.find_aperture", aperture)
    monkeypatch.setattr(f"{beside}.find_angles", lambda stack: [trials(0.15, stack.alone, 0.004, lowest)])
    monkeypatch.setattr(f"{beside}._images", lambda stack: (stack, []))
    monkeypatch.setattr(f"{beside}._length", lambda stack, **_: (stack, []))
    patches = (("recon.run.calibration.stack.CalibrationStack.orders", lambda *_: None),)
    told = {"acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 14, 1.3)}}
    config, record = calibrated(tmp_path, recorded, monkeypatch, told, patches)
    assert record["condenser na"]["found"] == found
    assert words in record["condenser na"]["how"]
    na = 0.5 * math.exp(-0.2) if found else 0.5
    assert float(config.microscope.condenser.na) == pytest.approx(na, abs=1e-4)
    turned = math.degrees(math.atan2(*config.acquisition.prisms[0].shear)) - 14
    share = turned / math.degrees(0.15)
    assert 0.98 < share < 1 if found else 0.4 < share < 0.6
    assert math.degrees(record["shear's angle"]["value"][0]) == pytest.approx(14 + turned, abs=1e-2)
    assert "the images put it +8.6° ± " in record["shear's angle"]["how"]


def test_descriptions_that_noise_alone_tells_apart_are_both_named(tmp_path, recorded, monkeypatch, capsys):
    def alike(stack, _):
        declared, other = all_mistakes(stack.config.acquisition)[:2]
        tried = Tried(declared, 0.502, 0.503, 1), Tried(other, 0.5, 0.501, 1)
        return Orders(tried, 0.5, declared, told=False, rival=other)

    patches = (
        ("recon.run.calibration.stack.CalibrationStack.orders", alike),
        ("recon.run.calibration.calibrate.by_specimen", lambda stack, _: (stack, [])),
    )
    told = {"acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 14, 1.3)}, "assumed": ["order of the planes"]}
    config, record = calibrated(tmp_path, recorded, monkeypatch, told, patches)
    assert not record["signs and orders"]["found"]
    assert config.assumed == ("order of the planes",)
    assert "the images can't tell 'as declared' from 'focus': " in capsys.readouterr().out


def test_an_interrupted_calibration_says_so_in_one_line(tmp_path, recorded, monkeypatch, capsys):
    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("recon.run.calibration.stack.CalibrationStack.orders", stopped)
    write_stack(tmp_path / "stack.ome.tif", recorded, (0.2, 0.2), 1.2)
    told = {**TOLD, "acquisition": {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)}}
    (tmp_path / "run.toml").write_text(tomli_w.dumps(told), encoding="utf-8")
    capsys.readouterr()
    assert main(["calibrate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out")]) == 130
    assert "interrupted; a calibration writes nothing" in capsys.readouterr().err.splitlines()[-1]
    assert not list((tmp_path / "out").glob("calib*"))


def test_levels_of_one_exposure_tell_the_compensators_zero(tmp_path, recorded, monkeypatch):
    """The pair was recorded at −1.3 and 1.3; told as −1.2 and 1.4 it has a zero of −0.1."""
    monkeypatch.setattr("recon.run.calibration.stack.CalibrationStack.orders", lambda *_: None)
    monkeypatch.setattr("recon.run.calibration.calibrate.by_specimen", lambda stack, _: (stack, []))
    shear = prisms(0.2, 20, 1.3)[0]["shear"]
    told = {
        "acquisition": {"focus": FOCUS, "prisms": [{"shear": shear, "bias": b} for b in (1.4, -1.2)]},
        "calibration": {"one_exposure": True},
    }
    config, record = calibrated(tmp_path, recorded, monkeypatch, told)
    assert record["compensator's zero"]["value"] == pytest.approx(-0.1, abs=0.03)
    assert float(config.acquisition.prisms[0].bias) == pytest.approx(1.3, abs=0.03)


def test_short_fits_have_the_cameras_pixels_as_voxels(tmp_path, recorded):
    """Voxels of half a pixel describe the same stack: its part is that of a configuration without a camera."""
    volume = {"shape": [8, 80, 72], "spacing": [0.5, 0.1, 0.1], "background": 1.4}
    microscope = TOLD["microscope"] | {"camera": {"pixel_size": 0.2}}
    acquisition = {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)}
    write_stack(tmp_path / "stack.ome.tif", recorded, (0.2, 0.2), 1.2)
    parts = []
    for name, changes in (("plain", {}), ("camera", {"volume": volume, "microscope": microscope})):
        path = tmp_path / f"{name}.toml"
        path.write_text(tomli_w.dumps({**TOLD, "acquisition": acquisition, **changes}), encoding="utf-8")
        stack = CalibrationStack.read(load(path), torch.device("cpu"))
        parts.append(stack.part())
        assert stack.beside().setup.microscope.camera is None
    plain, camera = parts
    assert camera.grid == plain.grid
    assert torch.allclose(camera.data, plain.data, rtol=1e-5)


def test_images_too_small_to_calibrate_by_are_refused(tmp_path, capsys):
    write_stack(tmp_path / "stack.ome.tif", 900 + np.arange(24, dtype=np.uint16).reshape(2, 3, 2, 2), (0.2, 0.2), 1.2)
    told = {**TOLD, "volume": {**TOLD["volume"], "shape": [8, 2, 2]}}
    told["acquisition"] = {"focus": FOCUS, "prisms": prisms(0.2, 20, 1.3)}
    (tmp_path / "run.toml").write_text(tomli_w.dumps(told), encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "run.toml"), "--out", str(tmp_path / "out")]) == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert line.endswith("data.path: images of 2 × 2 pixels tell nothing of the optics; give 16 × 16 or more")
    assert not (tmp_path / "out").exists()
