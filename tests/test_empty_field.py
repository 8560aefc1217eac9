"""A stack divided by an image of the empty field: what the lamp, dust and unequal pixels did to it is undone."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
from refusal import the_error

from recon.config import load
from recon.recording.empty_field import empty_field
from recon.recording.preparation import ExpectedStack, Normalisation, prepare
from recon.run.data import load_data
from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack
from torchdic.files.stack import write_stack

ROWS, COLUMNS, PLANES, OFFSET, LEVEL = 48, 52, 5, 100.0, 20000.0
BIASES = (math.pi / 2, -math.pi / 3)
EMPTY = np.array([math.sin(bias / 2) ** 2 for bias in BIASES])
EXPECTED = ExpectedStack(BIASES, tuple(map(float, range(PLANES))), (0.1, 0.1))


@pytest.fixture
def random():
    return np.random.default_rng(3)


@pytest.fixture
def shape(random):
    """What lamp, dust and pixels do to the light: a tilt, a vignette, a dark speck and 1 % from pixel to pixel."""
    y, x = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLUMNS * 1j]
    speck = 1 - 0.3 * np.exp(-((y - 0.4) ** 2 + (x + 0.2) ** 2) / 0.01)
    shape = (1 + 0.2 * y - 0.1 * x - 0.15 * (x**2 + y**2)) * speck * (1 + 0.01 * random.normal(size=(ROWS, COLUMNS)))
    return shape / shape.mean()


@pytest.fixture
def truth():
    """Images relative to the empty bright field: a relief that changes with focus."""
    y, x = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLUMNS * 1j]
    planes = [0.2 * x * np.exp(-(y**2 + x**2) / (0.1 + 0.02 * plane)) for plane in range(PLANES)]
    return EMPTY[:, None, None, None] * (1 + np.stack(planes)[None])


def counted(light, shape, random=None, offset=OFFSET, level=LEVEL):
    """Counts of a camera. random: of shot noise of 0.1 electrons a count."""
    signal = level * shape * light
    if random is not None:
        signal = random.poisson(0.1 * signal) / 0.1
    return Stack((offset + signal).round().astype(np.uint16), source="stack.tif")


def field_of(shape, frames=2, random=None, level=LEVEL):
    return counted(np.broadcast_to(EMPTY[:, None, None, None], (2, frames, 1, 1)), shape, random, level=level)


def divided(stack, empty, normalisation=None):
    field = empty_field(empty, stack, OFFSET)
    return prepare(stack, EXPECTED, normalisation or Normalisation(offset=OFFSET), empty_field=field)


def test_lamp_dust_and_pixels_are_divided_out(truth, shape):
    measured = divided(counted(truth, shape), field_of(shape))
    # rounding to counts is 1/LEVEL of the bright field
    assert measured.data == pytest.approx(truth, abs=3e-4)
    polynomial = prepare(counted(truth, shape), EXPECTED, Normalisation(offset=OFFSET)).data
    assert np.abs(polynomial - truth).max() > 0.1


def test_the_empty_field_gives_the_level_where_the_specimen_leaves_no_background(truth, shape):
    bright = 1.1 * truth  # as a specimen that fills the field
    measured = divided(counted(bright, shape), field_of(shape))
    assert measured.data == pytest.approx(bright, abs=3e-4)
    assert [report.scale for report in measured.prisms] == pytest.approx([LEVEL] * 2, rel=1e-3)


def test_floats_in_any_unit_are_divided_and_scaled_too(truth, shape):
    stack = Stack((3.7 * shape * truth).astype(np.float32))
    empty = Stack((3.7 * shape * np.broadcast_to(EMPTY[:, None, None, None], (2, 2, 1, 1))).astype(np.float32))
    measured = prepare(stack, EXPECTED, empty_field=empty_field(empty, stack))
    assert measured.data == pytest.approx(truth, abs=1e-5)


def test_a_given_scale_stays(truth, shape):
    measured = divided(counted(truth, shape), field_of(shape), Normalisation(scale=2 * LEVEL, offset=OFFSET))
    assert measured.data == pytest.approx(truth / 2, abs=3e-4)


def test_one_image_serves_all_prisms_by_its_shape(truth, shape):
    single = Stack(field_of(shape, 3).data[:1], source="empty.tif")
    with pytest.warns(StackWarning, match="prism 2's background is 500.*the empty field gives"):
        measured = divided(counted(truth, shape), single)
    assert measured.data == pytest.approx(truth, abs=2e-3)


def test_another_exposure_is_told_and_the_stack_gives_the_level(truth, shape):
    with pytest.warns(StackWarning, match="another exposure, lamp or bias; the empty field gives the shape alone"):
        measured = divided(counted(truth, shape), field_of(shape, level=LEVEL / 3))
    assert measured.data == pytest.approx(truth, rel=5e-3, abs=1e-3)


def test_one_noisy_frame_is_smoothed_until_it_adds_little_noise(truth, shape, random):
    smooth = np.ones_like(shape)
    stack, empty = counted(truth, smooth, random), field_of(smooth, 1, random)
    measured = divided(stack, empty)
    own = [report.noise for report in measured.prisms]
    alone = [report.noise for report in prepare(stack, EXPECTED, Normalisation(offset=OFFSET)).prisms]
    assert own == pytest.approx(np.array(alone) * math.hypot(1, 0.2), rel=0.02)
    shared = np.std((measured.data - truth).mean(1), axis=(1, 2))
    # of the frame's noise a fifth is left, beside the mean's own: 1/√5 of a plane's
    assert shared == pytest.approx(np.array(alone) * math.hypot(0.2, PLANES**-0.5), rel=0.15)


def test_of_many_frames_the_pattern_of_the_pixels_is_kept(truth, shape, random):
    stack, empty = counted(truth, shape), field_of(shape, 12, random)
    field = empty_field(empty, stack, OFFSET)
    # unequal pixels of 1 % beside noise of 3 % over √12
    assert field.pattern[0] == pytest.approx(0.01**2 / (0.01**2 + 0.0316**2 / 12), abs=0.1)
    without = replace(field, pattern=(0.0, 0.0))
    kept, smoothed = (np.std(each.quiet(0, 0.02)[0] / (LEVEL * EMPTY[0] * shape) - 1) for each in (field, without))
    assert kept < 0.97 * smoothed
    assert kept < 0.009


def test_noise_that_smoothing_leaves_is_counted(truth, random):
    smooth = np.ones((ROWS, COLUMNS))
    field = empty_field(field_of(smooth, 1, random), counted(truth, smooth), OFFSET)
    image, left = field.quiet(0, 1e-6)
    assert 0 < left < 0.1 * field.noise[0]
    assert np.std(image[8:-8, 8:-8]) == pytest.approx(left, rel=0.3)


def test_dead_hot_and_saturated_pixels_are_bad(truth, shape):
    empty = field_of(shape)
    empty.data[:, :, 10, 11] = OFFSET
    empty.data[:, :, 20, 21] = 60000
    empty.data[1, 0, 30, 31] = 65535
    stack = counted(truth, shape)
    field = empty_field(empty, stack, OFFSET, ratio=5.0)
    assert sorted(map(tuple, np.argwhere(field.bad))) == [(10, 11), (20, 21), (30, 31)]
    assert np.isfinite(field.images).all()
    assert field.images.min() > 0
    assert empty_field(field_of(shape), stack, OFFSET, ratio=5.0).bad is None


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.full((1, 1, ROWS, COLUMNS - 1), 900), "empty.tif has 48 × 51 pixels (y × x), stack.tif 48 × 52"),
        (np.full((3, 1, ROWS, COLUMNS), 900), "empty.tif has 3 channels: an empty field has one, or one for each of 2"),
        (np.full((1, 1, ROWS, COLUMNS), 90), "the empty field of prism 1 minus the offset 100 is -10: it must be"),
        (np.full((1, 1, ROWS, COLUMNS), 65535), "100% of the empty field are dark, hot or saturated"),
    ],
)
def test_what_is_no_empty_field_is_refused(truth, shape, data, message):
    with pytest.raises(StackError) as caught:
        empty_field(Stack(data.astype(np.uint16), source="empty.tif"), counted(truth, shape), OFFSET)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- in a configuration -----------------------------------------------------------------------------------------------


@pytest.fixture
def config(tmp_path):
    def write(**data):
        values = {
            "volume": {"shape": [4, ROWS, COLUMNS], "spacing": [0.5, 0.1, 0.1], "background": 1.335},
            "microscope": {"wavelength": 0.546, "objective": {"na": 0.9}, "condenser": {"na": 0.7}},
            "acquisition": {
                "focus": {"first": 0, "step": 1, "count": PLANES},
                "prisms": [{"shear": [0.0, 0.2], "bias": bias} for bias in BIASES],
            },
            "data": {"path": "stack.ome.tif", "offset": OFFSET, **data},
        }
        path = tmp_path / "config.toml"
        path.write_text(tomli_w.dumps(values), encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize(
    "of", [lambda frames: frames[:, 0], lambda frames: frames, lambda frames: frames[:1, :1]], ids=["pyx", "as", "yx"]
)
@pytest.mark.filterwarnings("ignore:.*another exposure")
def test_a_configurations_empty_field_divides_its_stack(config, tmp_path, truth, shape, of):
    stack = counted(truth, shape)
    stack.data[:, :, 20, 20] = 65000
    frames = field_of(shape, PLANES).data
    frames[:, :, 10, 11] = OFFSET
    write_stack(tmp_path / "stack.ome.tif", stack.data)
    write_stack(tmp_path / "empty.tif", of(frames))
    measured = load_data(load(config(empty="empty.tif")))
    assert measured.left_out.stuck == 2
    assert measured.left_out.counted is not None
    off = np.abs(measured.data / truth - 1)[measured.left_out.counted]
    assert np.quantile(off, 0.99) < 0.04  # one frame is smoothed: unequal pixels of 1 % stay


def test_a_missing_empty_field_is_named(config, tmp_path, truth, shape):
    write_stack(tmp_path / "stack.ome.tif", counted(truth, shape).data)
    with pytest.raises(StackError, match=r"empty\.tif: no such file"):
        load_data(load(config(empty="empty.tif")))


def test_an_empty_field_that_must_not_divide_is_refused(config):
    assert the_error(config(empty="empty.tif", flatten=False)) == (
        "data: empty divides the images, flatten = false says not to: leave one out"
    )
