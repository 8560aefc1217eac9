"""What torchdic view shows of a folder, and what napari makes of the files that are written."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from recon.cli import main
from recon.cli.view.command import fill
from recon.cli.view.layers import layers_of
from recon.config.schema import ConfigError
from torchdic import Grid
from torchdic.errors import StackError
from torchdic.files.stack import write_stack, write_volume

GRID = Grid((6, 10, 14), (0.5, 0.2, 0.1))
FOCUS = [1.5, 0.5, -0.5]  # planes that fall
CONFIG = """
[volume]
shape = [6, 10, 14]
spacing = [0.5, 0.2, 0.1]
background = 1.36
[microscope]
wavelength = 0.546
objective = { na = 0.8 }
condenser = { na = 0.5 }
[acquisition]
focus = FOCUS
prisms = [{ shear = [0.0, 0.24], bias = 1.5708 }, { shear = [0.24, 0.0], bias = -1.5708 }]
[specimen]
kind = "bead"
radius = 0.8
contrast = 0.02
centre = [0.2, 0.1, -0.1]
"""
EXTRA = "the extra [view] isn't installed"
# napari's own modules warn of what they'll change
with_napari = pytest.mark.filterwarnings("ignore")


def values(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def leave_results(folder, focus=FOCUS, config=CONFIG):
    """A folder as reconstruct and error-bars leave it; returns what is in it by name."""
    folder.mkdir()
    (folder / "config.resolved.toml").write_text(config.replace("FOCUS", str(focus)), encoding="utf-8")
    kept = {"Δn": 0.03 * values(*GRID.shape), "sd": 0.001 * values(*GRID.shape), "error": 0.002 * values(*GRID.shape)}
    for name, file in (("Δn", "volume"), ("sd", "sd"), ("error", "error")):
        write_volume(folder / f"{file}.ome.tif", kept[name], GRID)
    kept["images"] = values(4, len(focus), 10, 14)
    names = [f"{kind}, prism {prism}" for prism in (1, 2) for kind in ("measured", "modelled")]
    write_stack(
        folder / "images.ome.tif", kept["images"], GRID.spacing[1:], 1.0 if focus == FOCUS else None, names=names
    )
    return kept


def named(layers):
    return {layer.name: layer for layer in layers}


# --- the layers -------------------------------------------------------------------------------------------------------


def test_a_reconstruction_has_its_volumes_error_bars_and_images_each_at_its_place(tmp_path):
    kept = leave_results(tmp_path / "out")
    layers = layers_of(tmp_path / "out")
    found = named(layers)
    kinds = ("residual", "modelled", "measured")
    of_images = [f"{kind}, prism {prism}" for prism in (1, 2) for kind in kinds]
    of_bars = ["standard deviation of Δn, by noise", "standard deviation of Δn, in all"]
    assert list(found) == [*of_images, *of_bars, "Δn, true", "Δn"]
    assert [layer.name for layer in layers if layer.visible] == ["Δn"]
    for name in (*of_bars, "Δn, true", "Δn"):
        assert found[name].spacing == pytest.approx(GRID.spacing)
        assert found[name].first == pytest.approx((-1.25, -0.9, -0.65))
    for name in of_images:
        assert found[name].spacing == pytest.approx((1.0, 0.2, 0.1))
        assert found[name].first == pytest.approx((-0.5, -0.9, -0.65))
    assert {layer.unit for layer in layers} == {"µm"}
    np.testing.assert_array_equal(found["Δn"].data, kept["Δn"])
    np.testing.assert_array_equal(found["modelled, prism 2"].data, kept["images"][3].flip(0))
    residual = kept["images"][2] - kept["images"][3]
    np.testing.assert_allclose(found["residual, prism 2"].data, residual.flip(0), atol=1e-6)


def test_what_is_compared_has_the_same_limits(tmp_path):
    kept = leave_results(tmp_path / "out")
    found = named(layers_of(tmp_path / "out"))
    assert found["Δn"].limits == found["Δn, true"].limits == pytest.approx((0.0, float(kept["Δn"].max())))
    bars = [layer.limits for name, layer in found.items() if name.startswith("standard")]
    assert bars[0] == bars[1] == pytest.approx((0.0, float(kept["error"].max())))
    assert found["measured, prism 1"].limits == found["modelled, prism 1"].limits
    low, high = found["residual, prism 1"].limits
    assert -low == high == found["residual, prism 2"].limits[1]


def test_the_truth_is_that_of_the_specimen_which_the_configuration_names(tmp_path):
    leave_results(tmp_path / "out")
    truth = named(layers_of(tmp_path / "out"))["Δn, true"].data
    assert truth.max() == pytest.approx(0.02, rel=1e-3)
    places = torch.meshgrid(*(GRID.coordinates(axis) for axis in range(3)), indexing="ij")
    z, y, x = (np.sum(truth * axis.numpy()) / np.sum(truth) for axis in places)
    assert (z, y, x) == pytest.approx((0.2, 0.1, -0.1), abs=0.05)
    (tmp_path / "out" / "config.resolved.toml").write_text(
        CONFIG.partition("[specimen]")[0].replace("FOCUS", str(FOCUS)), encoding="utf-8"
    )
    assert "Δn, true" not in named(layers_of(tmp_path / "out"))
    write_volume(tmp_path / "out" / "truth.ome.tif", torch.full(GRID.shape, 0.01), GRID)
    assert named(layers_of(tmp_path / "out"))["Δn, true"].data.max() == np.float32(0.01)


def test_planes_at_unequal_steps_keep_their_range_and_say_so(tmp_path):
    leave_results(tmp_path / "out", focus=[-1.0, 0.0, 3.0])
    found = named(layers_of(tmp_path / "out"))["measured, prism 1 (planes at unequal steps)"]
    assert found.first[0] == -1.0
    assert found.spacing[0] == 2.0


def test_what_simulate_leaves_is_shown_with_the_specimen(tmp_path):
    fidelity = '[fidelity]\npropagation = "projection"\nsources = 4\n'
    (tmp_path / "in.toml").write_text(CONFIG.replace("FOCUS", str(FOCUS)) + fidelity, encoding="utf-8")
    assert main(["simulate", str(tmp_path / "in.toml"), "--out", str(tmp_path / "out")]) == 0
    found = named(layers_of(tmp_path / "out"))
    assert list(found) == ["simulated, prism 1", "simulated, prism 2", "Δn, true"]
    assert found["Δn, true"].visible
    assert found["simulated, prism 1"].first[0] == -0.5


def test_an_image_without_sizes_is_shown_in_pixels(tmp_path):
    write_stack(tmp_path / "phase.ome.tif", values(10, 14))
    (layer,) = layers_of(tmp_path)
    assert (layer.unit, layer.spacing, layer.visible) == ("pixel", (1.0, 1.0, 1.0), True)


def test_values_that_are_all_one_have_limits_too(tmp_path):
    write_volume(tmp_path / "volume.ome.tif", torch.zeros(GRID.shape), GRID)
    assert layers_of(tmp_path)[0].limits == (0.0, 1.0)


def test_what_cannot_be_viewed_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match="no such folder"):
        layers_of(tmp_path / "out")
    with pytest.raises(ConfigError, match=r"holds nothing to view, which is one of volume\.ome\.tif, "):
        layers_of(tmp_path)
    (tmp_path / "volume.ome.tif").write_bytes(b"no TIFF")
    with pytest.raises(ConfigError, match="is a file, not a folder of results"):
        layers_of(tmp_path / "volume.ome.tif")
    with pytest.raises(StackError, match=r"volume\.ome\.tif: is no TIFF"):
        layers_of(tmp_path)
    write_stack(tmp_path / "images.ome.tif", values(3, 2, 10, 14))
    with pytest.raises(ConfigError, match="holds 3 channels, no measured and modelled ones in turn"):
        layers_of(tmp_path)


# --- the command ------------------------------------------------------------------------------------------------------


def one_error(capsys, folder):
    assert main(["view", str(folder)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_missing_napari_is_named_with_its_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "napari", None)
    assert "view: napari is missing or incomplete" in one_error(capsys, tmp_path)
    monkeypatch.setitem(sys.modules, "napari", ModuleType("napari"))
    monkeypatch.setitem(sys.modules, "qtpy.QtWidgets", None)
    assert one_error(capsys, tmp_path).endswith("pip install 'torchdic[view]'")


class StandIn:
    """As napari gives its viewer."""

    def __init__(self, title):
        self.title, self.shown = title, {}
        self.canvas = SimpleNamespace(overlays=SimpleNamespace(scale_bar=SimpleNamespace(visible=False)))

    def add_image(self, data, name, **how):
        self.shown[name] = (data, how)


@pytest.fixture
def stand_in(monkeypatch):
    """A package napari whose viewers are kept, on a screen."""
    package, opened = ModuleType("napari"), []
    vars(package)["Viewer"] = lambda title: opened.append(StandIn(title)) or opened[-1]
    vars(package)["run"] = lambda: None
    monkeypatch.setitem(sys.modules, "napari", package)
    monkeypatch.setitem(sys.modules, "qtpy.QtWidgets", ModuleType("qtpy.QtWidgets"))
    monkeypatch.setenv("DISPLAY", ":0")
    return opened


def test_the_viewer_gets_every_layer_and_nothing_is_written(tmp_path, capsys, stand_in):
    leave_results(tmp_path / "out")
    before = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    assert main(["view", str(tmp_path / "out")]) == 0
    (viewer,) = stand_in
    assert list(viewer.shown) == [layer.name for layer in layers_of(tmp_path / "out")]
    assert viewer.shown["Δn"][1]["units"] == ("µm", "µm", "µm")
    assert viewer.canvas.overlays.scale_bar.visible
    said = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"Δn: 6 × 10 × 14, 0\.5 × 0\.2 × 0\.1 µm, from 0 to 0\.0\d+", said[0])
    assert len(said) == len(viewer.shown)
    assert {path.name: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have a screen always")
def test_a_missing_screen_is_told(tmp_path, capsys, monkeypatch, stand_in):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    assert "view: there is no screen (DISPLAY is not set)" in one_error(capsys, tmp_path)
    assert stand_in == []


# --- napari itself ----------------------------------------------------------------------------------------------------


@pytest.fixture
def viewer(monkeypatch):
    """napari's viewer without its window."""
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    pytest.importorskip("napari", reason=EXTRA)
    from napari.components import ViewerModel
    from npe2 import PluginManager

    PluginManager.instance().discover()
    return ViewerModel()


@with_napari
def test_napari_shows_the_layers_at_their_scale_in_micrometres(tmp_path, viewer):
    leave_results(tmp_path / "out")
    layers = layers_of(tmp_path / "out")
    fill(viewer, layers)
    assert [layer.name for layer in viewer.layers] == [layer.name for layer in layers]
    for shown, layer in zip(viewer.layers, layers, strict=True):
        assert tuple(shown.scale) == pytest.approx(layer.spacing)
        assert {str(unit) for unit in shown.units} == {"micrometer"}
        assert shown.axis_labels == ("z", "y", "x")
        assert tuple(shown.contrast_limits) == pytest.approx(layer.limits)
        assert shown.visible == layer.visible
    # the volume fills 3 × 2 × 1.4 µm about the origin, its voxels' centres one voxel less
    corners = np.array([(-1.25, -0.9, -0.65), (1.25, 0.9, 0.65)])
    np.testing.assert_allclose(viewer.layers["Δn"].extent.world, corners, atol=1e-6)


@with_napari
@pytest.mark.parametrize(
    ("suffix", "plugin"), [(".ome.tif", "napari-tiff"), (".ome.zarr", "napari-ome-zarr"), (".zarr", "napari-ome-zarr")]
)
def test_napari_opens_what_is_written_at_its_scale_in_micrometres(tmp_path, viewer, suffix, plugin):
    pytest.importorskip(plugin.replace("-", "_"), reason=EXTRA)
    delta, images = 0.03 * values(*GRID.shape), values(2, 3, 10, 14)
    write_volume(tmp_path / f"volume{suffix}", delta, GRID)
    write_stack(tmp_path / f"images{suffix}", images, (0.2, 0.1), 1.0, names=("measured", "modelled"))
    viewer.open(tmp_path / f"volume{suffix}", plugin=plugin)
    viewer.open(tmp_path / f"images{suffix}", plugin=plugin)
    shown = list(viewer.layers)
    for layer, data, step in zip(shown, (delta, *images), (0.5, 1.0, 1.0), strict=True):
        np.testing.assert_array_equal(np.asarray(layer.data), data)
        assert tuple(layer.scale) == pytest.approx((step, 0.2, 0.1))
        assert {str(unit) for unit in layer.units} == {"micrometer"}
    assert ["delta n" in shown[0].name, "measured" in shown[1].name, "modelled" in shown[2].name] == [True] * 3


WINDOW = """
import sys, napari
from recon.cli import main
def leave():
    viewer = napari.current_viewer()
    viewer.screenshot(sys.argv[2])
    viewer.close()
napari.run = leave
raise SystemExit(main(["view", sys.argv[1]]))
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="xvfb-run, a screen for tests, isn't installed")
def test_the_window_shows_the_volume_in_its_colours(tmp_path):
    pytest.importorskip("napari", reason=EXTRA)
    (tmp_path / "out").mkdir()
    delta = torch.zeros(GRID.shape)
    delta[:, :, 7:] = 0.02
    write_volume(tmp_path / "out" / "volume.ome.tif", delta, GRID)
    words = [sys.executable, "-W", "ignore", "-c", WINDOW, str(tmp_path / "out"), str(tmp_path / "window.png")]
    subprocess.run(["xvfb-run", "-a", *words], check=True, cwd=Path(__file__).parents[1], timeout=120)
    with Image.open(tmp_path / "window.png") as picture:
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for expected in ((68, 1, 84), (253, 231, 37)):  # the ends of viridis
        assert (np.abs(colours.astype(int) - expected).max(1) < 8).mean() > 0.05
