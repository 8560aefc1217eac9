import json
import math
from pathlib import Path

import pytest

from recon.cli import main
from recon.config.conversion import dump
from recon.config.reading import load
from torchdic.files.stack import read_stack

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
FILES = sorted(EXPERIMENTS.glob("*.toml"))


def test_the_promised_experiments_are_there():
    promised = {"bead.toml", "etched_glass.toml", "cell.toml", "four_frames.toml", "six_frames.toml"}
    assert promised <= {path.name for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_experiments_configuration_loads_and_resolves_to_itself(path, tmp_path):
    config = load(path)
    resolved = tmp_path / "config.toml"
    resolved.write_text(dump(config), encoding="utf-8")
    assert dump(load(resolved)) == dump(config)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_every_experiment_has_a_specimen_or_data(path):
    config = load(path)
    assert config.specimen is not None or config.data is not None


@pytest.mark.parametrize(("name", "biases"), [("four_frames", (-90, 90)), ("six_frames", (-60, 0, 60))])
def test_orientation_independent_frames_have_two_axes_at_45_degrees_with_each_bias(name, biases):
    prisms = load(EXPERIMENTS / f"{name}.toml").acquisition.prisms
    found = [
        (round(math.degrees(math.atan2(*prism.shear))), round(math.hypot(*prism.shear), 9), math.degrees(prism.bias))
        for prism in prisms
    ]
    expected = [(angle, 0.2, pytest.approx(bias)) for angle in (45, -45) for bias in biases]
    assert found == expected


@pytest.mark.parametrize("name", ["four_frames", pytest.param("six_frames", marks=pytest.mark.slow)])
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.filterwarnings("ignore:.*tells no scale")
@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
def test_orientation_independent_frames_are_simulated_and_reconstructed(name, tmp_path):
    """The ready configuration on few voxels, with a bead in the cell's place."""
    small = tmp_path / "small.toml"
    small.write_text(
        f'include = "{(EXPERIMENTS / name).as_posix()}.toml"\n'
        "[volume]\nshape = [8, 32, 32]\n[acquisition]\nfocus = { first = -1.2, step = 1.2, count = 3 }\n"
        "[fidelity]\nsources = 12\norder = 1\n[reconstruction]\nsteps = 4\n"
        '[specimen]\nkind = "gaussian_ball"\nsigma = 0.6\ncontrast = 0.02\n[data]\npath = "out/stack.ome.tif"\n',
        encoding="utf-8",
    )
    out = tmp_path / "out"
    assert main(["simulate", str(small), "--out", str(out), "--device", "cpu"]) == 0
    assert read_stack(out / "stack.ome.tif").data.dtype.name == "uint16"
    assert main(["reconstruct", str(small), "--out", str(out), "--device", "cpu"]) == 0
    found = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert found["misfit"] < 1.2 * found["noise_misfit"] < 0.9
    # counts of a bright field are as many as the photons times the gain, by every frame
    assert [prism["scale"] for prism in found["prisms"]] == pytest.approx([10000] * len(found["prisms"]), rel=0.02)
    assert 0.01 < found["delta"]["max"] < 0.03
