import math
import warnings

import numpy as np
import pytest
from scipy import ndimage

from recon.recording.background import background_surface, noise_level
from recon.recording.preparation import ExpectedStack, Normalisation, check_counts, prepare
from recon.recording.shear_axis import estimate_shear_axis
from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack
from torchdic.files.stack import read_stack, write_stack

RIGHT = math.pi / 2


def blobs(shape, angle, seed, count=60):
    """∂φ/∂s along the angle (from +x toward +y) of random round blobs, peak about 1."""
    rng = np.random.default_rng(seed)
    y, x = np.indices(shape, dtype=float)
    image = np.zeros(shape)
    for _ in range(count):
        cy, cx = rng.uniform(0, shape[0]), rng.uniform(0, shape[1])
        radius, weight = rng.uniform(3, 9), rng.uniform(-1, 1)
        along = math.cos(angle) * (x - cx) + math.sin(angle) * (y - cy)
        image -= weight * along / radius * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * radius**2))
    return image


def tilted(shape, order=2):
    """A lit field about 1, uneven by some tens of percent, of the given order."""
    y, x = (np.linspace(-1, 1, n) for n in shape)
    surface = 1 + 0.15 * y[:, None] - 0.1 * x
    return surface - 0.08 * y[:, None] * x + 0.05 * x**2 if order > 1 else surface


def counts(bias=RIGHT, shape=(96, 120), planes=3, brightness=8000.0, dark=100.0):
    """A camera's (focus, y, x) of blobs that go out of focus, with its truth in the model's unit."""
    empty = 1.0 if bias is None else math.sin(bias / 2) ** 2
    specimen = blobs(shape, 0.3, 1, count=15)
    truth = empty * (1 + 0.3 * np.stack([ndimage.gaussian_filter(specimen, 2 * p) for p in range(planes)]))
    return np.round(brightness * tilted(shape) * truth + dark).astype(np.uint16), truth


def prepared(stack, biases, focus, pixel_size=None, *, pixels=None, empty=None, **normalisation):
    """The stack in the model's unit, prepared for prisms of these biases and these focus planes."""
    empty = None if empty is None else tuple(empty)
    expected = ExpectedStack(tuple(biases), tuple(focus), pixel_size, pixels, empty)
    return prepare(stack, expected, Normalisation(**normalisation))


# counts and sizes


def test_prisms_and_planes_must_be_as_many_as_the_acquisition_says():
    stack = Stack(np.ones((3, 5, 4, 4), np.float32), source="stack.tif")
    with pytest.raises(StackError) as caught:
        prepared(stack, [1.0, -1.0], range(9), (0.1, 0.1))
    assert (
        str(caught.value) == "stack.tif holds 3 prisms × 5 planes, acquisition.prisms and acquisition.focus say 2 × 9"
    )
    with pytest.raises(StackError, match=r"1 prism × 1 plane, acquisition\.prisms and acquisition\.focus say 1 × 2"):
        prepared(Stack(np.ones((1, 1, 4, 4), np.float32)), [None], [0.0, 1.0], (0.1, 0.1))


def test_pixels_must_be_as_many_as_the_volumes():
    stack = Stack(np.ones((1, 1, 4, 6), np.float32), source="stack.tif")
    with pytest.raises(
        StackError, match=r"stack\.tif has 4 × 6 pixels \(y × x\), the volume 6 × 4; let volume\.shape end in 4, 6, or"
    ):
        prepared(stack, [None], [0.0], (0.1, 0.1), pixels=(6, 4))
    assert prepared(stack, [None], [0.0], (0.1, 0.1), pixels=(4, 6)).data.shape == (1, 1, 4, 6)


@pytest.mark.parametrize(
    ("field", "advice"),
    [
        ((1.6, 2.4), "must be 1.2 × 1.8 µm (y × x), or microscope.camera.pixel_size 0.4 in the specimen"),
        ((1.6, 1.6), "must be 1.2 × 1.8 µm (y × x)"),
    ],
    ids=["one pixel size fits", "none fits"],
)
def test_a_camera_whose_pixels_do_not_fill_the_volume_is_told_what_would(field, advice):
    expected = ExpectedStack((1.5,), (0.0,), (0.3, 0.3), tuple(int(side / 0.3) for side in field), field=field)
    with pytest.raises(StackError) as caught:
        check_counts(Stack(np.ones((1, 1, 4, 6)), source="stack.tif"), expected)
    assert str(caught.value).endswith(f"volume.shape × volume.spacing {advice}")


@pytest.mark.parametrize(("shape", "planes"), [((8, 6), 1), ((3, 8, 6), 3)])
def test_a_single_image_is_a_stack_of_one_plane(tmp_path, shape, planes):
    write_stack(tmp_path / "image.ome.tif", np.full(shape, 0.5, np.float32))
    ready = prepared(read_stack(tmp_path / "image.ome.tif"), [RIGHT], range(planes), (0.1, 0.1))
    assert ready.data.shape == (1, planes, 8, 6)
    assert ready.focus == tuple(range(planes))


def test_the_configs_pixel_size_wins_and_a_difference_is_warned_of():
    stack = Stack(np.ones((1, 1, 4, 4), np.float32), pixel_size=(0.11, 0.12), source="stack.tif")
    with pytest.warns(StackWarning) as caught:
        assert prepared(stack, [None], [0.0], (0.2, 0.12)).pixel_size == (0.2, 0.12)
    (warning,) = caught
    assert "0.11 × 0.12 µm" in str(warning.message)
    assert "0.2 × 0.12 µm" in str(warning.message)
    assert prepared(stack, [None], [0.0], (0.1108, 0.1195)).pixel_size == (0.1108, 0.1195)  # within 1 %
    assert prepared(stack, [None], [0.0]).pixel_size == (0.11, 0.12)


def test_a_pixel_size_must_come_from_somewhere():
    with pytest.raises(StackError, match="neither the file nor the config"):
        prepared(Stack(np.ones((1, 1, 4, 4), np.float32)), [None], [0.0])


@pytest.mark.parametrize("focus", [(-0.5, 0.0, 0.5), (0.5, 0.0, -0.5), (1.0, 1.502, 2.0)])
def test_a_focus_step_that_agrees_is_not_mentioned(focus):
    prepared(Stack(np.ones((1, 3, 4, 4), np.float32), focus_step=0.5), [None], focus, (0.1, 0.1))


@pytest.mark.parametrize(("focus", "said"), [((-0.4, 0.0, 0.4), "0.4 µm"), ((0.0, 0.5, 1.5), "0.5 to 1 µm")])
def test_a_focus_step_that_differs_is_warned_of(focus, said):
    stack = Stack(np.ones((1, 3, 4, 4), np.float32), focus_step=0.5, source="stack.tif")
    with pytest.warns(StackWarning, match=rf"stack\.tif: its focus step is 0\.5 µm, the config's {said}"):
        assert prepared(stack, [None], focus, (0.1, 0.1)).focus == focus


def test_a_focus_step_means_nothing_to_one_plane():
    prepared(Stack(np.ones((1, 1, 4, 4), np.float32), focus_step=0.5), [None], [3.0], (0.1, 0.1))


# the model's unit


def test_floats_are_left_alone():
    data = np.random.default_rng(0).uniform(0.6, 1.4, (2, 3, 8, 6)) * tilted((8, 6))
    ready = prepared(Stack(data), [0.0, None], range(3), (0.1, 0.1))
    assert ready.data.dtype == np.float32
    assert np.array_equal(ready.data, data.astype(np.float32))
    assert [report.scale for report in ready.prisms] == [1.0, 1.0]
    assert [report.unevenness for report in ready.prisms] == [0.0, 0.0]


def test_floats_that_look_like_counts_are_warned_of():
    stack = Stack(np.full((1, 1, 8, 6), 1234.0), source="stack.tif")
    with pytest.warns(StackWarning, match=r"stack\.tif: prism 1's background is 1234, not 0\.5"):
        prepared(stack, [RIGHT], [0.0], (0.1, 0.1))
    assert prepared(stack, [RIGHT], [0.0], (0.1, 0.1), scale=2468.0).data == pytest.approx(0.5)
    assert prepared(stack, [RIGHT], [0.0], (0.1, 0.1), scale="background").data == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("change", "found"),
    [(lambda s: 2 * s, "1"), (lambda s: s - 0.5, "0"), (lambda s: s / 16, "0.03125"), (lambda s: 1.3 * s, "0.65")],
)
def test_floats_of_another_background_than_the_models_are_warned_of_both_ways(change, found):
    """A flat field divided out, a background subtracted, counts as parts of a camera's full scale."""
    data = np.full((1, 3, 12, 16), 0.5)
    data[0, 1, 4:7, 5:9] = 0.8
    stack = Stack(change(data), source="stack.tif")
    said = rf"stack\.tif: prism 1's background is {found}, not 0\.5 as the model's.*data\.scale = 'background'"
    with pytest.warns(StackWarning, match=said):
        prepared(stack, [RIGHT], range(3), (0.1, 0.1))
    back = 0.0 if change(0.5) > 0 else -0.5
    ready = prepared(stack, [RIGHT], range(3), (0.1, 0.1), scale="background", offset=back)
    assert ready.data[0] == pytest.approx(data[0], rel=1e-6)


@pytest.mark.parametrize("bias", [math.radians(80), math.radians(100)])
def test_floats_of_a_bias_that_is_a_little_off_are_not_warned_of(bias):
    prepared(Stack(np.full((1, 1, 12, 16), 0.5)), [bias], [0.0], (0.1, 0.1))


def test_flicker_is_that_of_the_images_medians():
    camera, _ = counts(planes=4)
    lamp = np.array([1.0, 1.1, 0.9, 1.0])
    data = ((camera - 100.0) * lamp[:, None, None])[None]
    ready = prepared(Stack(data), [RIGHT], range(4), (0.1, 0.1), scale="background")
    assert ready.prisms[0].flicker == pytest.approx(np.std(lamp), abs=0.004)
    dark = prepared(Stack(np.full((1, 2, 8, 8), -1.0)), [0.0], range(2), (0.1, 0.1))
    assert dark.prisms[0].flicker is None


@pytest.mark.parametrize("bias", [None, math.pi, RIGHT, -RIGHT, 0.5])
def test_an_empty_field_of_counts_becomes_sin2_half_bias(bias):
    empty = np.round(30000 * tilted((40, 60)) + 100).astype(np.uint16)[None, None]
    ready = prepared(Stack(empty), [bias], [0.0], (0.1, 0.1), offset=100)
    expected = 1.0 if bias is None else math.sin(bias / 2) ** 2
    rounding = 0.5 / (30000 * tilted((40, 60)).min())
    assert np.abs(ready.data / expected - 1).max() < 2 * rounding  # of the pixel itself, and of the fit
    (report,) = ready.prisms
    assert report.bias == bias
    assert report.scale * expected == pytest.approx(report.background)
    assert report.unevenness == pytest.approx(np.ptp(tilted((40, 60))) / tilted((40, 60)).mean(), rel=1e-4)


@pytest.mark.parametrize("bias", [None, RIGHT, -RIGHT, 2.5])
def test_counts_of_a_specimen_come_back_in_the_models_unit(bias):
    camera, truth = counts(bias)
    ready = prepared(Stack(camera[None]), [bias], range(3), (0.1, 0.1), offset=100)
    # the specimen fills half of the field; where it meets the border it bends the background by a few percent
    empty = np.median(truth)
    assert np.abs(ready.data[0] - truth).max() < 0.03 * empty
    assert np.sqrt(np.mean((ready.data[0] - truth) ** 2)) < 0.01 * empty


def test_each_prism_is_scaled_by_its_own_background():
    first, truth_first = counts(RIGHT, brightness=8000)
    second, truth_second = counts(math.pi, brightness=2000)
    ready = prepared(Stack(np.stack([first, second])), [RIGHT, math.pi], range(3), (0.1, 0.1), offset=100)
    assert np.abs(ready.data[0] - truth_first).max() < 0.03 * 0.5
    assert np.abs(ready.data[1] - truth_second).max() < 0.03
    assert ready.prisms[0].scale / ready.prisms[1].scale == pytest.approx(4, rel=1e-3)


def test_flattening_takes_out_the_tilt_and_leaves_the_specimen():
    camera, truth = counts()
    stack = Stack(camera[None])
    flat = prepared(stack, [RIGHT], range(3), (0.1, 0.1), offset=100).data[0]
    tilt = prepared(stack, [RIGHT], range(3), (0.1, 0.1), offset=100, flatten=False).data[0]
    assert np.abs(flat - truth).max() < 0.1 * np.abs(tilt - truth).max()


@pytest.mark.parametrize(("steep", "within"), [(1.0, 0.01), (1.4, 0.03)])
@pytest.mark.parametrize("centre", [0.0, 0.3])
def test_a_vignette_of_cos4_is_followed_and_stays_above_zero(steep, within, centre):
    """It falls to 0.18 and 0.08 at a corner, where a polynomial of the same order falls below 0."""
    y, x = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-1, 1, 96), indexing="ij")
    lit = 1000 * (1 + (y**2 + (x - centre) ** 2) * steep**2 / 2) ** -2.0
    seen = lit.copy()
    seen[30:55, 40:70] *= 1 + 0.4 * np.sign(np.arange(30) - 15)  # a specimen
    found = background_surface(np.random.default_rng(0).poisson(seen).astype(float))
    assert found.min() > 0
    inside = lit > 0.25 * lit.max()
    assert np.abs(lit / found - 1)[inside].max() < 5 * within
    assert np.std(lit / found) < within


def test_a_given_scale_keeps_the_measured_background():
    stack = Stack(np.full((1, 1, 8, 6), 400, np.uint16))
    ready = prepared(stack, [RIGHT], [0.0], (0.1, 0.1), scale=1000, offset=100)
    assert ready.data == pytest.approx(0.3)
    assert ready.prisms[0].background == pytest.approx(300)


@pytest.mark.parametrize("bias", [0.0, 2 * math.pi, 0.05])
def test_counts_at_extinction_need_a_scale(bias):
    stray = np.round(40 * tilted((32, 48)) + 100)
    light = np.zeros((32, 48))
    light[10:14, 20:25] = 500
    stack = Stack((stray + light).astype(np.uint16)[None, None], source="stack.tif")
    with pytest.raises(StackError, match=r"stack\.tif: prism 1 .*too dark to scale by; give scale"):
        prepared(stack, [bias], [0.0], (0.1, 0.1))
    ready = prepared(stack, [bias], [0.0], (0.1, 0.1), scale=1000, offset=100)
    # stray light is additive: subtracted, so that the specimen's own light stays what it was, on the model's background
    empty = math.sin(bias / 2) ** 2
    assert np.abs(ready.data[0, 0] - empty - light / 1000).max() < 1.0 / 1000  # rounding and the fit of it, in counts
    leaking = prepared(stack, [bias], [0.0], (0.1, 0.1), scale=1000, offset=100, empty=[8e-4])
    assert leaking.data - ready.data == pytest.approx(8e-4 - empty, abs=1e-7)


def test_a_background_must_be_above_the_offset():
    camera, _ = counts(dark=100)
    with pytest.raises(StackError, match=r"offset 5000 falls to -.*above 0"):
        prepared(Stack(camera[None]), [RIGHT], range(3), (0.1, 0.1), offset=5000)


@pytest.mark.parametrize(
    ("option", "law"),
    [
        ({"scale": 0.0}, "above 0"),
        ({"scale": math.nan}, "above 0"),
        ({"scale": "auto"}, "'auto'"),
        ({"offset": math.inf}, "finite"),
        ({"order": -1}, "at least 0"),
    ],
)
def test_options_that_mean_nothing_are_refused(option, law):
    with pytest.raises(StackError, match=law):
        prepared(Stack(np.ones((1, 1, 8, 8), np.uint8)), [None], [0.0], (0.1, 0.1), **option)


@pytest.mark.parametrize(("dtype", "bits", "top"), [("uint8", None, 255), ("uint16", 12, 4095), ("int16", 16, 32767)])
def test_saturated_pixels_are_counted(dtype, bits, top):
    data = np.full((1, 1, 20, 20), top // 2, dtype)
    data[0, 0, 0, :4] = top
    quiet = Stack(data.copy(), bits=bits)
    prepared(quiet, [None], [0.0], (0.1, 0.1))  # 1 % is no more than 1 %
    data[0, 0, 0, :8] = top
    with pytest.warns(StackWarning, match=rf"8 of 400 pixels \(2\.0%\) are saturated at {top}"):
        prepared(Stack(data, bits=bits), [None], [0.0], (0.1, 0.1))


# background and noise


@pytest.mark.parametrize("shape", [(40, 60), (301, 260), (7, 5)])
@pytest.mark.parametrize("order", [1, 2])
def test_a_polynomial_is_its_own_background(shape, order):
    surface = 1e4 * tilted(shape, order)
    # block means of a parabola lie above it by (block² − 1)/12 of its curvature: 3 pixels of 300
    assert np.abs(background_surface(surface, 2) - surface).max() < 1e4 * 1e-4


@pytest.mark.parametrize("sign", [1, -1])
def test_the_background_passes_by_a_specimen_that_is_only_brighter_or_darker(sign):
    truth = 100 * tilted((128, 160))
    truth_noisy = truth + np.random.default_rng(0).normal(0, 1, truth.shape)
    disc = np.hypot(*(np.indices(truth.shape) - np.array([60, 90])[:, None, None])) < 35
    image = truth_noisy + sign * 40 * disc  # a fifth of the field
    assert np.abs(background_surface(image) - truth)[~disc].max() < 1.0  # the noise of one pixel
    plain = background_surface(image, 0)
    assert np.ptp(plain) < 1e-9


def test_the_noise_is_found_under_a_specimen():
    rng = np.random.default_rng(0)
    image = 100 + 50 * blobs((200, 200), 0.4, 2) + rng.normal(0, 2.0, (3, 200, 200))
    assert noise_level(image) == pytest.approx(2.0, rel=0.03)
    assert noise_level(np.ones((5, 2))) is None


# shear axis


def apart(angle, other):
    """The angle in degrees between two lines."""
    return abs(math.degrees((angle - other + math.pi / 2) % math.pi - math.pi / 2))


def test_the_shear_axis_of_random_blobs_is_found_at_every_angle():
    errors, uncertainties = [], []
    for degrees in range(0, 180, 10):
        image = 0.5 + 0.1 * blobs((256, 320), math.radians(degrees), degrees)
        axis = estimate_shear_axis(image + np.random.default_rng(degrees).normal(0, 0.002, image.shape))
        assert axis.direction == pytest.approx((math.sin(axis.angle), math.cos(axis.angle)))
        assert 0.4 < axis.anisotropy < 0.65  # ½ for a pure derivative
        errors.append(apart(axis.angle, math.radians(degrees)))
        uncertainties.append(math.degrees(axis.uncertainty))
    # some hundred independent frequencies decide: 3° or so, which the stated uncertainty covers
    assert np.sqrt(np.mean(np.square(errors))) < np.mean(uncertainties) < 4
    assert max(errors) < 10


def test_the_shear_axis_does_not_see_a_background_an_offset_a_scale_or_the_sign():
    image = blobs((200, 150), 0.7, 3)
    axis = estimate_shear_axis(image)
    assert apart(axis.angle, estimate_shear_axis(-40 * image + 1000).angle) < 1e-3
    assert apart(axis.angle, estimate_shear_axis(100 + 10 * image + 50 * tilted(image.shape)).angle) < 0.5


def test_mirroring_and_turning_the_image_mirrors_and_turns_the_axis():
    image = blobs((160, 200), 0.7, 3)
    angle = estimate_shear_axis(image).angle
    assert apart(estimate_shear_axis(image[::-1]).angle, -angle) < 1e-3  # the background's fit stops there
    assert apart(estimate_shear_axis(image.T).angle, math.pi / 2 - angle) < 1e-3


def test_oblong_pixels_are_allowed_for():
    angle = 0.9
    image = blobs((256, 256), angle, 5)[::2]  # pixels twice as high as wide
    assert apart(estimate_shear_axis(image, (2.0, 1.0)).angle, angle) < 6


def test_an_image_without_a_direction_has_no_shear_axis():
    rng = np.random.default_rng(1)
    with pytest.raises(ValueError, match="no shear axis: its anisotropy"):
        estimate_shear_axis(ndimage.gaussian_filter(rng.normal(size=(200, 200)), 3, mode="wrap"))
    with pytest.raises(ValueError, match="nothing above its noise"):
        estimate_shear_axis(rng.normal(size=(128, 128)))
    with pytest.raises(ValueError, match="nothing above its noise"):
        estimate_shear_axis(np.full((64, 64), 7.0))
    with pytest.raises(ValueError, match="16 × 64 pixels"):
        estimate_shear_axis(np.ones((16, 64)))


# measured files


def test_a_measured_dic_image_shows_its_shear_axis_its_tilt_and_its_noise(measured_file):
    stack = read_stack(measured_file("dic_agar_beads.tiff"))
    assert stack.data.shape == (1, 1, 600, 800)
    assert stack.saturation == 255
    assert apart(estimate_shear_axis(stack.data[0, 0]).angle, math.radians(142.7)) < 4  # measured by hand
    with warnings.catch_warnings(record=True) as caught:
        ready = prepared(stack, [RIGHT], [0.0], (0.1, 0.1))
    assert not caught  # 0.04 % saturated
    surface = background_surface(stack.data[0, 0])  # counts; the four corners are empty
    for corner in (np.s_[:32, :32], np.s_[:32, -32:], np.s_[-32:, :32], np.s_[-32:, -32:]):
        assert np.median(stack.data[0, 0][corner] - surface[corner]) == pytest.approx(0, abs=1)
    assert surface[0, -1] / surface[-1, 0] > 1.6  # the lamp is tilted: 162 counts against 96
    assert np.median(ready.data) == pytest.approx(0.5, abs=0.01)
    (report,) = ready.prisms
    assert report.noise is not None
    assert report.noise * report.scale == pytest.approx(2, abs=1)


def test_a_measured_imagej_stack_of_escaped_micrometres(measured_file):
    stack = read_stack(measured_file("bf_cell_zstack_100nm.tif"))
    assert stack.data.shape == (1, 21, 165, 157)
    assert stack.pixel_size == pytest.approx((0.11, 0.11), rel=1e-4)
    assert stack.focus_step == pytest.approx(0.1)
    ready = prepared(stack, [None], [0.1 * i for i in range(21)], (0.11, 0.11))
    assert np.median(ready.data) == pytest.approx(1, abs=0.02)


def test_a_measured_lzw_compressed_ome_tiff(measured_file):
    stack = read_stack(measured_file("load_s1t1c1z1_lzw.ome.tiff"))
    assert stack.data.shape == (1, 1, 325, 475)
    assert stack.data.dtype == np.uint16
    assert stack.pixel_size == pytest.approx((1.08333, 1.08333), rel=1e-5)


def test_a_dark_frame_has_the_scale_of_the_others():
    """Bias 0 between ±60°, as one lamp and one exposure give them; alone it tells none."""
    random, biases = np.random.default_rng(0), (-math.pi / 3, 0.0, math.pi / 3)
    empty = np.array([math.sin(bias / 2) ** 2 for bias in biases])[:, None, None, None]
    light = empty + 0.1 * random.random((3, 2, 20, 20)) * (np.arange(20) < 5)
    stack = Stack((100 + 20000 * light).round().astype(np.uint16), source="stack.tif")
    expected = ExpectedStack(biases, (0.0, 1.0), (0.1, 0.1))
    with pytest.warns(StackWarning, match=r"prism 2's empty field is dark and tells no scale: .* 2e\+04 per empty"):
        measured = prepare(stack, expected, Normalisation(offset=100.0, order=0))
    assert measured.data == pytest.approx(light, abs=1e-3)
