import dataclasses
import math
import tomllib
from pathlib import Path

import pytest
import tomli_w
import torch
from refusal import the_error

from recon.config import Config, UnitsWarning, dump, flat, load
from recon.config.schema import VolumeSection
from recon.fit.bounds import Bounds
from recon.fit.problem import Recipe
from torchdic import Acquisition, Condenser, Fidelity, Microscope, Objective, Prism

CONTRACT = """
[volume]                       # the reconstruction's grid
shape = [20, 64, 64]           # (z, y, x) voxels
spacing = [0.4, 0.2, 0.2]      # µm
background = 1.56
[microscope]
wavelength = 0.546
objective = { na = 0.9 }
condenser = { na = 0.7 }
[acquisition]
focus = [-4.0, -3.0, -2.0]     # µm
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }, { shear = [0.24, 0.0], bias = -1.5708 }]
[data]
path = "stack.ome.tif"         # (prism, focus, y, x), (focus, y, x) or (y, x); pixels as the volume's
"""

EVERYTHING = (
    CONTRACT
    + """
scale = "background"
flatten = true
offset = 100
order = 1
[microscope.camera]
photons = 5000
read_noise = 2.5
[fidelity]
propagation = "rays"
steps = 7
sources = 12
reference_plane = 0.5
[reconstruction]
steps = 40
learning_rate = 1e-3
tv = [50, 5.0]
l1 = 0
start = "zero"
draft_sources = "none"
checkpoint_every = 3
bounds = { lower = "none", upper = 0.1 }
[simulation]
seed = 7
exact = true
[specimen]
kind = "bead"
radius = 2.5
contrast = 0.03
"""
)


@pytest.fixture
def write(tmp_path):
    """A function from TOML to the path of a file that holds it."""

    def put(text):
        path = tmp_path / "config.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return put


def changed(key, value):
    """The contract's example with one value changed, as TOML; `...` takes the key away."""
    values = tomllib.loads(CONTRACT)
    *folders, last = (int(part) if part.isdigit() else part for part in key.split("."))
    place = values
    for part in folders:
        place = place[part] if isinstance(place, list) else place.setdefault(part, {})
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return tomli_w.dumps(values)


def equal(a, b):
    """Whether two configurations hold the same, tensors included."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(equal(x, y) for x, y in zip(a, b, strict=True))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b and type(a) is type(b)


# what a file says


def test_the_contracts_example_loads_as_written(write):
    path = write(CONTRACT)
    config = load(path)
    assert config.volume.grid.shape == (20, 64, 64)
    assert config.volume.grid.spacing == (0.4, 0.2, 0.2)
    assert config.volume.background == 1.56
    assert config.microscope.wavelength == 0.546
    assert config.microscope.objective.na == 0.9
    assert config.microscope.condenser.na == 0.7
    assert config.acquisition.focus == (-4.0, -3.0, -2.0)
    assert [(p.shear, p.bias) for p in config.acquisition.prisms] == [((0.0, 0.24), 1.5708), ((0.24, 0.0), -1.5708)]
    assert Path(config.data.path) == path.parent / "stack.ome.tif"


def test_what_a_file_does_not_say_is_absent_or_recommended(write):
    config = load(write(CONTRACT))
    assert config.fidelity is None  # each command has its own
    assert dataclasses.asdict(config.reconstruction).items() >= dataclasses.asdict(Recipe()).items()
    assert config.microscope.camera is None
    assert config.microscope.objective.aberrations is None
    assert config.specimen is None
    assert config.data.scale is None
    assert config.data.flatten is None


@pytest.mark.parametrize(
    ("propagation", "typed", "method"),
    [
        ("wave", "", "newton"),
        ("rays", "", "adam"),
        ("projection", "[reconstruction]\nsteps = 7", "adam"),
        ("rays", '[reconstruction]\nmethod = "newton"', "newton"),
    ],
)
def test_the_method_is_the_one_that_suits_the_propagation(write, propagation, typed, method):
    """Newton's Hessian is near the wave's: on rays Adam errs less (docs/reconstruction.md)."""
    config = load(write(f'{CONTRACT}\n[fidelity]\npropagation = "{propagation}"\n{typed}'))
    assert config.reconstruction.method == method


def test_every_section_is_read(write):
    config = load(write(EVERYTHING))
    assert config.fidelity == Fidelity("rays", steps=7, sources=12, reference_plane=0.5)
    recipe = config.reconstruction
    assert (recipe.steps, recipe.learning_rate, recipe.tv, recipe.l1) == (40, 1e-3, (50.0, 5.0), 0.0)
    assert (recipe.start, recipe.draft_sources, recipe.checkpoint_every) == ("zero", None, 3)
    assert recipe.bounds == Bounds(None, 0.1)
    assert (config.microscope.camera.photons, config.microscope.camera.read_noise) == (5000, 2.5)
    assert (config.data.scale, config.data.flatten, config.data.offset, config.data.order) == (
        "background",
        True,
        100,
        1,
    )
    assert (config.simulation.seed, config.simulation.exact) == (7, True)
    assert config.specimen == {"kind": "bead", "radius": 2.5, "contrast": 0.03}


@pytest.mark.parametrize("method", ["linear", "cone", None])
def test_defocus_and_object_aberration_are_read_and_dumped(write, tmp_path, method):
    options = {"propagation": "projection", "defocus": "paraxial", "object_aberration": method or "none"}
    config = load(write(changed("fidelity", options)))
    assert config.fidelity == Fidelity("projection", defocus="paraxial", object_aberration=method)
    again = tmp_path / "again.toml"
    again.write_text(dump(config), encoding="utf-8")
    assert equal(load(again), config)


@pytest.mark.parametrize(
    ("key", "value", "read"),
    [
        ("reconstruction.learn", ["brightness"], ("brightness",)),
        ("reconstruction.learn", ["bias", "drift", "focus", "shear"], ("bias", "drift", "focus", "shear")),
        ("reconstruction.tv", "auto", "auto"),
        ("reconstruction.tv", [20, 5], (20.0, 5.0)),
        ("reconstruction.margin", 8, 8),
        ("reconstruction.margin", "auto", "auto"),
        ("reconstruction.draft_sources", "auto", "auto"),
        ("reconstruction.draft_sources", "none", None),
        ("reconstruction.draft_sources", 12, 12),
        ("reconstruction.method", "opl", "opl"),
        ("data.gain", 0.5, 0.5),
        ("data.series", 2, 2),
    ],
)
def test_a_value_is_read_and_survives_its_file(write, tmp_path, key, value, read):
    config = load(write(changed(key, value)))
    section, name = key.split(".")
    assert getattr(getattr(config, section), name) == read
    again = tmp_path / "again.toml"
    again.write_text(dump(config), encoding="utf-8")
    assert equal(load(again), config)


def test_a_whole_number_serves_as_a_float(write):
    config = load(write(CONTRACT.replace("background = 1.56", "background = 2").replace("-4.0,", "-4,")))
    assert config.volume.background == 2.0
    assert isinstance(config.volume.background, float)
    assert isinstance(config.acquisition.focus[0], float)


def test_bright_field_is_a_prism_by_its_name(write):
    config = load(write(changed("acquisition.prisms", ["brightfield", {"shear": [0.0, 0.2], "bias": 0.5}])))
    assert config.acquisition.prisms[0] is None
    assert config.acquisition.prisms[1].bias == 0.5


def test_points_weights_and_aberrations_are_read(write):
    text = changed("microscope.condenser", {"na": 0.5, "points": [[0.0, 0.1], [0.2, 0.0]], "weights": [1, 3]})
    config = load(
        write(text.replace("[microscope.objective]\n", '[microscope.objective]\naberrations = { "11" = 0.2 }\n'))
    )
    assert config.microscope.condenser.points.tolist() == [[0.0, 0.1], [0.2, 0.0]]
    assert config.microscope.condenser.weights.tolist() == [1.0, 3.0]
    assert config.microscope.objective.aberrations == {11: 0.2}


def test_relative_data_paths_start_at_the_files_folder(tmp_path, monkeypatch):
    folder = tmp_path / "deep" / "er"
    folder.mkdir(parents=True)
    (folder / "config.toml").write_text(CONTRACT.replace('"stack.ome.tif"', '"../stack.ome.tif"'), encoding="utf-8")
    for place, name in ((tmp_path, "deep/er/config.toml"), (folder, "config.toml"), (folder.parent, "er/config.toml")):
        monkeypatch.chdir(place)
        assert Path(load(name).data.path) == tmp_path / "deep" / "stack.ome.tif"


def test_absolute_data_paths_stay(write, tmp_path):
    elsewhere = tmp_path / "elsewhere" / "stack.tif"
    assert load(write(changed("data.path", str(elsewhere)))).data.path == str(elsewhere)


# what is resolved


@pytest.mark.parametrize("text", [CONTRACT, EVERYTHING], ids=["contract", "everything"])
def test_the_resolved_configuration_loads_to_the_same(write, tmp_path, text):
    config = load(write(text))
    (tmp_path / "elsewhere").mkdir()
    resolved = tmp_path / "elsewhere" / "config.toml"
    resolved.write_text(dump(config), encoding="utf-8")
    assert equal(load(resolved), config)
    assert dump(load(resolved)) == dump(config)


def test_a_configuration_made_in_code_survives_its_file(tmp_path):
    config = Config(
        VolumeSection((3, 4, 5), (0.4, 0.2, 0.2), 1.33),
        Microscope(
            0.633,
            Objective(0.9, {4: 0.1, 11: -0.2}),
            Condenser(0.5, torch.tensor([[0.0, 0.1], [0.3, 0.2]], dtype=torch.float64)),
        ),
        Acquisition([None, Prism((0.1, 0.2), 1.0)], [0.5, 0.1]),
    )
    path = tmp_path / "config.toml"
    path.write_text(dump(config), encoding="utf-8")
    assert equal(load(path), config)


def test_the_resolved_configuration_spells_every_default_out(write):
    values = tomllib.loads(dump(load(write(CONTRACT))))
    usual = {f.name: getattr(Recipe(), f.name) for f in dataclasses.fields(Recipe)}
    spelled = {name: value for name, value in usual.items() if name not in ("bounds", "learn") and value is not None}
    assert values["reconstruction"].items() >= spelled.items()
    assert values["reconstruction"] | {"learn": [], "bounds": {"lower": 0.0}} == values["reconstruction"]
    assert {"steps", "l1"} & set(values["reconstruction"]) == set()  # left to the method
    assert values["simulation"] == {"seed": 0, "exact": False}
    assert "specimen" not in values


def test_flat_names_each_value_with_its_whole_key(write):
    lines = flat(load(write(EVERYTHING)))
    assert "volume.shape = [20, 64, 64]" in lines
    assert "acquisition.prisms[1].shear = [0.24, 0.0]" in lines
    assert "reconstruction.bounds.lower = 'none'" in lines
    assert len({line.partition(" = ")[0] for line in lines}) == len(lines)
    assert not any("\n" in line for line in lines)


# what is refused


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("volume.spcaing", 1, "unknown key volume.spcaing; did you mean 'spacing'?"),
        ("microscope.wavelenght", 0.5, "unknown key microscope.wavelenght; did you mean 'wavelength'?"),
        ("acquisition.prisms.1.bais", 1, "unknown key acquisition.prisms[1].bais; did you mean 'bias'?"),
        ("reconstruction.learning_rte", 1, "unknown key reconstruction.learning_rte; did you mean 'learning_rate'?"),
        ("reconstruction.bounds", {"lwer": 0}, "unknown key reconstruction.bounds.lwer; did you mean 'lower'?"),
        ("camera", {}, "unknown key camera; known keys: volume, microscope, acquisition, data"),
        ("microscope.wavelength", ..., "missing key microscope.wavelength"),
        ("volume", ..., "missing key volume"),
        ("acquisition.prisms.1.bias", ..., "missing key acquisition.prisms[1].bias"),
        ("data.path", ..., "missing key data.path"),
    ],
)
def test_a_key_that_is_unknown_or_missing_is_named(write, key, value, message):
    assert the_error(write(changed(key, value))).startswith(message)


@pytest.mark.parametrize(
    ("key", "value", "law"),
    [
        ("volume", 3, "must be a table"),
        ("microscope.objective", 0.9, "must be a table"),
        ("specimen", "bead", "must be a table"),
        ("reconstruction.bounds", [0, 1], "must be a table"),
        ("volume.background", "1.5", "must be one of 'air' (1.0003), "),
        ("volume.background", True, "must be a number"),
        ("microscope.objective.na", [0.9], "must be a number"),
        ("volume.shape", 6, "must be an array of 3 values"),
        ("volume.shape", [6, 16], "must be an array of 3 values"),
        ("reconstruction.tv", 10, "must be 'auto', or an array of the first and the last weight"),
        ("reconstruction.tv", "noise", "must be 'auto', or an array of the first and the last weight"),
        ("reconstruction.tv", [1.0], "must be 'auto', or an array of the first and the last weight"),
        ("reconstruction.method", "lbfgs", "must be one of 'newton', 'adam', 'linear', 'opl'"),
        ("reconstruction.prior", "l2", "must be one of 'log-tv', 'tv', 'smooth'"),
        ("reconstruction.misfit", "mean", "must be one of 'gaussian', 'poisson', 'robust'"),
        ("reconstruction.learn", "bias", "must be an array"),
        ("reconstruction.margin", "wide", "must be a whole number, or 'auto'"),
        ("reconstruction.draft_sources", "few", "must be a whole number, 'none', or 'auto'"),
        ("reconstruction.tiles", "Auto", "must be a whole number, 'none', or 'auto'"),
        ("reconstruction.steps", 10.0, "must be a whole number"),
        ("reconstruction.steps", True, "must be a whole number"),
        ("fidelity.sources", "12", "must be a whole number"),
        ("fidelity.defocus", "parabolic", "must be one of 'exact', 'paraxial'"),
        ("fidelity.object_aberration", "sphere", "must be one of 'linear', 'cone'"),
        ("fidelity.order", True, "must be one of 1, 2"),
        ("fidelity.order", 3, "must be one of 1, 2"),
        ("reconstruction.start", "linaer", "must be one of 'linear', 'zero'"),
        ("acquisition.focus", 1.0, "must be an array"),
        ("acquisition.prisms", {"shear": [0, 1], "bias": 1}, "must be an array"),
        ("data.path", 3, "must be a string"),
        ("data.flatten", 1, "must be true or false"),
        ("data.scale", "lamp", "must be a number, or 'background'"),
        ("simulation.exact", "yes", "must be true or false"),
        ("microscope.condenser.points", [["a", 0.1]], "must be an array of numbers"),
        ("microscope.objective.aberrations", {"defocus": 0.1}, "must be a table of Noll indices"),
    ],
)
def test_a_wrong_type_is_named_with_its_key_value_and_law(write, key, value, law):
    message = the_error(write(changed(key, value)))
    assert message.startswith(f"{key}: {value!r} {law}")


@pytest.mark.parametrize(
    ("key", "value", "named", "law"),
    [
        ("volume.shape.1", 16.5, "volume.shape: 16.5", "must be a whole number"),
        ("volume.shape.0", True, "volume.shape: True", "must be a whole number"),
        ("acquisition.focus.2", "top", "acquisition.focus[2]: 'top'", "must be a number"),
        ("acquisition.focus.0", True, "acquisition.focus[0]: True", "must be a number"),
        ("acquisition.prisms.1", "bright", "acquisition.prisms[1]: 'bright'", "or 'brightfield'"),
        ("acquisition.prisms.0.shear", [0.2], "acquisition.prisms[0].shear: [0.2]", "an array of 2 values"),
        ("acquisition.prisms.0.bias", "90°", "acquisition.prisms[0].bias: '90°'", "must be a number"),
        ("microscope.objective.aberrations", {"4": "a"}, "microscope.objective.aberrations: 'a'", "must be a number"),
    ],
)
def test_a_wrong_type_in_an_array_is_named_with_its_place(write, key, value, named, law):
    message = the_error(write(changed(key, value)))
    assert message.startswith(named)
    assert law in message


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("microscope.wavelength", -0.546, ["microscope", "wavelength -0.546 µm", "above 0"]),
        ("microscope.wavelength", math.nan, ["microscope", "wavelength nan", "above 0"]),
        ("microscope.objective.na", 0, ["microscope.objective", "NA 0", "above 0"]),
        ("microscope.objective.na", 1.9, ["objective NA 1.9", "at most 1.8"]),
        ("microscope.objective.na", math.nan, ["objective NA nan", "above 0"]),
        ("microscope.condenser.na", 1.9, ["condenser NA 1.9", "at most 1.8"]),
        ("microscope.condenser.na", -0.1, ["condenser NA -0.1", "at least 0"]),
        ("microscope.condenser.points", [[0, 2.0]], ["condenser", "2", "below", "index 1.56"]),
        ("microscope.condenser.weights", [1.0], ["condenser weights", "points"]),
        ("microscope.camera", {"photons": 0}, ["microscope.camera", "photons 0", "above 0"]),
        ("microscope.camera", {"photons": math.nan}, ["microscope.camera", "photons nan", "above 0"]),
        ("microscope.camera", {"photons": 10, "read_noise": -1}, ["read_noise -1", "at least 0"]),
        ("microscope.camera", {"read_noise": 1}, ["read_noise 1", "photons"]),
        ("microscope.objective.aberrations", {"0": 1.0}, ["aberration 0", "from 1"]),
        ("microscope.objective.aberrations", {"4": math.nan}, ["aberration 4", "nan", "finite"]),
        ("volume.shape", [0, 64, 64], ["volume", "shape (0, 64, 64)", "at least 1"]),
        ("volume.spacing", [0.4, -0.2, 0.2], ["volume", "spacing (0.4, -0.2, 0.2)", "above 0"]),
        ("volume.spacing", [0.4, 0.2, math.nan], ["volume", "spacing", "nan", "above 0"]),
        ("volume.background", 0.5, ["volume", "background 0.5", "at least 1"]),
        ("volume.background", math.nan, ["volume", "background nan", "at least 1"]),
        ("volume.background", math.inf, ["volume", "background inf"]),
        ("acquisition.prisms", [], ["acquisition", "at least one prism"]),
        ("acquisition.focus", [], ["acquisition", "at least one", "focus"]),
        ("acquisition.focus.1", math.nan, ["acquisition", "focus nan", "finite"]),
        ("acquisition.prisms.1.bias", math.nan, ["acquisition.prisms[1]", "bias nan", "finite"]),
        ("acquisition.prisms.0.shear", [0, math.inf], ["acquisition.prisms[0]", "shear x inf", "finite"]),
        ("fidelity.propagation", "waves", ["fidelity", "propagation", "'waves'", "of 'projection', 'rays', 'wave'"]),
        ("fidelity.sources", 0, ["fidelity", "sources 0", "at least 1"]),
        ("simulation.seed", 2**64, ["simulation", "seed 18446744073709551616", "from -2^63 to 2^64 - 1"]),
        ("fidelity.steps", 0, ["fidelity", "steps 0", "at least 1"]),
        ("fidelity.object_aberration", "cone", ["fidelity", "'cone' has no use", "wave"]),
        (
            "fidelity",
            {"propagation": "rays", "object_aberration": "linear"},
            ["fidelity", "double-counts", "amplitude must be false"],
        ),
        ("fidelity.padding", -1, ["fidelity", "padding -1", "at least 0"]),
        ("reconstruction.steps", 0, ["reconstruction", "steps 0", "at least 1"]),
        ("reconstruction.margin", -1, ["reconstruction", "margin -1", "at least 0"]),
        ("reconstruction.tv", [-1.0, 1.0], ["reconstruction", "tv -1.0", "at least 0"]),
        ("reconstruction.l1", -1.0, ["reconstruction", "l1 -1.0", "at least 0"]),
        ("reconstruction.learn", ["colour"], ["reconstruction", "learn 'colour'", "'brightness', 'bias', 'drift'"]),
        ("reconstruction.learn", ["bias", "bias"], ["reconstruction", "learn ['bias', 'bias']", "twice"]),
        ("data.gain", 0.0, ["data", "gain 0.0", "above 0"]),
        ("data.read_noise", -1.0, ["data", "read_noise -1.0", "at least 0"]),
        ("reconstruction.learning_rate", -1, ["reconstruction", "learning_rate -1", "above 0"]),
        ("reconstruction.tv", [math.nan, 1], ["reconstruction", "tv nan", "at least 0"]),
        ("reconstruction.checkpoint_every", 0, ["reconstruction", "checkpoint_every 0", "at least 1"]),
        ("reconstruction.draft_sources", 0, ["reconstruction", "draft_sources 0", "at least 1"]),
        ("reconstruction.bounds", {"lower": 1, "upper": 0.5}, ["reconstruction.bounds", "1.0", "below", "0.5"]),
        ("reconstruction.bounds", {"lower": math.nan}, ["reconstruction.bounds", "nan", "finite"]),
        ("data.scale", -1, ["data", "scale -1", "above 0"]),
        ("data.offset", math.nan, ["data", "offset nan", "finite"]),
        ("data.order", -1, ["data", "order -1", "at least 0"]),
        ("data.series", -1, ["data", "series -1", "at least 0"]),
    ],
)
def test_an_unphysical_value_is_named_with_its_law(write, key, value, words):
    message = the_error(write(changed(key, value)))
    assert [word for word in words if word not in message] == []


def test_an_unknown_key_is_told_before_what_it_left_missing(write):
    text = CONTRACT.replace("wavelength", "wavelenght")
    assert the_error(write(text)).startswith("unknown key microscope.wavelenght")


@pytest.mark.parametrize("text", ["[volume\n", "shape = [1,\n", "[volume]\n[volume]\n", "a = 1\na = 2\n"])
def test_bad_toml_is_told_with_its_line(write, text):
    message = the_error(write(text))
    assert "is not TOML" in message
    assert "line " in message or "end of document" in message


def test_a_file_that_is_not_utf_8_is_told(tmp_path):
    path = tmp_path / "config.toml"
    path.write_bytes(CONTRACT.encode("latin-1"))
    assert the_error(path).startswith("is not TOML: 'utf-8' codec can't decode")


def test_a_missing_file_and_a_folder_are_told(tmp_path):
    assert the_error(tmp_path / "none.toml") == "No such file or directory"
    assert the_error(tmp_path) == (
        f"is a folder, not a configuration; torchdic new {tmp_path} --out run.toml writes one for a stack"
    )


def test_an_empty_file_misses_its_first_section(write):
    assert the_error(write("")) == "missing key volume"


def test_a_shear_longer_than_the_volume_is_warned_of(write):
    path = write(CONTRACT.replace("shear = [0.0, 0.24]", "shear = [0, 15]"))
    with pytest.warns(
        UnitsWarning, match=r"prisms\[0\]\.shear: 15 is longer than .* 12\.8 µm; lengths are in µm"
    ) as warned:
        load(path)
    assert len(warned) == 1
    assert str(path) in str(warned[0].message)


def test_a_volume_one_voxel_wide_may_be_narrower_than_the_shear(write):
    """Nothing changes along that side."""
    load(write(CONTRACT.replace("[20, 64, 64]", "[20, 64, 1]")))
