import numpy as np
import pytest

from torchdic.errors import StackError
from torchdic.files import stack as stack_module
from torchdic.files.format import Format, Stack
from torchdic.files.stack import FORMATS, format_of, read_stack, write_stack
from torchdic.files.tiff import TIFF

RAMP = np.arange(2 * 3 * 9 * 7, dtype=np.uint16).reshape(2, 3, 9, 7)


def read_npy(path):
    return Stack(np.load(path), pixel_size=(0.2, 0.1), source=str(path))


def write_npy(path, stack, compression):
    with path.open("wb") as file:
        np.save(file, stack.data)


NPY = Format("NumPy", (".npy",), read_npy, write_npy, dtypes=("uint16", "float32"))


@pytest.fixture
def with_npy(monkeypatch):
    """A format that torchdic does not have, added by one row."""
    monkeypatch.setattr(stack_module, "FORMATS", [*FORMATS, NPY])


@pytest.mark.usefixtures("with_npy")
def test_a_format_is_added_by_one_row(tmp_path):
    path = tmp_path / "stack.NPY"
    write_stack(path, RAMP)
    assert np.array_equal(np.load(path), RAMP)
    stack = read_stack(path)
    assert np.array_equal(stack.data, RAMP)
    assert stack.pixel_size == (0.2, 0.1)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.usefixtures("with_npy")
def test_every_format_is_guarded_alike(tmp_path):
    path = tmp_path / "stack.npy"
    with pytest.raises(StackError, match="no such file"):
        read_stack(path)
    np.save(path, np.full((1, 1, 2, 2), np.nan))
    with pytest.raises(StackError, match="4 of 4 pixels are not finite"):
        read_stack(path)
    path.write_bytes(b"no array")
    with pytest.raises(StackError, match=r"stack\.npy: cannot be read as NumPy: ValueError"):
        read_stack(path)
    with pytest.raises(StackError, match="pixels are int64, the file can hold uint16, float32"):
        write_stack(path, RAMP.astype(np.int64))
    with pytest.raises(StackError, match="would be empty"):
        write_stack(path, RAMP[:0])
    with pytest.raises(StackError, match="not finite"):
        write_stack(path, np.full((2, 2), np.inf, np.float32))
    assert path.read_bytes() == b"no array"


def test_a_format_that_is_only_read_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(stack_module, "FORMATS", [Format("NumPy", (".npy",), read_npy), *FORMATS])
    with pytest.raises(StackError, match=r"stack\.npy: NumPy can be read but not written.*\.ome\.tif"):
        write_stack(tmp_path / "stack.npy", RAMP)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["stack.tif", "stack.TIFF", "stack.ome.tif", "stack.ome.btf", "stack.dat", "stack"])
def test_a_suffix_that_no_format_has_is_taken_for_tiff(tmp_path, name):
    assert format_of(name) is TIFF
    write_stack(tmp_path / name, RAMP)
    assert np.array_equal(read_stack(tmp_path / name).data, RAMP)


def test_a_file_of_unknown_suffix_and_content_is_no_tiff(tmp_path):
    path = tmp_path / "stack.vsi"
    path.write_bytes(b"\xda\xce\xbe\x0a and so on")
    with pytest.raises(StackError, match="is no TIFF: it starts with"):
        read_stack(path)


@pytest.mark.parametrize(("dtype", "step"), [(np.uint8, 7), (np.uint16, 1000)])
def test_a_grey_png_is_one_plane(tmp_path, dtype, step):
    import imagecodecs

    grey = np.arange(35, dtype=dtype).reshape(5, 7) * dtype(step)
    for name, image in (("grey", grey), ("rgb", np.stack([grey] * 3, -1)), ("alpha", np.stack([grey] * 4, -1))):
        (tmp_path / f"{name}.png").write_bytes(imagecodecs.png_encode(image))
        assert np.array_equal(read_stack(tmp_path / f"{name}.png").data[0, 0], grey)
    coloured = np.stack([grey, grey, grey[::-1]], -1)
    (tmp_path / "coloured.png").write_bytes(imagecodecs.png_encode(coloured))
    with pytest.raises(StackError, match=r"is a colour image, 3 samples per pixel; .* in Fiji, Image > Type > 16-bit"):
        read_stack(tmp_path / "coloured.png")
    with pytest.raises(StackError, match="PNG can be read but not written"):
        write_stack(tmp_path / "out.png", grey)
