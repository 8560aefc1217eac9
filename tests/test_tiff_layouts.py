"""Stacks that programs lay out in other ways than torchdic does: which images of a file are the stack."""

import re

import numpy as np
import pytest
import tifffile
from PIL import Image

from torchdic.errors import StackError, StackWarning
from torchdic.files import stack as stack_module
from torchdic.files.format import Format
from torchdic.files.stack import read_stack, write_stack

PLANES = np.arange(5 * 12 * 14, dtype=np.uint16).reshape(5, 12, 14)
STACKS = np.arange(3 * 2 * 5 * 12 * 14, dtype=np.uint16).reshape(3, 2, 5, 12, 14)


def the_error(path, series=None):
    """The one line with which reading is refused; it names the file."""
    with pytest.raises(StackError) as caught:
        read_stack(path, series)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


# --- planes that were written one by one ------------------------------------------------------------------------------


def in_a_loop(path, **options):
    with tifffile.TiffWriter(path, ome=options.pop("ome", None)) as tif:
        for plane in PLANES:
            tif.write(plane, photometric="minisblack", **options)


def appended(path):
    for plane in PLANES:
        tifffile.imwrite(path, plane, append=True)


def by_pillow(path, **options):
    first, *others = map(Image.fromarray, PLANES)
    first.save(path, save_all=True, append_images=others, **options)


def unlike_stored(path):
    with tifffile.TiffWriter(path) as tif:
        for number, plane in enumerate(PLANES):
            codec = ("zlib", None, "lzw")[number % 3]
            tif.write(plane, photometric="minisblack", metadata=None, compression=codec)


LOOPS = {
    "writer": in_a_loop,
    "writer without description": lambda path: in_a_loop(path, metadata=None),
    "ome": lambda path: in_a_loop(path, ome=True),
    "append": appended,
    "pillow": by_pillow,
    "pillow lzw": lambda path: by_pillow(path, compression="tiff_lzw"),
    "each page stored otherwise": unlike_stored,
}


@pytest.mark.parametrize("write", LOOPS.values(), ids=LOOPS)
def test_equal_pages_are_the_planes_of_one_stack_in_their_order(tmp_path, write):
    path = tmp_path / "stack.tif"
    write(path)
    assert np.array_equal(read_stack(path).data, PLANES[None])


def test_unequal_pages_are_refused_with_the_sizes_that_differ(tmp_path):
    path = tmp_path / "stack.tif"
    with tifffile.TiffWriter(path) as tif:
        for plane in (*PLANES, PLANES[0, :, :9]):
            tif.write(plane, photometric="minisblack")
    message = the_error(path)
    assert "6 unequal images (12 × 14, 12 × 9)" in message
    with tifffile.TiffWriter(path) as tif:
        for plane in (PLANES[0], PLANES[0].astype(np.float32)):
            tif.write(plane, photometric="minisblack")
    assert "12 × 14 uint16, 12 × 14 float32" in the_error(path)


def test_a_page_of_many_that_is_cut_off_is_refused(tmp_path):
    path = tmp_path / "stack.tif"
    in_a_loop(path)
    path.write_bytes(path.read_bytes()[:-100])
    assert "truncated" in the_error(path)


def test_pages_of_colour_are_refused_as_such(tmp_path):
    path = tmp_path / "stack.tif"
    with tifffile.TiffWriter(path) as tif:
        for plane in PLANES:
            tif.write(np.stack([plane] * 3, -1), photometric="rgb")
    assert "is a colour image, 3 samples per pixel" in the_error(path)


# --- several stacks in one file ---------------------------------------------------------------------------------------


def several(path):
    with tifffile.TiffWriter(path, ome=True) as tif:
        for stack in STACKS:
            tif.write(stack, photometric="minisblack", metadata={"axes": "CZYX"})


def positions(path):
    tifffile.imwrite(path, STACKS, photometric="minisblack", metadata={"axes": "PCZYX"})


@pytest.mark.parametrize("write", [several, positions])
def test_one_of_several_stacks_is_read_where_it_is_named_and_offered_where_not(tmp_path, write):
    path = tmp_path / "stacks.tif"
    write(path)
    assert "series = 0 … 2 in [data], or --series of torchdic new, takes one" in the_error(path)
    for number, stack in enumerate(STACKS):
        assert np.array_equal(read_stack(path, number).data, stack)
    assert "series 3 must be from 0 to 2" in the_error(path, 3)
    assert "series -1 must be from 0 to 2" in the_error(path, -1)


def test_equal_series_are_called_equal(tmp_path):
    path = tmp_path / "stacks.ome.tif"
    several(path)
    assert "holds 3 equal series (2 × 5 × 12 × 14 each)" in the_error(path)


def test_sizes_are_those_of_the_series_that_is_read(tmp_path):
    path = tmp_path / "stacks.ome.tif"
    with tifffile.TiffWriter(path, ome=True) as tif:
        for size in (0.1, 0.2):
            meta = {"axes": "ZYX", **{f"PhysicalSize{axis}": size for axis in "XYZ"}}
            tif.write(PLANES, photometric="minisblack", metadata=meta)
    assert [read_stack(path, number).focus_step for number in (0, 1)] == [0.1, 0.2]


def test_single_images_at_several_places_of_the_stage_are_no_focus_planes(tmp_path):
    path = tmp_path / "places.ome.tif"
    with tifffile.TiffWriter(path, ome=True) as tif:
        for number, plane in enumerate(PLANES):
            meta = {"axes": "YX", "Plane": {"PositionX": [100.0 * number], "PositionY": [0.0]}}
            tif.write(plane, photometric="minisblack", metadata=meta)
    assert "5 equal series" in the_error(path)
    assert np.array_equal(read_stack(path, 3).data[0, 0], PLANES[3])


def test_single_images_with_labels_of_the_stage_are_no_focus_planes(tmp_path):
    path = tmp_path / "places.ome.tif"
    in_a_loop(path, ome=True)
    with tifffile.TiffFile(path) as tif:
        xml = tif.ome_metadata
    numbers = iter(range(5))
    labelled = re.sub("<Pixels ", lambda found: f'<StageLabel Name="Pos{next(numbers)}"/>{found[0]}', xml)
    tifffile.tiffcomment(path, labelled.encode())
    assert "5 equal series" in the_error(path)


def test_a_file_of_one_stack_has_the_series_0(tmp_path):
    path = tmp_path / "stack.ome.tif"
    write_stack(path, STACKS[0])
    assert np.array_equal(read_stack(path, 0).data, STACKS[0])
    assert "series 1 must be from 0 to 0" in the_error(path, 1)


def test_a_format_without_series_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(stack_module, "FORMATS", [Format("NumPy", (".npy",), read_stack)])
    path = tmp_path / "stack.npy"
    np.save(path, PLANES)
    assert "series 1: a file in NumPy holds one" in the_error(path, 1)


# --- time -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["ome", "imagej"])
@pytest.mark.parametrize("axes", ["TYX", "TCYX"])
def test_time_is_taken_for_the_focus_where_there_is_no_other_and_said_by_name(tmp_path, how, axes):
    path = tmp_path / "movie.tif"
    data = PLANES if axes == "TYX" else np.stack([PLANES, PLANES + 1000], 1)
    tifffile.imwrite(path, data, metadata={"axes": axes}, photometric="minisblack", **{how: True})
    with pytest.warns(StackWarning, match=r"axis of time, T \(5\), is taken as the focus"):
        stack = read_stack(path)
    assert np.array_equal(stack.data, PLANES[None] if axes == "TYX" else data.transpose(1, 0, 2, 3))


# --- an OME-TIFF in one file or several -------------------------------------------------------------------------------


def ome_with(path, planes, own="", name="first.ome.tif"):
    """An OME-TIFF of PLANES whose XML is changed: own is the file's identity, planes the TiffData."""
    tifffile.imwrite(path, PLANES, ome=True, photometric="minisblack", metadata={"axes": "ZYX"})
    with tifffile.TiffFile(path) as tif:
        xml = tif.ome_metadata
    xml = re.sub(r' UUID="urn:uuid:[^"]*"', own, xml, count=1)
    tifffile.tiffcomment(path, re.sub(r"<TiffData[^>]*/>", planes, xml).encode())


def plane(number, name, identity="1", ifd=None):
    place = f'FirstZ="{number}" FirstC="0" FirstT="0" PlaneCount="1"'
    ifd = number if ifd is None else ifd
    return f'<TiffData IFD="{ifd}" {place}><UUID FileName="{name}">urn:uuid:{identity}</UUID></TiffData>'


@pytest.mark.parametrize("own", ["", ' UUID="urn:uuid:1"'])
@pytest.mark.parametrize("name", ["first.ome.tif", "cell 3.ome.tif", "Größe.tif"])
def test_a_renamed_file_that_holds_its_whole_stack_is_read(tmp_path, name, own):
    path = tmp_path / name
    ome_with(path, "".join(plane(i, "first.ome.tif") for i in range(5)), own)
    assert np.array_equal(read_stack(path).data, PLANES[None])


def test_a_renamed_file_keeps_the_order_that_its_xml_gives(tmp_path):
    path = tmp_path / "renamed.ome.tif"
    ome_with(path, "".join(plane(4 - i, "first.ome.tif", ifd=i) for i in range(5)))
    assert np.array_equal(read_stack(path).data, PLANES[None, ::-1])


def test_a_renamed_file_without_some_of_its_planes_is_refused(tmp_path):
    path = tmp_path / "renamed.ome.tif"
    ome_with(path, "".join(plane(i, "first.ome.tif", ifd=i + 2) for i in range(5)))
    assert "planes that it lists are missing" in the_error(path)


def test_a_set_of_files_names_the_one_that_is_missing_and_is_read_where_none_is(tmp_path):
    first, second = tmp_path / "first.ome.tif", tmp_path / "second.ome.tif"
    names = [(first.name, "1", i) if i < 3 else (second.name, "2", i - 3) for i in range(5)]
    planes = "".join(plane(i, name, identity, ifd) for i, (name, identity, ifd) in enumerate(names))
    ome_with(first, planes)
    message = the_error(first)
    assert "second.ome.tif is missing" in message
    ome_with(second, planes)  # its first two pages are planes 0 and 1
    expected = np.concatenate([PLANES[:3], PLANES[:2]])
    assert np.array_equal(read_stack(first).data, expected[None])
    second.write_bytes(second.read_bytes()[:600])
    with pytest.raises(StackError, match=r"second\.ome\.tif: truncated"):
        read_stack(first)


def test_a_part_of_a_set_that_has_no_xml_of_its_own_names_the_file_that_has(tmp_path):
    path = tmp_path / "part.ome.tif"
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
        '<BinaryOnly MetadataFile="whole.companion.ome" UUID="urn:uuid:1"/></OME>'
    )
    tifffile.imwrite(path, PLANES, description=xml, photometric="minisblack", metadata=None)
    assert "whole.companion.ome" in the_error(path)


# --- palettes ---------------------------------------------------------------------------------------------------------


def with_palette(path, palette, data):
    tifffile.imwrite(path, data, photometric="palette", colormap=palette, metadata=None)


@pytest.mark.parametrize("factor", [256, 257])
def test_a_grey_ramp_as_a_palette_is_grey(tmp_path, factor):
    path = tmp_path / "stack.tif"
    data = (PLANES % 256).astype(np.uint8)
    with_palette(path, np.tile(np.arange(256, dtype=np.uint16) * factor, (3, 1)), data)
    stack = read_stack(path)
    assert np.array_equal(stack.data, data[None])
    assert stack.data.dtype == np.uint8
    assert stack.saturation == 255


def test_greys_in_another_order_are_what_the_palette_says(tmp_path):
    path = tmp_path / "stack.tif"
    data = (PLANES % 256).astype(np.uint8)
    with_palette(path, np.tile(np.arange(256, dtype=np.uint16)[::-1] * 257, (3, 1)), data)
    assert np.array_equal(read_stack(path).data, 255 - data[None])


def test_pillows_palette_of_greys_is_grey(tmp_path):
    path = tmp_path / "stack.tif"
    data = (PLANES % 256).astype(np.uint8)
    first, *others = (Image.fromarray(plane).convert("P") for plane in data)
    first.save(path, save_all=True, append_images=others)
    assert np.array_equal(read_stack(path).data, data[None])


def test_a_palette_of_colours_is_refused(tmp_path):
    path = tmp_path / "stack.tif"
    ramp = np.arange(256, dtype=np.uint16) * 257
    with_palette(path, np.stack([ramp, ramp[::-1], ramp]), (PLANES % 256).astype(np.uint8))
    assert "is not greyscale (a colour palette)" in the_error(path)


# --- axes that are written --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["x.ome.tif", "x.tif"])
@pytest.mark.parametrize(
    "shape", [(2, 2, 9, 7), (3, 3, 3, 3), (4, 4, 4, 4), (1, 5, 9, 7), (5, 1, 9, 7), (3, 9, 7), (3, 1, 9, 3), (9, 3)]
)
def test_a_stack_is_written_with_its_axes_and_never_transposed(tmp_path, name, shape):
    path = tmp_path / name
    data = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    write_stack(path, data)
    assert np.array_equal(read_stack(path).data, data.reshape((1,) * (4 - data.ndim) + shape))
    with tifffile.TiffFile(path) as tif:
        assert 'DimensionOrder="XYZCT"' in tif.ome_metadata


def test_axes_that_tifffile_chose_are_told_where_nothing_else_would_show_it(tmp_path):
    path = tmp_path / "x.ome.tif"
    data = np.arange(2 * 2 * 9 * 7, dtype=np.float32).reshape(2, 2, 9, 7)
    tifffile.imwrite(path, data, photometric="minisblack")
    with pytest.warns(StackWarning, match=r"Z \(2\) is taken as the focus and C \(2\) as the prism"):
        assert np.array_equal(read_stack(path).data, data.transpose(1, 0, 2, 3))
