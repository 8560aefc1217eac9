"""torchdic phase: the phase behind one image whose optics are unknown."""

import json
import math

import numpy as np
import pytest
import torch
from matplotlib.patches import Rectangle

from data_synthetic import Ellipsoid
from data_synthetic.recorder.faults import Faults
from data_synthetic.recorder.record import Finer, record
from data_synthetic.scenes.any_specimen import solid
from data_synthetic.scenes.fibre import Fibre
from recon.cli import main
from recon.cli.own_stack.phase_figure import draw_phase
from recon.earlier.one_image import phase_of_image
from recon.recording.survey.direction import ShearDirection
from torchdic import Acquisition, Camera, Condenser, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import read_stack, write_stack

SHAPE = (96, 112)
AXIS = ShearDirection(0.5, 0.1, signed=True, specimens=1)


@pytest.fixture
def discs() -> torch.Tensor:
    """Δn of round blobs in one slice, none at the border."""
    random = torch.Generator().manual_seed(3)
    y, x = torch.meshgrid(torch.arange(1.0 * SHAPE[0]), torch.arange(1.0 * SHAPE[1]), indexing="ij")
    delta = torch.zeros(SHAPE)
    for _ in range(16):
        place = torch.rand(3, generator=random)
        cy, cx = (30 + (n - 60) * float(p) for n, p in zip(SHAPE, place, strict=False))
        delta = torch.maximum(delta, torch.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * (3 + 4 * place[2]) ** 2)))
    return 0.05 * delta[None]


def phase(*words):
    return main(["phase", *map(str, words)])


def facts(folder):
    return json.loads((folder / "phase.json").read_text())


@pytest.mark.usefixtures("no_pictures")
def test_a_sheared_image_gives_back_its_phase_but_for_scale_and_sign(tmp_path, discs, capsys):
    grid, angle = Grid((1, *SHAPE), (1.0, 0.25, 0.25)), math.radians(30)
    prism = Prism((0.25 * math.sin(angle), 0.25 * math.cos(angle)), 0.8)
    recorded = image(Volume(grid, discs, 1.33), Microscope(0.55, Objective(0.3)), Acquisition([prism]))[0, 0].numpy()
    shading = np.linspace(0.9, 1.1, SHAPE[1])
    write_stack(tmp_path / "dic.tif", np.round(200 / recorded.max() * recorded * shading).astype(np.uint8))
    assert phase(tmp_path / "dic.tif", "--out", tmp_path / "out") == 0
    said = facts(tmp_path / "out")
    wrong = abs((said["shear_axis_degrees"] - 30 + 90) % 180 - 90)
    assert wrong < min(3 * said["uncertainty_degrees"], 10)
    found = read_stack(tmp_path / "out" / "phase.ome.tif").data[0, 0]
    assert np.corrcoef(found.ravel(), discs[0].numpy().ravel())[0, 1] > 0.7
    assert (tmp_path / "out" / "phase.png").exists()
    assert "shear axis" in capsys.readouterr().out


def recorded(specimen, planes=(0.0,)):
    field, angle = Grid((8, 56, 60), (0.5, 0.15, 0.15)), math.radians(40)
    camera = Camera(photons=8000.0, gain=1.0, offset=100.0, bits=16)
    microscope = Microscope(0.55, Objective(0.9), Condenser(0.6), camera)
    prism = Prism((0.18 * math.sin(angle), 0.18 * math.cos(angle)), math.radians(70))
    faults = Faults(tilt=(0.15, 0.05), hot=3)
    return record(specimen, field, microscope, Acquisition([prism], planes), faults, Finer((1, 1, 1), 16, 18), 2)


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.parametrize("long_axis", [0, 65, 130])
def test_the_axis_of_an_elongated_specimen_is_right_within_its_uncertainty(tmp_path, long_axis):
    """A rod twice as long as wide, at any angle to the shear of 40°; the power of its spectrum lies across the rod."""
    data = recorded(Fibre(0.7, 1.6, 0.02, 1.335, math.radians(long_axis))).data
    write_stack(tmp_path / "cell.tif", data)
    assert phase(tmp_path / "cell.tif", "--out", tmp_path / "out") == 0
    said = facts(tmp_path / "out")
    wrong = abs((said["shear_axis_degrees"] - 40 + 90) % 180 - 90)
    assert wrong < 3 * said["uncertainty_degrees"]
    assert wrong < 5
    assert said["how"] == "from 1 specimen that stands alone"


@pytest.mark.usefixtures("no_pictures")
def test_of_a_stack_the_sharpest_plane_is_taken_or_the_one_that_is_named(tmp_path, capsys):
    data = recorded(solid(Ellipsoid((0.4, 0.8, 1.2)), 0.02, 1.335), (-4.0, -2.0, 0.0, 4.0)).data
    write_stack(tmp_path / "stack.tif", data, (0.15, 0.15))
    assert phase(tmp_path / "stack.tif", "--out", tmp_path / "out") == 0
    assert facts(tmp_path / "out")["plane"] == 3
    assert "plane 3 of 4" in capsys.readouterr().out
    assert phase(tmp_path / "stack.tif", "--out", tmp_path / "named", "--plane", 2, "--shear-angle", 40) == 0
    said = facts(tmp_path / "named")
    assert (said["plane"], said["shear_axis_degrees"], said["how"]) == (2, 40.0, "given")


@pytest.mark.usefixtures("no_pictures")
def test_no_size_is_said_that_is_not_known(tmp_path):
    data = recorded(solid(Ellipsoid((0.4, 0.8, 1.2)), 0.02, 1.335)).data
    for name, size in (("known", (0.15, 0.15)), ("unknown", None)):
        write_stack(tmp_path / f"{name}.tif", data, size)
        assert phase(tmp_path / f"{name}.tif", "--out", tmp_path / name) == 0
        assert read_stack(tmp_path / name / "phase.ome.tif").pixel_size == size
        assert facts(tmp_path / name)["pixel_size"] == (None if size is None else list(size))


def test_a_scale_bar_is_drawn_where_the_pixel_size_is_known_alone():
    ramp = np.add.outer(np.arange(8.0), np.arange(9.0))
    bars = [
        sum(
            isinstance(patch, Rectangle) for ax in draw_phase(ramp, ramp, ramp, AXIS, size).axes for patch in ax.patches
        )
        for size in (None, (0.1, 0.1))
    ]
    assert bars == [0, 1]


@pytest.mark.parametrize("direction", [(0.0, 1.0), (1.0, 0.0), (3.0, 4.0)])
def test_the_phase_of_a_weak_object_is_its_own_times_a_scale(direction):
    """Across the shear smoothness decides, so that the likeness is not perfect."""
    y, x = np.indices((64, 72)) - 32.0
    truth = np.exp(-((x - 6) ** 2 + y**2) / 60)
    dy, dx = np.gradient(truth)
    length = math.hypot(*direction)
    flat = 1 + 0.2 * (direction[0] * dy + direction[1] * dx) / length
    found = phase_of_image(torch.from_numpy(flat), direction, None).numpy()
    assert np.corrcoef(found.ravel(), truth.ravel())[0, 1] > 0.97
    # twice the contrast is twice the phase
    double = phase_of_image(torch.from_numpy(2 * flat - 1), direction, None).numpy()
    assert float(np.ptp(double) / np.ptp(found)) == pytest.approx(2, rel=0.03)
    with pytest.raises(ValueError, match="length above 0"):
        phase_of_image(torch.from_numpy(flat), (0.0, 0.0), None)


def test_bad_input_is_one_line_and_exit_2(tmp_path, capsys):
    random = np.random.default_rng(0)
    write_stack(tmp_path / "noise.tif", random.normal(1000, 10, (2, 40, 40)).astype(np.uint16))
    (tmp_path / "done").mkdir()
    (tmp_path / "done" / "phase.json").write_text("{}")
    for words, message in (
        ((tmp_path / "none.tif", "--out", tmp_path / "out"), "no such file"),
        ((tmp_path / "noise.tif", "--out", tmp_path / "out"), "shows no direction of shear"),
        ((tmp_path / "noise.tif", "--out", tmp_path / "done"), "the folder has results; name another one, or replace"),
        ((tmp_path / "noise.tif", "--out", tmp_path / "out", "--plane", 3), "--plane 3 must be from 1 to 2"),
        ((tmp_path / "noise.tif", "--out", tmp_path / "out", "--setting", 2), "--setting 2 must be from 1 to 1"),
        ((tmp_path / "noise.tif", "--out", tmp_path / "out", "--shear-angle", "inf"), "must be a finite angle"),
    ):
        assert phase(*words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("no_pictures")
def test_the_measured_beads_are_round_and_alike(measured_file, tmp_path):
    assert phase(measured_file("dic_agar_beads.tiff"), "--out", tmp_path / "out") == 0
    said = facts(tmp_path / "out")
    assert abs(said["shear_axis_degrees"] - 142.7) < 2 * said["uncertainty_degrees"]
    found = read_stack(tmp_path / "out" / "phase.ome.tif").data[0, 0]
    # the large bead, left of the middle and below: its disc against the ring around it
    y, x = np.mgrid[: found.shape[0], : found.shape[1]]
    distance = np.hypot(y - 400, x - 198)
    inside, around = found[distance < 50], found[(distance > 90) & (distance < 120)]
    assert inside.mean() - around.mean() > 1.5 * found.std()
