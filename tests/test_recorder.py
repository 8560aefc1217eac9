"""A recorder's stacks: mean and variance as told, every fault where it is said to be, and files that are read back."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from data_synthetic import Bead
from data_synthetic.recorder.drawn import drawn
from data_synthetic.recorder.faults import Faults
from data_synthetic.recorder.record import Finer, record
from data_synthetic.recorder.told import Mistakes, tell
from data_synthetic.recorder.writing import write_recording
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.files.stack import read_stack

FIELD = Grid((4, 20, 24), (0.5, 0.2, 0.2))
CAMERA = Camera(photons=900.0, read_noise=3.0, gain=1.7, offset=110.0, bits=16)
MICROSCOPE = Microscope(0.546, Objective(0.75), Condenser(0.5), CAMERA)
BEAD = Bead(0.7, 0.03, 1.36, (0.1, 0.2, -0.3))
PAIR = Acquisition([Prism((0.12, 0.2), 1.3), Prism((0.12, 0.2), -1.3)], [-0.6, 0.0, 0.6])
QUICK = Finer((1, 2, 2), 4, 8)


def recorded(specimen=BEAD, acquisition=PAIR, seed=0, finer=QUICK, camera=CAMERA, **faults):
    return record(specimen, FIELD, replace(MICROSCOPE, camera=camera), acquisition, Faults(**faults), finer, seed)


def noiseless(acquisition=PAIR):
    """The light without a camera's pixels, on the finer voxels that are inside the field."""
    grid = QUICK.grid(FIELD)
    volume = Volume(grid, BEAD.delta(grid, dtype=torch.float32), BEAD.background)
    fine = image(volume, replace(MICROSCOPE, camera=None), acquisition, Fidelity("wave", sources=8, order=2))
    return fine[..., 8:-8, 8:-8]


def test_counts_have_the_mean_and_the_variance_that_are_told():
    recording = recorded(tilt=(0.2, -0.1), vignette=0.3, flicker=0.02, hot=3, dead=1)
    standard = (torch.from_numpy(recording.data.astype(float)) - recording.mean) / (recording.variance + 1 / 12).sqrt()
    number = standard.numel()  # four standard deviations of a mean, and of a variance, of normal numbers
    assert abs(float(standard.mean())) < 4 / math.sqrt(number)
    assert abs(float(standard.var()) - 1) < 4 * math.sqrt(2 / number)


def test_the_mean_is_offset_and_gain_times_photons():
    nothing = recorded(Bead(0.7, 0.0, 1.36), Acquisition([Prism((0.0, 0.2), 1.1)]))
    empty = math.sin(0.55) ** 2
    torch.testing.assert_close(nothing.mean, torch.full_like(nothing.mean, 110 + 1.7 * 900 * empty), rtol=1e-5, atol=0)
    variance = 1.7**2 * (900 * empty + 3.0**2)
    torch.testing.assert_close(nothing.variance, torch.full_like(nothing.mean, variance), rtol=1e-5, atol=0)


def test_a_seed_gives_one_stack_and_another_seed_another():
    first, again, other = (recorded(seed=seed, flicker=0.02, hot=2) for seed in (3, 3, 4))
    assert np.array_equal(first.data, again.data)
    assert torch.equal(first.hot, again.hot)
    assert not np.array_equal(first.data, other.data)


def test_pixels_integrate_over_their_area():
    """The mean of a pixel's 2 × 2 finer values differs from the integral by the second order of their distance."""
    light, fine = recorded().light, noiseless().double()
    blocks = fine.unflatten(3, (24, 2)).unflatten(2, (20, 2))
    points = blocks[:, :, :, 0, :, 0]
    wrong = float((points - light).square().mean().sqrt())
    assert float((blocks.mean((3, 5)) - light).square().mean().sqrt()) < 0.06 * wrong


def test_truth_is_the_mean_over_each_voxel():
    expected = BEAD.delta(FIELD)  # a voxel's covered volume, by 4 × 4 columns; the finer ones have 8 × 8
    assert float((recorded().truth - expected).abs().max()) < 0.02 * BEAD.contrast
    assert float(recorded().truth.sum()) == pytest.approx(float(expected.sum()), rel=3e-3)


def test_a_volume_is_recorded_as_the_specimen_that_filled_it():
    grid = QUICK.grid(FIELD)
    volume = Volume(grid, BEAD.delta(grid, dtype=torch.float32), BEAD.background)
    first, second = recorded(volume), recorded()
    assert np.array_equal(first.data, second.data)
    assert torch.equal(first.truth, second.truth)


def test_the_lamp_tilts_and_falls_as_the_fourth_power_of_the_cosine():
    lamp = Faults(vignette=0.4).lamp((401, 401))
    corner, centre = float(lamp[0, 0]), float(lamp[200, 200])
    assert corner / centre == pytest.approx(math.cos(0.4) ** 4, rel=0.01)  # the last pixel is half of one within
    tilted = Faults(tilt=(0.2, -0.1)).lamp((50, 80))
    assert float(tilted.mean()) == pytest.approx(1)
    assert float(tilted[-1, 40] - tilted[0, 40]) == pytest.approx(0.2 * 49 / 50)
    assert float(tilted[25, -1] - tilted[25, 0]) == pytest.approx(-0.1 * 79 / 80)


def test_the_lamp_and_the_flicker_multiply_the_light():
    plain, faulty = recorded(), recorded(tilt=(0.3, 0.0), flicker=0.05)
    assert float(faulty.brightness.std()) > 0.01
    expected = plain.light * faulty.lamp * faulty.brightness[..., None, None]
    torch.testing.assert_close(faulty.light, expected)


def test_drift_moves_the_specimen_and_not_the_lamp():
    """By whole pixels, so that planes of one focus repeat each other, moved; the middle one stands as without drift."""
    still = Acquisition(PAIR.prisms, [0.0, 0.0, 0.0])
    moved = recorded(acquisition=still, drift=(0.2, -0.4), tilt=(0.2, 0.0))
    specimen = moved.light / moved.lamp
    torch.testing.assert_close(specimen[:, 1], recorded(acquisition=still).light[:, 1])
    torch.testing.assert_close(specimen[:, 2, 1:, :-2], specimen[:, 1, :-1, 2:], atol=1e-6, rtol=0)
    torch.testing.assert_close(specimen[:, 0, :-1, 2:], specimen[:, 1, 1:, :-2], atol=1e-6, rtol=0)
    assert moved.shifts.tolist() == [[-0.2, 0.4], [0.0, 0.0], [0.2, -0.4]]


def test_hot_and_dead_pixels_are_where_they_are_said_to_be():
    plain, faulty = recorded(), recorded(hot=4, dead=3, dark_current=0.8)
    assert (int(faulty.hot.sum()), int(faulty.dead.sum())) == (4, 3)
    above = faulty.light - plain.light
    assert bool((above[..., faulty.hot] >= 0.2 * 0.8).all())
    assert bool((above[..., faulty.hot] <= 0.8).all())
    assert float(faulty.light[..., faulty.dead].abs().max()) == 0
    sound = ~(faulty.hot | faulty.dead)
    torch.testing.assert_close(faulty.light[..., sound], plain.light[..., sound])


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_a_camera_of_few_bits_is_saturated_at_its_largest_count(bits, dtype):
    gain = 3 * 2**bits / 900  # three empty bright fields' worth of range in one
    data = recorded(camera=Camera(photons=900.0, gain=gain, offset=2.0, bits=bits)).data
    assert data.dtype == dtype
    assert data.max() == 2**bits - 1


@pytest.mark.parametrize("kind", ["ome", "imagej", "tiff"])
def test_a_written_recording_is_read_back(tmp_path, kind):
    recording = recorded()
    stack = read_stack(write_recording(recording, tmp_path / "stack.tif", kind, immersion=1.0))
    assert np.array_equal(stack.data, recording.data)
    if kind != "tiff":
        assert stack.pixel_size == pytest.approx((0.2, 0.2), rel=1e-5)
        assert stack.focus_step == pytest.approx(0.6)
    else:
        assert stack.pixel_size is None


def test_the_bits_of_a_camera_are_in_its_file(tmp_path):
    recording = recorded(camera=replace(CAMERA, bits=12, gain=0.5))
    assert read_stack(write_recording(recording, tmp_path / "stack.ome.tif")).bits == 12


def test_planes_written_one_by_one_are_read_in_their_order(tmp_path):
    recording = recorded(acquisition=Acquisition(PAIR.prisms[:1], PAIR.focus))
    stack = read_stack(write_recording(recording, tmp_path / "pages.tif", "pages"))
    assert np.array_equal(stack.data, recording.data)
    with pytest.raises(ValueError, match="one prism, the recording has 2"):
        write_recording(recorded(), tmp_path / "two.tif", "pages")


@pytest.mark.parametrize("kind", ["folder", "micro-manager"])
def test_a_folder_holds_a_file_for_each_plane(tmp_path, kind):
    recording = recorded()
    folder = write_recording(recording, tmp_path / "planes", kind)
    files = sorted(folder.glob("*.tif"))
    assert np.array_equal([tifffile.imread(file) for file in files], recording.data.reshape(6, 20, 24))


def test_what_is_told_without_mistakes_is_the_truth():
    told = tell(recorded())
    assert told.shears == ((0.12, 0.2), (0.12, 0.2))
    assert told.biases == (1.3, -1.3)
    assert (told.focus, told.na, told.condenser_na) == ((-0.6, 0.0, 0.6), 0.75, 0.5)
    assert (told.background, told.wavelength, told.pixel_size) == (1.36, 0.546, 0.2)


def test_mistakes_are_those_that_are_named():
    turn = math.radians(10)
    told = tell(recorded(), Mistakes(0.1, 0.9, turn, reversed_shear=True, reversed_focus=True))
    (y, x), length = told.shears[0], math.hypot(0.12, 0.2)
    assert math.hypot(y, x) == pytest.approx(0.9 * length)
    axis = math.atan2(0.12, 0.2) + turn + math.pi
    assert (y, x) == pytest.approx((0.9 * length * math.sin(axis), 0.9 * length * math.cos(axis)))
    assert told.biases == pytest.approx((1.4, -1.4))
    assert told.focus == (0.6, 0.0, -0.6)


def test_a_drawn_recording_is_the_same_for_the_same_seed():
    first, again, other = (drawn(seed, pixels=32, finer=Finer((1, 1, 1), 24, 2)) for seed in (5, 5, 6))
    assert np.array_equal(first.recording.data, again.recording.data)
    assert first.told == again.told
    assert first.told != other.told


def test_drawn_users_are_off_by_no_more_than_is_said():
    for seed in range(6):
        mistakes = drawn(seed, pixels=32, finer=Finer((1, 1, 1), 24, 2)).told.mistakes
        assert abs(mistakes.bias) <= math.radians(10)
        assert abs(mistakes.turn) <= math.radians(10)
        assert 0.85 <= mistakes.length <= 1.15


REFUSALS = {
    "a camera with photons and bits": lambda: recorded(camera=Camera(photons=100.0)),
    "pixels are square": lambda: record(BEAD, Grid((4, 20, 24), (0.5, 0.2, 0.3)), MICROSCOPE, PAIR),
    "camera's pixels have 0.3 µm, the field's 0.2": lambda: recorded(camera=replace(CAMERA, pixel_size=0.3)),
    "no whole parts": lambda: recorded(Volume(Grid((4, 21, 24), (0.5, 0.2, 0.2)), torch.zeros(4, 21, 24), 1.36)),
    "vignette 2": lambda: Faults(vignette=2.0),
    "tilt": lambda: Faults(tilt=(1.5, 0.5)),
    "flicker": lambda: Faults(flicker=-0.1),
    "hot -1": lambda: Faults(hot=-1),
    "dark_current 0": lambda: Faults(dark_current=0.0),
    "drift": lambda: Faults(drift=(math.nan, 0.0)),
    "no room": lambda: recorded(hot=400),
    "parts 0": lambda: Finer(parts=(0, 1, 1)),
    "kind 'avi'": lambda: write_recording(recorded(), Path("x"), "avi"),
    "takes 32": lambda: drawn(0, pixels=24),
    "bright field": lambda: tell(recorded(acquisition=Acquisition([None]))),
}


@pytest.mark.parametrize("words", REFUSALS)
def test_what_cannot_be_recorded_is_refused_in_words(words):
    with pytest.raises(ValueError, match=words):
        REFUSALS[words]()
