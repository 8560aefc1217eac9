"""The methods without a descent, from a configuration to a folder."""

import json

import numpy as np
import pytest
import tifffile
import tomli_w
import torch
from results import BESIDE

from data_synthetic import GaussianBall
from recon.cli import main
from recon.config.reading import load
from recon.report.metrics import volume_error
from recon.run.reconstruct import RECOMMENDED, reconstruct
from torchdic import Grid, Volume, image
from torchdic.files.stack import read_stack, read_volume, write_stack

GRID = Grid((5, 28, 26), (0.5, 0.2, 0.21))
CONFIG = {
    "volume": {"shape": list(GRID.shape), "spacing": list(GRID.spacing), "background": 1.5},
    "microscope": {"wavelength": 0.546, "objective": {"na": 0.7}, "condenser": {"na": 0.4}},
    "acquisition": {
        "focus": [-1.0, 0.0, 1.0],
        "prisms": [
            {"shear": shear, "bias": bias} for shear in ([0.0, 0.24], [0.24, 0.0]) for bias in (1.5708, -1.5708)
        ],
    },
    "fidelity": {"sources": 6, "order": 1},
    "data": {"path": "stack.ome.tif"},
}
RESULTS = {"volume.ome.tif", "images.ome.tif", "images.png", "sections.png"}
RESULTS |= {"metrics.json", "config.resolved.toml", *BESIDE}
METHODS = pytest.mark.parametrize("method", ["linear", "opl"])
OPL_SLOW = pytest.mark.parametrize("method", ["linear", pytest.param("opl", marks=pytest.mark.slow)])


@pytest.fixture
def truth():
    return GaussianBall(0.5, 0.01, 1.5).delta(GRID, dtype=torch.float32)


@pytest.fixture
def write(truth, tmp_path):
    """A function from a method, and changes of the configuration, to its file, beside a stack with some noise."""

    def put(method, **changes):
        values = {**CONFIG, "reconstruction": {"method": method}, **changes}
        path = tmp_path / f"{method}.toml"
        path.write_text(tomli_w.dumps({k: v for k, v in values.items() if v is not None}), encoding="utf-8")
        config = load(path)
        with torch.no_grad():
            data = image(Volume(GRID, truth, 1.5), config.microscope, config.acquisition, RECOMMENDED)
        data = data + 0.003 * torch.randn(data.shape, generator=torch.Generator().manual_seed(0))
        write_stack(tmp_path / "stack.ome.tif", data, GRID.spacing[1:], 1.0)
        return path

    return put


def found(folder):
    return read_volume(folder / "volume.ome.tif")[0], json.loads((folder / "metrics.json").read_text(encoding="utf-8"))


@METHODS
@pytest.mark.usefixtures("no_pictures")
def test_a_direct_method_leaves_its_volume_and_its_numbers(write, truth, tmp_path, capsys, method):
    out = tmp_path / "out"
    assert main(["reconstruct", str(write(method)), "--out", str(out)]) == 0
    assert f"{out / 'volume.ome.tif'}: Δn" in capsys.readouterr().out
    expected = RESULTS | ({"opl.ome.tif"} if method == "opl" else set())
    assert {p.name for p in out.iterdir()} == expected
    delta, metrics = found(out)
    assert delta.shape == GRID.shape
    # the sum along z: a section of path length doesn't say where along z it lies
    assert volume_error(delta.sum(0, keepdim=True), truth.sum(0, keepdim=True)) < 0.75
    assert metrics["method"] == method
    assert metrics["steps"] == 1
    assert metrics["seconds"] > 0
    assert metrics["tv"] > 0
    assert metrics["weights"][0]["misfit"] is None
    assert len(metrics["weights"][0]["reason"]) > 0
    assert np.array(metrics["learned"]["brightness"]) == pytest.approx(np.ones((4, 3)))
    assert metrics["delta"]["max"] == float(delta.max())
    assert "margin" not in metrics


@pytest.mark.usefixtures("no_pictures")
def test_the_linear_methods_misfit_is_that_of_the_models_images(write, tmp_path):
    result = reconstruct(load(write("linear")), tmp_path / "out", torch.device("cpu"))
    assert result.metrics["noise_misfit"] < result.metrics["misfit"] < 0.5
    assert float(result.delta.min()) >= 0  # within the bounds


@pytest.mark.usefixtures("no_pictures")
def test_path_lengths_are_left_in_µm_with_the_pixel_and_the_focus_step(write, truth, tmp_path):
    assert main(["reconstruct", str(write("opl")), "--out", str(tmp_path / "out")]) == 0
    stack = read_stack(tmp_path / "out" / "opl.ome.tif")
    assert stack.data.shape == (1, 3, 28, 26)
    assert stack.pixel_size == GRID.spacing[1:]
    assert stack.focus_step == 1.0
    expected = truth.sum(0) * GRID.spacing[0]
    section = torch.from_numpy(stack.data[0, 1])
    assert float(section.max()) == pytest.approx(float(expected.max()), rel=0.4)
    assert float(torch.cosine_similarity(section.flatten(), expected.flatten(), 0)) > 0.9
    with tifffile.TiffFile(tmp_path / "out" / "opl.ome.tif") as tif:
        assert tif.series[0].dtype == np.float32


@OPL_SLOW
@pytest.mark.usefixtures("no_pictures")
@pytest.mark.slow
def test_a_second_run_begins_anew_where_asked(write, tmp_path, method, capsys):
    path, out = write(method), tmp_path / "out"
    assert main(["reconstruct", str(path), "--out", str(out)]) == 0
    first, _ = found(out)
    for options in ([], ["--resume"]):
        assert main(["reconstruct", str(path), "--out", str(out), *options]) == 2
        assert "metrics.json: the folder has results" in capsys.readouterr().err
    assert main(["reconstruct", str(path), "--out", str(out), "--restart"]) == 0
    delta, metrics = found(out)
    assert metrics["steps"] == 1
    assert torch.equal(delta, first)
    assert not (out / "checkpoint.pt").exists()


@OPL_SLOW
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("no_pictures")
def test_a_tolerance_is_planned_for_the_volume_that_was_found(write, tmp_path, method):
    path = write(method, fidelity=None, tolerance=0.2)
    assert main(["reconstruct", str(path), "--out", str(tmp_path / "out")]) == 0
    _, metrics = found(tmp_path / "out")
    assert len(metrics["plans"]) == 1
    assert metrics["plans"][0]["met"] is True


@pytest.mark.parametrize(
    ("method", "changes", "law"),
    [
        ("opl", {"acquisition": {"focus": [0.0], "prisms": ["brightfield"]}}, "needs an image with a sheared prism"),
        ("opl", {"reconstruction": {"method": "opl", "margin": 3}}, "the setup has a margin"),
        ("linear", {"reconstruction": {"method": "linear", "margin": 3}}, "the setup has a margin"),
    ],
)
def test_what_a_direct_method_cannot_is_refused_in_one_line(write, tmp_path, capsys, method, changes, law):
    assert main(["reconstruct", str(write(method, **changes)), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"reconstruction.method: '{method}': " in line
    assert law in line
    assert not (tmp_path / "out").exists()
