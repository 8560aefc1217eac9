"""OME-Zarr: what is written is read again, by others too, and what others write is read."""

import json
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.cli import main
from recon.config import load
from recon.config.schema import ConfigError
from recon.run.folder.prepared import check_folder
from torchdic import Grid
from torchdic.errors import StackError, StackWarning
from torchdic.files.gathered import gather
from torchdic.files.stack import read_stack, read_volume, write_stack, write_volume

zarr = pytest.importorskip("zarr", reason="the extra [zarr] isn't installed")

SUFFIXES = pytest.mark.parametrize("suffix", [".zarr", ".ome.zarr"])
GRID = Grid((3, 5, 7), (0.5, 0.2, 0.1))


def counts(*shape, dtype="uint16"):
    return np.arange(np.prod(shape), dtype=dtype).reshape(shape)


def by_hand(folder, data, axes, scale, **more):
    """An image of version 0.4 that no library has written: JSON and bytes, a chunk for each array."""
    (folder / "0").mkdir(parents=True)
    (folder / ".zgroup").write_text('{"zarr_format": 2}')
    datasets = [{"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}]
    image = {"version": "0.4", "axes": axes, "datasets": datasets, **more}
    (folder / ".zattrs").write_text(json.dumps({"multiscales": [image]}))
    array = {"zarr_format": 2, "shape": data.shape, "chunks": data.shape, "dtype": data.dtype.str, "order": "C"}
    array |= {"compressor": None, "fill_value": 0, "filters": None, "dimension_separator": "/"}
    (folder / "0" / ".zarray").write_text(json.dumps(array))
    chunk = folder.joinpath("0", *["0"] * data.ndim)
    chunk.parent.mkdir(parents=True)
    chunk.write_bytes(data.tobytes())
    return folder


def axes_of(letters, unit="micrometer"):
    kinds = {"t": "time", "c": "channel"}
    return [{"name": n, "type": kinds.get(n, "space")} | ({} if n in kinds else {"unit": unit}) for n in letters]


@SUFFIXES
@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32"])
def test_a_stack_comes_back_as_it_was(tmp_path, suffix, compression, dtype):
    data, path = counts(2, 3, 5, 7, dtype=dtype), tmp_path / f"stack{suffix}"
    write_stack(path, data, (0.2, 0.1), 0.5, names=("plus", "minus"), compression=compression)
    stack = read_stack(path)
    np.testing.assert_array_equal(stack.data, data)
    assert stack.data.dtype == data.dtype
    assert (stack.pixel_size, stack.focus_step, stack.names) == ((0.2, 0.1), 0.5, ("plus", "minus"))
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@SUFFIXES
def test_sizes_that_are_not_known_stay_unknown(tmp_path, suffix):
    path = tmp_path / f"stack{suffix}"
    write_stack(path, counts(1, 3, 5, 7))
    stack = read_stack(path)
    assert (stack.pixel_size, stack.focus_step, stack.names) == (None, None, ())


@SUFFIXES
@pytest.mark.parametrize("slices", [1, 3])
def test_a_volume_comes_back_and_replaces_an_earlier_one(tmp_path, suffix, slices):
    given = replace(GRID, shape=(slices, 5, 7))
    path, delta = tmp_path / f"volume{suffix}", torch.rand(given.shape)
    write_volume(path, torch.zeros(given.shape), given)
    write_volume(path, delta, given)
    found, grid = read_volume(path)
    assert torch.equal(found, delta)
    assert grid == given
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(("suffix", "version"), [(".zarr", "v04"), (".ome.zarr", "v05")])
def test_what_is_written_is_what_the_specification_asks_for(tmp_path, suffix, version):
    models = pytest.importorskip(f"ome_zarr_models.{version}.image", reason="ome-zarr-models isn't installed")
    path = tmp_path / f"volume{suffix}"
    write_volume(path, torch.rand(GRID.shape), GRID, name="Δn")
    found = models.Image.from_zarr(zarr.open_group(str(path), mode="r")).attributes
    image = (found if version == "v04" else found.ome).multiscales[0]
    assert image.name == "Δn"
    assert [axis.unit for axis in image.axes] == [None, *["micrometer"] * 3]
    assert image.datasets[0].coordinateTransformations[0].scale == [1.0, *GRID.spacing]
    write_stack(tmp_path / f"stack{suffix}", counts(2, 3, 5, 7), names=("plus", "minus"))  # without sizes
    found = models.Image.from_zarr(zarr.open_group(str(tmp_path / f"stack{suffix}"), mode="r")).attributes
    said = found if version == "v04" else found.ome
    assert [axis.unit for axis in said.multiscales[0].axes] == [None] * 4


@SUFFIXES
def test_an_array_within_one_is_refused_and_so_are_results_in_it(tmp_path, suffix):
    path = tmp_path / f"stack{suffix}"
    write_stack(path, counts(1, 3, 5, 7))
    with pytest.raises(StackError, match="0: is an array alone; name the OME-Zarr that holds it"):
        read_stack(path / "0")
    for out in (path, path / "results"):
        with pytest.raises(ConfigError, match=rf"can't be written to: .*stack{suffix} is an OME-Zarr"):
            check_folder(out)
    check_folder(tmp_path / "results")


def test_numbers_of_another_byte_order_are_the_machines_own(tmp_path):
    data = counts(2, 3, 5, 7)
    path = by_hand(tmp_path / "s.zarr", data.astype(">u2"), axes_of("czyx"), [1.0, 0.5, 0.2, 0.1])
    assert torch.equal(torch.from_numpy(read_stack(path).data), torch.from_numpy(data))


@SUFFIXES
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_a_volume_in_a_file_is_written_without_being_held_in_memory(tmp_path, suffix, compression):
    grid, random = Grid((48, 128, 128), (0.5, 0.2, 0.1)), np.random.default_rng(0)
    delta = np.memmap(tmp_path / "delta.raw", np.float32, "w+", shape=grid.shape)
    for plane in delta:
        plane[:] = random.random(plane.shape)
    write_volume(tmp_path / f"small{suffix}", torch.zeros(GRID.shape), GRID)  # what is loaded at first doesn't count
    tracemalloc.start()
    write_volume(tmp_path / f"volume{suffix}", delta, grid, compression=compression)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < delta.nbytes / 2
    np.testing.assert_array_equal(read_volume(tmp_path / f"volume{suffix}")[0], delta)


def test_another_writers_image_is_read(tmp_path):
    data = counts(1, 2, 3, 5, 7)
    path = by_hand(tmp_path / "other.zarr", data, axes_of("tczyx", "nanometer"), [1.0, 1.0, 250.0, 50.0, 50.0])
    stack = read_stack(path)
    np.testing.assert_array_equal(stack.data, data[0])
    assert stack.pixel_size == pytest.approx((0.05, 0.05))
    assert stack.focus_step == pytest.approx(0.25)
    path.rename(tmp_path / "of any name")
    np.testing.assert_array_equal(read_stack(tmp_path / "of any name").data, data[0])


def test_scales_of_image_and_resolution_multiply(tmp_path):
    whole = [{"type": "scale", "scale": [2.0, 3.0, 3.0]}, {"type": "translation", "translation": [5.0, 5.0, 5.0]}]
    axes = axes_of("zyx")
    stack = read_stack(
        by_hand(tmp_path / "a", counts(3, 5, 7), axes, [0.25, 0.1, 0.1], coordinateTransformations=whole)
    )
    assert stack.focus_step == pytest.approx(0.5)
    assert stack.pixel_size == pytest.approx((0.3, 0.3))


def test_the_finest_of_several_resolutions_is_read(tmp_path):
    write_stack(tmp_path / "a.zarr", counts(1, 1, 8, 8), (0.1, 0.1))
    group = zarr.open_group(str(tmp_path / "a.zarr"), mode="r+")
    group.create_array("1", data=counts(1, 1, 4, 4))
    image = group.attrs["multiscales"][0]
    image["datasets"] += [{"path": "1", "coordinateTransformations": [{"type": "scale", "scale": [1, 1, 0.2, 0.2]}]}]
    group.attrs["multiscales"] = [image]
    stack = read_stack(tmp_path / "a.zarr")
    assert stack.data.shape == (1, 1, 8, 8)
    assert stack.pixel_size == pytest.approx((0.1, 0.1))


def test_time_is_taken_as_the_focus_where_there_is_none(tmp_path):
    path = by_hand(tmp_path / "a.zarr", counts(4, 5, 7), axes_of("tyx"), [1.0, 0.1, 0.1])
    with pytest.warns(StackWarning, match="axis of time"):
        assert read_stack(path).data.shape == (1, 4, 5, 7)


def test_one_of_several_images_is_chosen(tmp_path):
    folder = tmp_path / "several.zarr"
    zarr.open_group(str(folder), mode="w", zarr_format=2).attrs["bioformats2raw.layout"] = 3
    for number in range(2):
        by_hand(folder / str(number), counts(2, 5, 7) + number, axes_of("zyx"), [1.0, 0.1, 0.1])
    with pytest.raises(StackError, match="holds 2 images; a stack is one: series = 0 … 1"):
        read_stack(folder)
    assert read_stack(folder, 1).data.flat[0] == 1
    with pytest.raises(StackError, match="series 2 must be from 0 to 1"):
        read_stack(folder, 2)


@pytest.mark.parametrize(("said", "line"), [({"plate": {}}, "is a plate"), ({}, "holds no image of OME-Zarr")])
def test_what_is_no_image_is_refused(tmp_path, said, line):
    zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2).attrs.update(said)
    with pytest.raises(StackError, match=line):
        read_stack(tmp_path / "a.zarr")


def test_a_file_with_its_name_and_a_missing_one_are_refused(tmp_path):
    (tmp_path / "a.zarr").write_bytes(b"zip")
    with pytest.raises(StackError, match="is a file; OME-Zarr is a folder of files"):
        read_stack(tmp_path / "a.zarr")
    with pytest.raises(StackError, match="no such file"):
        read_stack(tmp_path / "b.zarr")


def test_an_empty_folder_with_its_name_is_refused(tmp_path):
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(StackError, match="holds nothing of Zarr's"):
        read_stack(tmp_path / "a.zarr")


def test_a_damaged_one_is_refused_in_a_line(tmp_path):
    path = by_hand(tmp_path / "a.zarr", counts(3, 5, 7), axes_of("zyx"), [1.0, 0.1, 0.1])
    (path / "0" / "0" / "0" / "0").write_bytes(b"short")
    with pytest.raises(StackError, match=r"a\.zarr: cannot be read as OME-Zarr"):
        read_stack(path)


def test_a_missing_package_is_named_with_its_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    (tmp_path / "a.zarr").mkdir()
    with pytest.raises(StackError, match=r"by the package zarr, which is missing: pip install 'torchdic\[zarr\]'"):
        read_stack(tmp_path / "a.zarr")


def test_an_error_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.zarr"
    write_stack(path, counts(1, 2, 5, 7))
    with pytest.raises(StackError, match="lzw"):
        write_stack(path, counts(1, 2, 5, 7) + 1, compression="lzw")
    assert read_stack(path).data.flat[0] == 0
    assert [file.name for file in tmp_path.iterdir()] == ["a.zarr"]


def test_settings_in_several_are_joined(tmp_path):
    for name in ("c1.zarr", "c2.zarr"):
        write_stack(tmp_path / name, counts(1, 2, 5, 7), (0.1, 0.1), 0.5)
    for paths in ([tmp_path], [tmp_path / "c1.zarr", tmp_path / "c2.zarr"]):
        assert gather(paths).stack.data.shape == (2, 2, 5, 7)


def test_new_writes_a_configuration_for_it(tmp_path, capsys):
    random = np.random.default_rng(0)
    data = random.poisson(1000, (1, 3, 32, 32)).astype(np.uint16)
    write_stack(tmp_path / "stack.ome.zarr", data, (0.1, 0.1), 0.5)
    assert main(["new", str(tmp_path / "stack.ome.zarr"), "--out", str(tmp_path / "run.toml")]) == 0
    config = load(tmp_path / "run.toml")
    assert config.data is not None
    assert config.data.files == (str(tmp_path / "stack.ome.zarr"),)
    assert config.volume.shape[1:] == (32, 32)
    assert "0.1" in capsys.readouterr().out
