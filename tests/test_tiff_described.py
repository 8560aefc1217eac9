"""What headers say of the pixels: sizes in any unit and spelling, bit depths, and ImageJ's calibration."""

import numpy as np
import pytest
import tifffile

from recon.recording.preparation import ExpectedStack, prepare
from torchdic import Grid
from torchdic.errors import StackWarning
from torchdic.files.format import Stack
from torchdic.files.full_scale import full_scale
from torchdic.files.stack import read_stack, write_stack, write_volume

PLANES = np.arange(3 * 9 * 7, dtype=np.uint16).reshape(3, 9, 7) + 100


def ome(path, attributes, data=PLANES):
    """An OME-TIFF whose Pixels have these attributes, as text."""
    tifffile.imwrite(path, data, ome=True, photometric="minisblack", metadata={"axes": "ZYX"})
    with tifffile.TiffFile(path) as tif:
        xml = tif.ome_metadata
    tifffile.tiffcomment(path, xml.replace("<Pixels ", f"<Pixels {attributes} ").encode())
    return path


def imagej(path, lines, data=PLANES, **options):
    """An ImageJ TIFF whose description ends with these lines."""
    tifffile.imwrite(path, data, imagej=True, metadata={"axes": "ZYX"}, **options)
    with tifffile.TiffFile(path, mode="r+b") as tif:
        tag = tif.pages.first.tags["ImageDescription"]
        tag.overwrite((tag.value.rstrip() + "\n" + "\n".join(lines) + "\n").encode() + b"\0")
    return path


# --- sizes ------------------------------------------------------------------------------------------------------------

UNITS = {
    "m": 1e6,
    "dm": 1e5,
    "cm": 1e4,
    "mm": 1e3,
    "nm": 1e-3,
    "pm": 1e-6,
    "Å": 1e-4,
    "km": 1e9,
    "Mm": 1e12,
    "thou": 25.4,
    "mil": 25.4,
    "mils": 25.4,
    "in": 25400.0,
    "inch": 25400.0,
    "inches": 25400.0,
    "ft": 304800.0,
    "pt": 25400 / 72,
    "metre": 1e6,
    "meters": 1e6,
    "decimetres": 1e5,
    "centimeter": 1e4,
    "millimetres": 1e3,
    "Millimeters": 1e3,
    "micrometre": 1.0,
    "micrometres": 1.0,
    "micrometers": 1.0,
    "Micron": 1.0,
    "microns": 1.0,
    "nanometres": 1e-3,
    "nanometers": 1e-3,
    "angstroms": 1e-4,
    "µm": 1.0,
    "\u03bcm": 1.0,
    "um": 1.0,
    "UM": 1.0,
    "&#181;m": 1.0,
    "\\u00B5m": 1.0,
    "\\u03bcm": 1.0,
    "Â\u00b5m": 1.0,
}


@pytest.mark.parametrize(("unit", "factor"), UNITS.items(), ids=map(ascii, UNITS))
def test_every_spelling_of_a_unit_becomes_micrometres(tmp_path, unit, factor):
    sizes = {"Z": 5, "Y": 3, "X": 2}
    names = " ".join(f'PhysicalSize{axis}="{size}" PhysicalSize{axis}Unit="{unit}"' for axis, size in sizes.items())
    stack = read_stack(ome(tmp_path / "stack.ome.tif", names))
    assert (stack.focus_step, *stack.pixel_size) == pytest.approx((5 * factor, 3 * factor, 2 * factor), rel=1e-12)


def test_each_axis_of_imagej_has_its_own_unit(tmp_path):
    lines = ["unit=micron", "yunit=mil", "zunit=nm", "spacing=300"]
    stack = read_stack(imagej(tmp_path / "stack.tif", lines, resolution=(4.0, 8.0)))
    assert stack.focus_step == pytest.approx(0.3, rel=1e-12)
    assert stack.pixel_size == pytest.approx((25.4 / 8, 1 / 4), rel=1e-6)


def test_each_axis_of_ome_has_its_own_unit(tmp_path):
    names = 'PhysicalSizeX="160" PhysicalSizeXUnit="nm" PhysicalSizeY=".16" PhysicalSizeZ="3E-4" PhysicalSizeZUnit="mm"'
    stack = read_stack(ome(tmp_path / "stack.ome.tif", names))
    assert (stack.focus_step, *stack.pixel_size) == pytest.approx((0.3, 0.16, 0.16), rel=1e-12)


@pytest.mark.parametrize("text", ["", "Unknown", "NaN", "1,2,3", "0.1 µm", "-0.5"])
def test_a_size_that_is_no_number_is_warned_of_and_left_aside(tmp_path, text):
    path = ome(tmp_path / "stack.ome.tif", f'PhysicalSizeX="{text}" PhysicalSizeY="0.2" PhysicalSizeZ="0.5"')
    with pytest.warns(StackWarning, match=r"stack\.ome\.tif: its PhysicalSizeX"):
        stack = read_stack(path)
    assert stack.pixel_size is None
    assert stack.focus_step == 0.5
    assert np.array_equal(stack.data, PLANES[None])


def test_a_decimal_comma_is_read_as_one_and_said(tmp_path):
    path = ome(tmp_path / "stack.ome.tif", 'PhysicalSizeX="0,17" PhysicalSizeY="0.17"')
    with pytest.warns(StackWarning, match=r"'0,17'; the comma is read as a decimal point: 0\.17"):
        assert read_stack(path).pixel_size == (0.17, 0.17)
    path = imagej(tmp_path / "stack.tif", ["unit=um", "spacing=0,5"])
    with pytest.warns(StackWarning, match="decimal point"):
        assert read_stack(path).focus_step == 0.5


def test_an_unknown_unit_of_one_axis_leaves_the_others(tmp_path):
    path = imagej(tmp_path / "stack.tif", ["unit=um", "zunit=steps", "spacing=300"], resolution=(4.0, 4.0))
    with pytest.warns(StackWarning, match="300 'steps' is in no known unit"):
        stack = read_stack(path)
    assert stack.focus_step is None
    assert stack.pixel_size == pytest.approx((0.25, 0.25), rel=1e-6)


# --- ImageJ's calibration ---------------------------------------------------------------------------------------------


def calibrated(path):
    with pytest.warns(StackWarning, match="calibration of its values is applied: c0 = "):
        return read_stack(path)


def test_signed_16_bits_of_imagej_are_shifted_back(tmp_path):
    lines = ["cf=0", "c0=-32768.0", "c1=1.0", "vunit=Gray Value"]
    data = np.concatenate([PLANES, np.full((1, 9, 7), 32767, np.uint16)])
    stack = calibrated(imagej(tmp_path / "stack.tif", lines, data + np.uint16(32768)))
    assert np.array_equal(stack.data[0], data)
    assert stack.is_integer
    assert stack.saturation == 32767
    stack = calibrated(imagej(tmp_path / "stack.tif", lines, PLANES + np.uint16(32568)))
    assert np.array_equal(stack.data[0], PLANES.astype(int) - 200)
    assert stack.data.dtype == np.int16


def test_a_straight_line_is_applied_and_its_values_are_counts_still(tmp_path):
    stack = calibrated(imagej(tmp_path / "stack.tif", ["c0=-10.5", "c1=0.25"]))
    assert np.allclose(stack.data[0], PLANES * 0.25 - 10.5, rtol=1e-15)
    assert stack.is_integer
    assert stack.saturation == 65535 * 0.25 - 10.5


def test_a_calibration_does_not_change_what_is_reconstructed(tmp_path):
    """A gain and an offset that the file tells come out of the prepared stack again."""
    expected = ExpectedStack(biases=(1.5,), focus=(0.0, 1.0, 2.0), pixel_size=(0.2, 0.2))
    plain = prepare(read_stack(imagej(tmp_path / "plain.tif", [])), expected)
    path = imagej(tmp_path / "stack.tif", ["c0=-16384", "c1=0.5"], PLANES * np.uint16(2) + np.uint16(32768))
    assert np.allclose(prepare(calibrated(path), expected).data, plain.data, rtol=1e-6)


@pytest.mark.parametrize("lines", [["cf=0", "c0=0.0", "c1=1.0"], ["c0=nan", "c1=1"], ["c0=x", "c1=y"], []])
def test_no_calibration_changes_nothing_and_says_nothing(tmp_path, lines):
    stack = read_stack(imagej(tmp_path / "stack.tif", lines))
    assert np.array_equal(stack.data[0], PLANES)
    assert stack.full_scale is None


@pytest.mark.parametrize("lines", [["cf=20", "c0=1", "c1=2"], ["cf=1", "c0=1", "c1=2", "c2=3"], ["c0=5", "c1=0"]])
def test_a_calibration_that_is_no_straight_line_is_not_applied_and_said(tmp_path, lines):
    path = imagej(tmp_path / "stack.tif", lines)
    with pytest.warns(StackWarning, match="calibration .* straight line; its pixels are taken as stored"):
        assert np.array_equal(read_stack(path).data[0], PLANES)


# --- bit depth --------------------------------------------------------------------------------------------------------


def clipped(depth=12, shift=0):
    """Counts of a camera of this depth, of which some percent are saturated."""
    light = np.random.default_rng(0).poisson(0.8 * 2**depth, (1, 3, 40, 40)) * np.linspace(0.2, 1.3, 40)
    return (np.minimum(light, 2**depth - 1).astype(np.uint16) << shift).astype(np.uint16)


@pytest.mark.parametrize(
    ("data", "bits", "saturated"),
    [
        (clipped(12), None, 4095),
        (clipped(14), None, 16383),
        (clipped(10), None, 1023),
        (clipped(12, 4), None, 65520),
        (clipped(14, 2), None, 65532),
        (clipped(12, 4), 12, 65520),
        (clipped(12) // 2, 12, 4095),
        (clipped(12) // 2 * 16, None, 65520),  # left-aligned, none of them saturated
        (np.array([[60000, 4095, 7]], np.uint16), 12, 65535),  # the stated depth is wrong
        (np.array([[4000, 7]], np.uint16), None, 65535),
        (np.zeros((3, 3), np.uint16), None, 65535),
        (np.array([[255, 3]], np.uint8), None, 255),
        (np.array([[-5, 4095]], np.int16), None, 32767),
        (np.array([[5, 4095]], np.int16), None, 4095),
    ],
)
def test_the_full_scale_is_the_cameras(data, bits, saturated):
    assert full_scale(data, bits) == saturated


STATED = {
    "ome": lambda path, data: ome(path, 'SignificantBits="12"', data[0]),
    "imagej info": lambda path, data: tifffile.imwrite(
        path, data[0], imagej=True, metadata={"axes": "ZYX", "Info": 'Camera-BitDepth = 12\n"PixelType": "GRAY16"'}
    ),
    "micro-manager": lambda path, data: tifffile.imwrite(
        path,
        data[0],
        photometric="minisblack",
        metadata=None,
        extratags=[(51123, 2, 0, '{"BitDepth": 12, "PixelType": "GRAY16"}', False)],
    ),
    "metamorph": lambda path, data: tifffile.imwrite(
        path,
        data[0],
        photometric="minisblack",
        metadata=None,
        description='<prop id="bits-per-pixel" type="int" value="16"/><prop id="camera-bit-depth" value="12"/>',
    ),
    "hcimage": lambda path, data: tifffile.imwrite(
        path, data[0], photometric="minisblack", metadata=None, description="[Capture]\r\nvBitsPerChannel=12\r\n"
    ),
    "max sample value": lambda path, data: tifffile.imwrite(
        path, data[0], photometric="minisblack", metadata=None, extratags=[(281, 3, 1, 4095, False)]
    ),
}


@pytest.mark.parametrize("write", STATED.values(), ids=STATED)
def test_a_stated_bit_depth_is_found(tmp_path, write):
    path = tmp_path / "stack.tif"
    write(path, clipped(12) // 2)  # the pixels don't tell
    stack = read_stack(path)
    assert stack.bits == 12
    assert stack.saturation == 4095


def test_a_stated_depth_that_the_pixels_exceed_is_passed_over(tmp_path):
    stack = read_stack(ome(tmp_path / "stack.ome.tif", 'SignificantBits="8"', clipped(12, 3)[0]))
    assert stack.bits is None
    assert stack.saturation == 2**15 - 8


def test_the_depth_of_the_pixels_themselves_tells_nothing(tmp_path):
    """Programs write it for any camera; who gives it in code means it."""
    data = clipped(12)[0]
    stack = read_stack(ome(tmp_path / "stack.ome.tif", 'SignificantBits="16"', data))
    assert stack.bits is None
    assert stack.saturation == 4095
    assert Stack(data[None], bits=16).saturation == 65535


@pytest.mark.parametrize("shift", [0, 4])
def test_saturated_pixels_of_12_bits_in_16_are_warned_of(shift):
    data = clipped(12, shift)
    expected = ExpectedStack(biases=(1.5,), focus=(0.0, 1.0, 2.0), pixel_size=(0.2, 0.2))
    with pytest.warns(StackWarning, match=f"are saturated at {4095 << shift}"):
        prepare(Stack(data), expected)


# --- what is written --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["stack", "volume"])
def test_ome_xml_is_what_its_schema_asks_for(tmp_path, kind):
    """By the schema of the Open Microscopy Environment, and at the right scale, in the right unit."""
    ome_types = pytest.importorskip("ome_types", reason="ome-types isn't installed")
    path = tmp_path / "written.ome.tif"
    if kind == "stack":
        write_stack(path, np.stack([PLANES, PLANES]), (0.2, 0.1), 0.5, names=("plus", "minus"), bits=12)
    else:
        write_volume(path, PLANES / 1e5, Grid(PLANES.shape, (0.5, 0.2, 0.1)))
    with tifffile.TiffFile(path) as tif:
        (found,) = ome_types.from_xml(tif.ome_metadata, validate=True).images
    assert found.name == ("written" if kind == "stack" else "delta n")
    pixels = found.pixels
    assert (pixels.size_c, pixels.size_z, pixels.size_y, pixels.size_x) == (2 if kind == "stack" else 1, *PLANES.shape)
    assert [getattr(pixels, f"physical_size_{axis}") for axis in "zyx"] == pytest.approx([0.5, 0.2, 0.1])
    assert {getattr(pixels, f"physical_size_{axis}_unit").value for axis in "zyx"} == {"µm"}
    assert [channel.name for channel in pixels.channels] == (["plus", "minus"] if kind == "stack" else ["delta n"])
    assert pixels.significant_bits == (12 if kind == "stack" else None)
