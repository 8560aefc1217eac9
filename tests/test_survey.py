"""What a stack's images tell before anything is fitted."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from data_synthetic import Ellipsoid
from data_synthetic.recorder.faults import Faults
from data_synthetic.recorder.record import Finer, record
from data_synthetic.scenes.any_specimen import solid
from data_synthetic.scenes.fibre import Fibre
from recon.recording.survey.dark_counts import dark_counts
from recon.recording.survey.direction import shear_direction
from recon.recording.survey.focus import sharpest_plane, sharpness
from recon.recording.survey.odd_images import odd_images
from recon.recording.survey.survey import survey
from torchdic import Acquisition, Camera, Condenser, Grid, Microscope, Objective, Prism
from torchdic.files.format import Stack

SIDE = 96


def phase(angle, axes=(14.0, 6.0), centre=(0.0, 0.0)):
    """A smooth elongated phase, its long axis at this angle from +x toward +y."""
    y, x = np.indices((SIDE, SIDE)) - (SIDE - 1) / 2
    y, x = y - centre[0], x - centre[1]
    along, across = math.cos(angle) * x + math.sin(angle) * y, math.cos(angle) * y - math.sin(angle) * x
    return np.exp(-((along / axes[0]) ** 2) - (across / axes[1]) ** 2)


def sheared(specimen, degrees, contrast=0.3):
    """A weak DIC image: bright where the phase rises along the shear."""
    dy, dx = np.gradient(specimen)
    angle = math.radians(degrees)
    return 1 + contrast * (math.sin(angle) * dy + math.cos(angle) * dx)


def apart(found, degrees, turn=360):
    return abs((math.degrees(found.angle) - degrees + turn / 2) % turn - turn / 2)


# --- direction of shear -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("long_axis", [0, 30, 60, 90, 120, 150])
def test_an_elongated_specimen_does_not_turn_the_direction(long_axis):
    """40°, whichever way a specimen lies that is more than twice as long as wide, which turns the spectrum's power."""
    noise = np.random.default_rng(1).normal(0, 0.002, (SIDE, SIDE))
    found = shear_direction((sheared(phase(math.radians(long_axis)), 40) + noise)[None])
    assert found is not None
    assert found.signed
    assert apart(found, 40) < max(2.5 * math.degrees(found.uncertainty), 2)


@pytest.mark.parametrize("degrees", [10, 100, 190, 280])
def test_the_direction_points_to_where_a_rising_phase_is_bright(degrees):
    found = shear_direction(sheared(phase(0.4), degrees)[None])
    assert found is not None
    assert apart(found, degrees) < 2


def test_a_lower_index_turns_the_direction_round():
    found = shear_direction(sheared(-phase(0.4), 25)[None])
    assert found is not None
    assert apart(found, 205) < 2


def test_specimens_that_stand_apart_add_up():
    two = phase(0.2, (7, 4), (-24, -20)) + phase(1.9, (8, 4), (20, 22))
    found = shear_direction(sheared(two, 65)[None])
    assert found is not None
    assert found.specimens == 2
    assert apart(found, 65) < 2


def test_the_angle_is_that_of_lengths_and_not_of_pixels():
    """Pixels of 2 × 1 µm: a shear at 45° on the camera lies at 63° in the specimen."""
    found = shear_direction(sheared(phase(0.0, (9, 9)), 45)[None], (2.0, 1.0))
    assert found is not None
    assert apart(found, math.degrees(math.atan2(2, 1))) < 3


def test_noise_makes_the_direction_less_certain():
    clean = sheared(phase(0.4), 40)
    noise = np.random.default_rng(2).normal(0, 1, clean.shape)
    little, much = (shear_direction((clean + level * noise)[None]) for level in (0.001, 0.01))
    assert little is not None
    assert much is None or much.uncertainty > 1.5 * little.uncertainty


def test_a_crowded_field_shows_an_axis_without_a_sign():
    random = np.random.default_rng(3)
    crowd = sum(phase(0, (3, 3), random.uniform(-60, 60, 2)) * random.choice([-1, 1]) for _ in range(220))
    found = shear_direction(sheared(crowd, 40)[None])
    assert found is not None
    assert not found.signed
    assert apart(found, 40, 180) < 2 * math.degrees(found.uncertainty)
    assert found.uncertainty >= math.radians(20)


@pytest.mark.parametrize("image", [np.ones((64, 64)), np.random.default_rng(0).normal(1, 0.1, (64, 64))])
def test_an_image_without_specimen_shows_no_direction(image):
    assert shear_direction(image[None]) is None


def test_a_specimen_that_the_field_cuts_shows_none():
    assert shear_direction(sheared(phase(0.0, (200, 20), (40, 0)), 40)[None]) is None


# --- focus, noise -----------------------------------------------------------------------------------------------------


def test_the_sharpest_plane_is_the_one_that_is_least_blurred():
    random = np.random.default_rng(4)
    detail = ndimage.gaussian_filter(random.normal(size=(SIDE, SIDE)), 1.5)
    planes = [1 + ndimage.gaussian_filter(detail, 0.01 + abs(k - 5)) for k in range(9)]
    noisy = np.stack(planes)[None] + random.normal(0, 0.01, (1, 9, SIDE, SIDE))
    assert sharpest_plane(noisy) == 5
    assert sharpness(noisy).max() == 1


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 400.0), (2.0, 100.0)])
def test_gain_and_dark_counts_follow_from_noise_against_light(gain, offset):
    random = np.random.default_rng(5)
    electrons = np.broadcast_to(np.linspace(20, 1500, 400), (3, 300, 400))
    counts = np.round(gain * (random.poisson(electrons) + random.normal(0, 2, electrons.shape)) + offset)
    found = dark_counts(counts.astype(np.uint16))
    assert found is not None
    assert found.gain == pytest.approx(gain, rel=0.05)
    assert abs(found.offset - offset) < 3 * found.offset_error
    assert found.offset_error < 30 * gain


def test_noise_of_one_level_tells_no_gain():
    counts = np.random.default_rng(6).poisson(500, (2, 128, 128)).astype(np.uint16)
    assert dark_counts(counts) is None


# --- a recorded stack -------------------------------------------------------------------------------------------------

FIELD = Grid((8, 64, 72), (0.5, 0.15, 0.15))
CAMERA = Camera(photons=20000.0, read_noise=2.0, gain=1.0, offset=100.0, bits=16)


def recorded(specimen, degrees, bias=1.4, **faults):
    angle = math.radians(degrees)
    shear = (0.2 * math.sin(angle), 0.2 * math.cos(angle))
    microscope = Microscope(0.546, Objective(0.9), Condenser(0.6), CAMERA)
    acquisition = Acquisition([Prism(shear, bias), Prism(shear, -bias)], [-1.0, 0.0, 1.0])
    return record(specimen, FIELD, microscope, acquisition, Faults(**faults), Finer((1, 1, 1), 16, 18), 7)


@pytest.mark.parametrize(
    "specimen",
    [
        solid(Ellipsoid((1.2, 0.8, 2.4)), 0.03, 1.36),
        Fibre(0.5, 3.0, 0.03, 1.36, 1.2, (0.3, 0.2, -0.3)),
    ],
    ids=["cell", "fibre"],
)
def test_a_recorded_stack_gives_back_what_was_put_in(specimen):
    """Angles to three of their uncertainties and 6° at most, opposite signs of bias, levels to 3 %, tilts to 0.03."""
    recording = recorded(specimen, 40, tilt=(0.15, -0.1), flicker=0.02, hot=4, dead=2)
    found = survey(Stack(recording.data, (0.15, 0.15), 1.0, 16), 4.0)
    for setting, sign, brightness in zip(found.settings, (1, -1), recording.brightness.numpy(), strict=True):
        direction = setting.direction
        assert direction is not None
        assert direction.signed
        wrong = apart(direction, 40 if sign > 0 else 220)
        assert wrong < min(max(3 * math.degrees(direction.uncertainty), 3), 6)
        assert setting.tilt == pytest.approx((0.15, -0.1), abs=0.03)
        assert setting.level == pytest.approx(100 + 20000 * math.sin(0.7) ** 2, rel=0.03)
        assert setting.brightness == pytest.approx(brightness / brightness.mean(), abs=0.01)
        assert setting.noise == pytest.approx(float(recording.variance.mean().sqrt()), rel=0.05)
    assert np.array_equal(found.hot, recording.hot)
    assert np.array_equal(found.dead, recording.dead)
    assert found.saturated == 0


def test_saturated_pixels_are_counted():
    recording = recorded(solid(Ellipsoid((1.2, 0.8, 2.4)), 0.03, 1.36), 40)
    data = np.minimum(recording.data * (5000 / recording.data.max()), 4095).astype(np.uint16)
    expected = int((data == 4095).sum())
    assert 0 < expected < 0.1 * data.size
    assert survey(Stack(data, (0.15, 0.15), 1.0, 12), 4.0).saturated == expected


def test_floats_without_a_background_are_surveyed_too():
    image = sheared(phase(0.4), 40) - 1
    found = survey(Stack(image[None, None].astype(np.float32)), 4.0)
    direction = found.settings[0].direction
    assert direction is not None
    assert apart(direction, 40) < 3
    assert found.camera is None
    assert torch.isfinite(torch.tensor(found.settings[0].unevenness))


def test_a_dropped_frame_tells_no_gain_and_hides_none():
    light = np.linspace(200, 2000, 96)[None, None, :] * np.ones((4, 96, 1))
    images = np.round(np.random.default_rng(5).poisson(light) * 0.5 + 100).astype(np.uint16)
    found, dropped = dark_counts(images), dark_counts(np.concatenate([images, np.zeros_like(images[:1])]))
    assert found is not None
    assert dropped is not None
    assert dropped.gain == pytest.approx(found.gain, rel=1e-6)


def counts():
    """A stack of two settings and four planes, noise about 700 counts."""
    return np.random.default_rng(3).poisson(700, (2, 4, 24, 24)).astype(np.uint16)


def test_images_that_differ_are_not_odd():
    assert list(odd_images(Stack(counts(), source="a.tif"))) == []


def test_an_image_of_one_value_is_named_and_the_others_are_surveyed():
    """As of a frame that a camera dropped; not where a mask leaves it out."""
    data = counts()
    data[1, 2] = 0
    stack = Stack(data, source="a.tif")
    (line,) = odd_images(stack)
    assert line.startswith("prism 2, plane 3: all its pixels are 0, nothing is recorded in it")
    assert list(odd_images(stack, data > 0)) == []
    assert list(odd_images(Stack(np.zeros_like(data), source="a.tif"))) == []  # a setting of one value is refused
    found = survey(stack, 3.0)
    # of four planes with a dark one the median is the mean of the lower two of three, 0.4 deviations of 4 % too low
    assert all(setting.level == pytest.approx(700, rel=0.03) for setting in found.settings)


def test_copies_of_an_image_are_named():
    data = counts()
    data[1, 1] = data[0, 2]
    (line,) = odd_images(Stack(data, source="a.tif"), prism="setting")
    assert line.startswith("setting 1, plane 3 and setting 2, plane 2 are the same image, pixel by pixel: likely")
    data[1] = data[0]
    (line,) = odd_images(Stack(data, source="a.tif"))
    assert "prism 1, plane 1 and prism 2, plane 1 are the same image, pixel by pixel, and 3 further images have" in line
    assert list(odd_images(Stack(data.astype(np.float32), source="a.tif"))) == []  # of a model, which has no noise


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_parts_in_which_nothing_is_recorded_are_named(dtype):
    """As a program leaves them at the sides of images that it has shifted, and Zarr where a chunk is missing."""
    data = counts().astype(dtype)
    data[0, 1, :, :1] = data[1, 3, 8:16, 8:16] = 0
    (line,) = odd_images(Stack(data, source="a.tif"), prism="setting")
    following = int(data[0, 1, :, 1:].min())
    assert line.startswith(
        f"setting 1, plane 2: 24 neighbouring pixels are 0, and none is between that and {following}, "
    )
    assert "and 1 further images have such parts: nothing is recorded there" in line
    assert list(odd_images(Stack(data, source="a.tif"), data > 0)) == []


def test_dark_pixels_are_not_taken_for_parts_without_a_record():
    """Few dead ones; light that is dark here and there; few levels of grey; a dark edge of a model without noise."""
    data = counts()
    data[..., ::8, ::8] = 0
    dim = np.random.default_rng(4).poisson(np.linspace(0, 8, 24) ** 2 * np.ones((2, 4, 24, 1))).astype(np.uint16)
    model = np.full((1, 2, 24, 24), 0.5, np.float32)
    model[..., :4], model[..., 20:] = 0.1, 0.9
    few = (counts() // 60 - 7).astype(np.uint8) * 16
    few[..., :4, :4] = few.min()
    for images in (data, dim, few, model):
        assert list(odd_images(Stack(images, source="a.tif"))) == []


def test_clipped_pixels_are_named_where_no_bit_depth_tells_of_them():
    """Those at the camera's full scale are left out, and counted, elsewhere."""
    data = counts()
    (line,) = odd_images(Stack(np.minimum(data, 730), source="a.tif"))
    assert "of the pixels have the largest value, 730, and hardly any the next, 729: what was brighter" in line
    assert list(odd_images(Stack(np.minimum(data, 730), source="a.tif", full_scale=730))) == []
    assert list(odd_images(Stack(np.minimum(data, 730), source="a.tif"), data < 730)) == []
    assert list(odd_images(Stack(np.minimum(data, 800), source="a.tif"))) == []  # one pixel in 5000
