import logging
import struct

import numpy as np
import pytest
import tifffile
import torch

from torchdic import Grid
from torchdic.errors import StackError, StackWarning
from torchdic.files.format import Stack
from torchdic.files.stack import read_stack, read_volume, write_stack, write_volume

SHAPES = {"4-D": (2, 3, 9, 7), "3-D": (3, 9, 7), "2-D": (9, 7)}
CODECS = [None, "lzw", "zlib"]


def ramp(shape, dtype=np.uint16):
    """Every pixel another value, so that a swapped axis shows."""
    return np.arange(np.prod(shape)).reshape(shape).astype(dtype)


def the_error(path):
    """The one line with which reading the file is refused; it names the file."""
    with pytest.raises(StackError) as caught:
        read_stack(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def refused(path):
    try:
        read_stack(path)
    except StackError:
        return True
    return False


@pytest.fixture(params=["ome", "ome-lzw", "ome-zlib", "imagej", "plain", "plain-lzw", "one-page", "bigtiff", "tiled"])
def tiff(request, tmp_path):
    """A sound stack of 2 prisms × 5 planes in one of the layouts that programs write: (path, data)."""
    data = ramp((2, 5, 16, 16), np.float32)
    path = tmp_path / "stack.tif"
    kind, _, codec = request.param.partition("-")
    if request.param == "one-page":  # one page describes all planes
        tifffile.imwrite(path, data, truncate=True)
    elif kind == "ome":
        write_stack(path, data, (0.2, 0.1), 0.5, compression=codec or None)
    elif kind == "imagej":
        hyperstack = data.transpose(1, 0, 2, 3)
        tifffile.imwrite(path, hyperstack, imagej=True, metadata={"axes": "ZCYX", "unit": "um", "spacing": 0.5})
    elif kind == "bigtiff":
        tifffile.imwrite(path, data, bigtiff=True, byteorder=">")
    elif kind == "tiled":
        tifffile.imwrite(path, data, tile=(16, 16), compression="zlib")
    else:
        tifffile.imwrite(path, data, compression=codec or None, rowsperstrip=8)
    return path, data


# axes and sizes


def test_every_layout_reads_as_prism_focus_y_x(tiff):
    path, data = tiff
    stack = read_stack(path)
    assert stack.data.shape == data.shape
    assert np.array_equal(stack.data, data)
    assert stack.data.dtype == np.dtype("float32")  # in this machine's byte order


@pytest.mark.parametrize("compression", CODECS)
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int32", "float32", "float64"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_a_stack_reads_back_as_it_was_written(tmp_path, shape, dtype, compression):
    path = tmp_path / "stack.ome.tif"
    data = ramp(shape, dtype)
    write_stack(path, data, (0.21, 0.1), 0.35, compression=compression)
    stack = read_stack(path)
    assert np.array_equal(stack.data, data.reshape((1,) * (4 - len(shape)) + shape))
    assert stack.data.dtype == np.dtype(dtype)
    assert stack.pixel_size == (0.21, 0.1)
    assert stack.focus_step == 0.35
    assert stack.is_integer == (np.dtype(dtype).kind in "iu")


def test_a_stack_keeps_its_prisms_names_and_may_lack_sizes(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, torch.rand(2, 3, 5, 4, requires_grad=True), names=("shear x", "shear y"))
    stack = read_stack(path)
    assert stack.names == ("shear x", "shear y")
    assert stack.pixel_size is None
    assert stack.focus_step is None


@pytest.mark.parametrize("names", [("bell\x07", "caf\udce9"), ("caf\udce9",)])
def test_a_name_that_no_xml_can_hold_is_written_with_question_marks(tmp_path, names):
    """Names of files become those of prisms: bytes that are no UTF-8 stand in them as halves of signs."""
    path = tmp_path / "stack.ome.tif"
    write_stack(path, np.ones((len(names), 3, 5, 4), np.float32), names=names)
    assert read_stack(path).names == ("bell?", "caf?")[-len(names) :]


@pytest.mark.parametrize("shape", [(4, 6, 5), (1, 6, 5), (3, 5, 1)])
@pytest.mark.parametrize("compression", CODECS)
def test_a_volume_reads_back_as_float32_on_its_grid(tmp_path, shape, compression):
    path = tmp_path / "volume.ome.tif"
    grid = Grid(shape=shape, spacing=(0.4, 0.2, 0.13))
    delta = torch.linspace(-0.01, 0.03, int(np.prod(shape)), dtype=torch.float64).reshape(shape)
    write_volume(path, delta, grid, compression=compression)
    found, found_grid = read_volume(path)
    assert found.dtype == torch.float32
    assert torch.equal(found, delta.float())
    assert found_grid == grid


def test_ome_sizes_are_in_micrometres_and_on_the_page_for_readers_without_ome(tmp_path):
    path = tmp_path / "volume.ome.tif"
    write_volume(path, np.zeros((3, 4, 5), np.float32), Grid(shape=(3, 4, 5), spacing=(0.4, 0.2, 0.1)))
    with tifffile.TiffFile(path) as tif:
        pixels = tifffile.xml2dict(tif.ome_metadata)["OME"]["Image"]["Pixels"]
        tags = tif.pages.first.tags
        per_cm = [np.divide(*tags[name].value) for name in ("YResolution", "XResolution")]
        assert tags["ResolutionUnit"].value == tifffile.RESUNIT.CENTIMETER
    assert [pixels[f"PhysicalSize{axis}"] for axis in "ZYX"] == [0.4, 0.2, 0.1]
    assert {pixels[f"PhysicalSize{axis}Unit"] for axis in "ZYX"} == {"µm"}
    assert [pixels[f"Size{axis}"] for axis in "TCZYX"] == [1, 1, 3, 4, 5]
    assert pixels["Type"] == "float"
    assert per_cm == pytest.approx([1e4 / 0.2, 1e4 / 0.1], rel=1e-6)  # a fraction of two 32-bit integers


@pytest.mark.parametrize(("unit", "factor"), [("nm", 1e-3), ("µm", 1.0), ("mm", 1e3), ("Å", 1e-4), ("m", 1e6)])
def test_ome_units_become_micrometres(tmp_path, unit, factor):
    path = tmp_path / "stack.ome.tif"
    sizes = {"PhysicalSizeX": 3.0, "PhysicalSizeY": 2.0, "PhysicalSizeZ": 5.0}
    units = {f"{size}Unit": unit for size in sizes}
    tifffile.imwrite(path, ramp((3, 9, 7)), ome=True, metadata={"axes": "ZYX"} | sizes | units)
    stack = read_stack(path)
    assert stack.data.shape == (1, 3, 9, 7)
    assert stack.pixel_size == pytest.approx((2 * factor, 3 * factor), rel=1e-12)
    assert stack.focus_step == pytest.approx(5 * factor, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "factor"), [("um", 1.0), ("micron", 1.0), ("\\u00B5m", 1.0), ("nm", 1e-3), ("inch", 2.54e4)]
)
def test_imagej_units_become_micrometres(tmp_path, unit, factor):
    path = tmp_path / "stack.tif"
    meta = {"axes": "ZYX", "unit": unit, "spacing": 0.5}
    tifffile.imwrite(path, ramp((3, 9, 7)), imagej=True, resolution=(4.0, 8.0), metadata=meta)  # x, y
    stack = read_stack(path)
    assert stack.data.shape == (1, 3, 9, 7)
    assert stack.pixel_size == pytest.approx((factor / 8, factor / 4), rel=1e-6)
    assert stack.focus_step == pytest.approx(0.5 * factor, rel=1e-12)


def test_sizes_in_pixels_or_in_print_say_nothing(tmp_path):
    path = tmp_path / "stack.tif"
    meta = {"axes": "ZYX", "unit": "pixel", "spacing": 1.0}
    tifffile.imwrite(path, ramp((3, 9, 7)), imagej=True, resolution=(1.0, 1.0), metadata=meta)
    assert (read_stack(path).pixel_size, read_stack(path).focus_step) == (None, None)
    tifffile.imwrite(path, ramp((9, 7)), resolution=(72, 72), resolutionunit="INCH", metadata=None)
    assert read_stack(path).pixel_size is None


@pytest.mark.parametrize(("unit", "size"), [("furlong", 2.0), ("µm", 0.0)])
def test_a_size_that_is_no_length_is_warned_of(tmp_path, unit, size):
    path = tmp_path / "stack.ome.tif"
    meta = {"axes": "YX", "PhysicalSizeX": size, "PhysicalSizeXUnit": unit, "PhysicalSizeY": 1.0}
    tifffile.imwrite(path, ramp((9, 7)), ome=True, metadata=meta)
    with pytest.warns(StackWarning, match=rf"stack\.ome\.tif: .*{unit}"):
        assert read_stack(path).pixel_size is None


def test_channels_of_imagej_are_prisms_and_named_axes_go_where_they_belong(tmp_path):
    path = tmp_path / "stack.tif"
    data = ramp((2, 9, 7))
    tifffile.imwrite(path, data, imagej=True, metadata={"axes": "CYX"})
    assert np.array_equal(read_stack(path).data, data[:, None])
    tifffile.imwrite(path, data, ome=True, metadata={"axes": "CYX"})
    assert np.array_equal(read_stack(path).data, data[:, None])


def test_bits_tell_a_camera_of_fewer_from_its_dtype(tmp_path):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, ramp((16, 16)), bitspersample=12, photometric="minisblack", metadata=None)
    stack = read_stack(path)
    assert stack.data.dtype == np.uint16
    assert stack.saturation == 4095
    assert Stack(np.zeros((1, 1, 2, 2), np.int16)).saturation == 32767
    assert Stack(np.zeros((1, 1, 2, 2), np.float32)).saturation is None


# bad input


def test_a_missing_file_is_refused(tmp_path):
    assert "no such file" in the_error(tmp_path / "absent.tif")


def test_a_folder_is_refused(tmp_path):
    assert "folder" in the_error(tmp_path)


def test_a_file_of_no_bytes_is_refused(tmp_path):
    path = tmp_path / "empty.tif"
    path.touch()
    assert "0 bytes" in the_error(path)


@pytest.mark.parametrize("text", [b"focus,intensity\n0,1\n", b"I", b"MM", "Größe\n".encode()])
def test_text_renamed_to_tif_is_refused(tmp_path, text):
    path = tmp_path / "text.tif"
    path.write_bytes(text)
    assert "is no TIFF" in the_error(path)


def test_a_truncated_file_is_refused_wherever_it_ends(tiff):
    path, data = tiff
    whole = path.read_bytes()
    for end in [*range(8, len(whole), len(whole) // 29), *range(len(whole) - 18, len(whole))]:
        path.write_bytes(whole[:end])
        if end >= len(whole) - 16 and not refused(path):
            assert np.array_equal(read_stack(path).data, data)  # tifffile pads its files to 16 bytes
        else:
            the_error(path)


def test_truncation_names_both_lengths(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, ramp((2, 3, 32, 16)))
    path.write_bytes(path.read_bytes()[:1500])
    message = the_error(path)
    assert "truncated" in message
    assert "the file ends at byte 1500" in message


@pytest.mark.parametrize("compression", ["lzw", "zlib"])
def test_garbled_pixels_are_refused(tmp_path, compression):
    path = tmp_path / "stack.ome.tif"
    noise = np.random.default_rng(0).integers(0, 4, (2, 3, 64, 64)).astype(np.uint16)
    write_stack(path, noise, compression=compression)
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as tif:
        start, count = tif.pages[3].dataoffsets[0], tif.pages[3].databytecounts[0]
    content[start : start + count] = bytes(count)
    path.write_bytes(content)
    assert "cannot be read as TIFF" in the_error(path)


def test_planes_listed_but_missing_are_refused(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, ramp((2, 3, 9, 7)), compression="zlib")
    path.write_bytes(path.read_bytes().replace(b'SizeZ="3"', b'SizeZ="4"'))
    assert "planes" in the_error(path)


def test_a_strip_without_bytes_is_refused(tmp_path):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, ramp((32, 16)), rowsperstrip=8, compression="zlib", metadata=None)
    with tifffile.TiffFile(path) as tif:
        tag = tif.pages.first.tags["StripByteCounts"]
        counts, dtype = list(tag.value), tag.dtype
        offset = tag.valueoffset
    assert dtype in (3, 4)
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(struct.pack("<4" + ("H" if dtype == 3 else "I"), *counts[:3], 0))
    assert "misses a part of its pixels" in the_error(path)


@pytest.mark.parametrize("compression", CODECS)
def test_pixels_that_are_not_finite_are_counted(tmp_path, compression):
    path = tmp_path / "stack.tif"
    data = np.ones((2, 5, 9, 7), np.float32)
    data[0, 0, :2, 0] = np.nan
    data[1, 2, 3, 4] = -np.inf
    tifffile.imwrite(path, data, compression=compression)
    assert "3 of 630 pixels are not finite (2 NaN, 1 infinite)" in the_error(path)


def test_a_file_without_pages_is_refused(tmp_path):
    path = tmp_path / "empty.tif"
    path.write_bytes(struct.pack("<2sHI", b"II", 42, 0))
    assert "holds no pages" in the_error(path)


def test_pages_in_a_circle_are_refused(tmp_path):
    path = tmp_path / "circle.tif"
    path.write_bytes(struct.pack("<2sHIHI", b"II", 42, 8, 0, 8))
    assert "circle" in the_error(path)


def test_an_image_of_no_size_is_refused(tmp_path):
    path = tmp_path / "empty.tif"
    tifffile.imwrite(path, ramp((9, 7)), metadata=None)
    with tifffile.TiffFile(path) as tif:
        offset = tif.pages.first.tags["ImageWidth"].valueoffset
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(bytes(4))
    assert "is empty" in the_error(path)


@pytest.mark.parametrize("samples", [3, 4])
@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_a_colour_image_is_refused(tmp_path, samples, planar):
    path = tmp_path / "colour.tif"
    shape = (9, 7, samples) if planar == "contig" else (samples, 9, 7)
    extra = {"extrasamples": ["unassalpha"]} if samples == 4 else {}
    tifffile.imwrite(path, ramp(shape, np.uint8), photometric="rgb", planarconfig=planar, **extra)
    told = the_error(path)
    assert f"colour image, {samples} samples per pixel" in told
    # as tifffile writes an array of integers, of so many planes, where it isn't told that they are grey
    assert ("if these are planes, write them with photometric='minisblack'" in told) == (planar == "separate")


@pytest.mark.filterwarnings("ignore:.*are stored as RGB:DeprecationWarning")
@pytest.mark.parametrize("shape", [(2, 3, 9, 7), (4, 9, 7)])
def test_float_planes_that_tifffile_stored_as_rgb_are_planes(tmp_path, shape):
    path = tmp_path / "stack.tif"
    data = ramp(shape, np.float32)
    tifffile.imwrite(path, data)
    with tifffile.TiffFile(path) as tif:
        assert tif.pages.first.photometric == tifffile.PHOTOMETRIC.RGB
    assert np.array_equal(read_stack(path).data, data.reshape((-1, *shape[-3:])))


def test_a_colour_image_without_a_colour_space_is_refused(tmp_path):
    path = tmp_path / "colour.ome.tif"
    data = ramp((2, 9, 7, 3), np.uint8)
    tifffile.imwrite(path, data, photometric="rgb", ome=True, metadata={"axes": "ZYXS"})
    assert "colour image" in the_error(path)


@pytest.mark.parametrize(("photometric", "said"), [("palette", "palette"), ("miniswhite", "0 is white")])
def test_values_that_do_not_grow_with_light_are_refused(tmp_path, photometric, said):
    path = tmp_path / "stack.tif"
    extra = {"colormap": np.zeros((3, 256), np.uint16)} if photometric == "palette" else {}
    tifffile.imwrite(path, ramp((9, 7), np.uint8), photometric=photometric, metadata=None, **extra)
    assert said in the_error(path)


@pytest.mark.parametrize("how", ["ome", "imagej"])
def test_a_time_axis_is_refused(tmp_path, how):
    path = tmp_path / "movie.tif"
    tifffile.imwrite(path, ramp((5, 3, 9, 7)), metadata={"axes": "TZYX"}, **{how: True})
    assert "5 time points" in the_error(path)


def test_more_dimensions_than_a_stack_has_are_refused(tmp_path):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, ramp((2, 2, 5, 9, 7)))
    assert "2 × 2 × 5 × 9 × 7" in the_error(path)
    tifffile.imwrite(path, ramp((2, 5, 9, 7)), metadata={"axes": "PZYX"})
    assert "more dimensions" in the_error(path)


def test_a_fifth_dimension_of_length_one_is_no_dimension(tmp_path):
    path = tmp_path / "stack.tif"
    data = ramp((1, 2, 5, 9, 7))
    tifffile.imwrite(path, data)
    assert np.array_equal(read_stack(path).data, data[0])


@pytest.mark.parametrize("dtype", ["complex64", "complex128", "bool"])
def test_pixels_that_are_no_intensities_are_refused(tmp_path, dtype):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, ramp((16, 16)).astype(dtype), photometric="minisblack")
    assert dtype in the_error(path)


def test_unequal_images_in_one_file_are_refused(tmp_path):
    path = tmp_path / "two.tif"
    with tifffile.TiffWriter(path) as tif:
        tif.write(ramp((9, 7)), metadata=None)
        tif.write(ramp((8, 6)), metadata=None)
    assert "2 unequal images (9 × 7, 8 × 6)" in the_error(path)


def test_one_file_of_many_is_refused(tmp_path):
    path = tmp_path / "part.ome.tif"
    write_stack(path, ramp((3, 9, 7)))
    with tifffile.TiffFile(path) as tif:
        xml = tif.ome_metadata
    elsewhere = '<TiffData IFD="0" PlaneCount="3"><UUID FileName="rest.tif">urn:uuid:1</UUID></TiffData>'
    spread = xml.replace('<TiffData IFD="0" PlaneCount="3"/>', elsewhere)
    assert spread != xml
    tifffile.imwrite(path, ramp((3, 9, 7)), description=spread, photometric="minisblack", metadata=None)
    assert "rest.tif" in the_error(path)


def test_broken_ome_xml_is_refused(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, ramp((3, 9, 7)))
    path.write_bytes(path.read_bytes().replace(b"<Pixels ", b"<Pixels<"))
    assert "OME-XML cannot be parsed" in the_error(path)


class Heard(logging.Handler):
    """Keeps what is logged."""

    def __init__(self):
        super().__init__()
        self.messages = []

    def emit(self, record):
        self.messages.append(record.getMessage())


def test_tifffile_keeps_quiet_but_is_not_silenced(tmp_path, monkeypatch):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, ramp((2, 3, 9, 7)), compression="zlib")
    path.write_bytes(path.read_bytes().replace(b'SizeZ="3"', b'SizeZ="4"'))
    heard, root = Heard(), logging.getLogger()
    monkeypatch.setattr(root, "handlers", [heard])
    monkeypatch.setattr(root, "level", logging.INFO)
    the_error(path)
    assert not heard.messages
    logging.getLogger("tifffile").warning("still heard")
    assert heard.messages == ["still heard"]


# writing


@pytest.mark.parametrize(
    ("data", "law"),
    [
        (np.zeros((1, 1, 1, 4, 4), np.float32), "5 axes"),
        (np.zeros(4, np.float32), "1 axes"),
        (np.zeros((0, 4, 4), np.float32), "would be empty"),
        (np.zeros((4, 4), np.complex64), "complex64"),
        (np.zeros((4, 4), np.int64), "int64"),
        (np.full((4, 4), np.nan, np.float32), "16 NaN"),
    ],
)
def test_what_no_reader_would_take_is_not_written(tmp_path, data, law):
    path = tmp_path / "stack.ome.tif"
    with pytest.raises(StackError, match=law):
        write_stack(path, data)
    assert list(tmp_path.iterdir()) == []


def test_wrong_sizes_and_names_are_not_written(tmp_path):
    path = tmp_path / "stack.ome.tif"
    with pytest.raises(StackError, match=r"0\.0 µm along y"):
        write_stack(path, np.zeros((4, 4), np.float32), (0.0, 0.1))
    with pytest.raises(StackError, match="2 names for 1 prisms"):
        write_stack(path, np.zeros((4, 4), np.float32), names=("a", "b"))
    with pytest.raises(StackError, match="4 × 4 × 4 voxels, its grid 4 × 4 × 5"):
        write_volume(path, np.zeros((4, 4, 4)), Grid(shape=(4, 4, 5), spacing=(1, 1, 1)))
    with pytest.raises(StackError, match="complex128"):
        write_volume(path, np.zeros((1, 1, 1), complex), Grid(shape=(1, 1, 1), spacing=(1, 1, 1)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("disk full")])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, error):
    path = tmp_path / "volume.ome.tif"
    grid = Grid(shape=(2, 4, 4), spacing=(1, 1, 1))
    write_volume(path, np.ones(grid.shape), grid)
    before = path.read_bytes()

    def breaks_off(file, *args, **kwargs):
        file.write_bytes(b"half of a")
        raise error

    monkeypatch.setattr(tifffile, "imwrite", breaks_off)
    with pytest.raises(KeyboardInterrupt if error is KeyboardInterrupt else StackError):
        write_volume(path, np.zeros(grid.shape), grid)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    blocker = tmp_path / "file"
    blocker.touch()
    for path in (tmp_path / "absent" / "stack.ome.tif", blocker / "stack.ome.tif"):
        with pytest.raises(StackError, match="cannot be written") as caught:
            write_stack(path, np.zeros((4, 4), np.float32))
        assert str(path) in str(caught.value)


def test_a_volume_needs_one_channel_and_a_voxel_size(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, np.zeros((2, 3, 4, 4), np.float32), (1, 1), 1)
    with pytest.raises(StackError, match="2 channels"):
        read_volume(path)
    write_stack(path, np.zeros((3, 4, 4), np.float32), (1, 1))
    with pytest.raises(StackError, match="no voxel size"):
        read_volume(path)


@pytest.mark.parametrize("compression", ["lzw", "zlib"])
def test_compression_shrinks_the_file(tmp_path, compression):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, np.zeros((64, 64), np.float32), compression=compression)
    assert path.stat().st_size < 64 * 64 * 4 / 2
