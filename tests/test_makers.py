"""Files of microscopes' makers, and of Micro-Manager.

CZI and NDTiff are written by their makers' own packages, LIF and ND2 byte by byte, see benchmarks/makers.py.
"""

import importlib
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from recon.cli import main
from recon.config import load
from torchdic.errors import StackError, StackWarning
from torchdic.files.gathered import gather
from torchdic.files.stack import read_stack

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    formats, makers = map(importlib.import_module, ("formats", "makers"))

STEPS = {"Z": -0.3e-6, "Y": 0.12e-6, "X": 0.11e-6}  # Leica's z may run downward
PACKAGES = {"czi": "pylibCZIrw", "lif": "liffile", "nd2": "nd2"}


def counts(scenes=2, channels=2, planes=4, size=(6, 8)):
    random = np.random.default_rng(0)
    return random.integers(0, 4000, (scenes, channels, planes, *size)).astype(np.uint16)


def of_maker(folder, kind, data):
    pytest.importorskip(PACKAGES[kind], reason="the extra [bio] isn't installed")
    path = folder / f"stack.{kind}"
    if kind == "czi":
        return makers.write_czi(path, data)
    if kind == "lif":
        return makers.write_lif(
            path, *(makers.lif_image(f"image {n}", scene, "CZYX", STEPS) for n, scene in enumerate(data))
        )
    return makers.write_nd2(path, data.swapaxes(1, 2))


@pytest.mark.parametrize("kind", PACKAGES)
def test_one_of_several_stacks_is_read_with_its_sizes_and_its_microscope(tmp_path, kind):
    data = counts()
    path = of_maker(tmp_path, kind, data)
    with warnings.catch_warnings(action="error"):
        found = gather([path], series=1)
    stack, setup = found.stack, found.setup
    np.testing.assert_array_equal(stack.data, data[1])
    assert stack.data.dtype == np.uint16
    assert stack.pixel_size == ((0.11, 0.11) if kind == "nd2" else (0.12, 0.11))
    assert (stack.focus_step, stack.bits) == (0.3, 12)
    assert stack.names == {"czi": ("plus", "minus"), "lif": (), "nd2": ("DIC 0", "DIC 1")}[kind]
    assert (setup.na, setup.immersion) == {"czi": (1.4, 1.515), "lif": (1.4, 1.518), "nd2": (1.2, 1.333)}[kind]
    assert setup.objective == {"czi": "Plan-Apo", "lif": "HC PL APO 63x/1.40 OIL", "nd2": "Plan Apo"}[kind]


@pytest.mark.parametrize("kind", PACKAGES)
def test_several_stacks_are_refused_with_what_takes_one(tmp_path, kind):
    path = of_maker(tmp_path, kind, counts())
    with pytest.raises(StackError, match=r"series = 0 … 1 in \[data\], or --series of torchdic new, takes one"):
        read_stack(path)
    with pytest.raises(StackError, match="series 2 must be from 0 to 1: the file holds 2"):
        read_stack(path, 2)


@pytest.mark.parametrize("kind", PACKAGES)
def test_the_only_stack_needs_no_number_and_new_writes_a_configuration_for_it(tmp_path, kind, capsys):
    random = np.random.default_rng(0)
    data = random.poisson(1000, (1, 1, 3, 32, 32)).astype(np.uint16)
    path = of_maker(tmp_path, kind, data)
    assert main(["new", str(path), "--out", str(tmp_path / "run.toml")]) == 0
    config = load(tmp_path / "run.toml")
    assert config.data is not None
    assert config.data.files == (str(path),)
    np.testing.assert_array_equal(read_stack(path).data, data[0])
    assert "0.11" in capsys.readouterr().out


@pytest.mark.parametrize("kind", PACKAGES)
def test_a_file_that_was_cut_off_is_refused_in_a_line(tmp_path, kind):
    path = of_maker(tmp_path, kind, counts(scenes=1))
    whole = path.read_bytes()
    for part in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(StackError, match=rf"stack\.{kind}: ") as caught:
            read_stack(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("kind", "package"), PACKAGES.items())
def test_a_missing_package_is_named_with_how_to_install_it(tmp_path, monkeypatch, kind, package):
    for name in (package, f"{package}.czi"):
        monkeypatch.setitem(sys.modules, name, None)
    path = tmp_path / f"stack.{kind}"
    path.write_bytes(b"bytes of a maker")
    line = rf"read by the package {package}, which is missing: pip install 'torchdic\[bio\]'"
    with pytest.raises(StackError, match=line):
        gather([path])


# --- Micro-Manager's NDTiff -------------------------------------------------------------------------------------------


def ndtiff(folder, **how):
    pytest.importorskip("ndstorage", reason="ndstorage, Micro-Manager's own writer, isn't installed")
    return makers.write_ndtiff(folder, counts()[0], **how)


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # ndstorage leaves its files to the collector
def test_an_ndtiff_is_read_from_its_folder_or_its_file(tmp_path):
    file = ndtiff(tmp_path / "acquired")
    for path in (file, file.parent):
        stack = gather([path]).stack
        np.testing.assert_array_equal(stack.data, counts()[0])
        assert (stack.pixel_size, stack.focus_step, stack.bits) == ((0.11, 0.11), 0.3, 12)
        assert stack.names == ("plus", "minus")


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_a_plane_that_an_ndtiff_lacks_is_refused(tmp_path):
    file = ndtiff(tmp_path / "acquired", written=lambda place: place != (1, 2))
    with pytest.raises(StackError, match="1 of 8 planes that it lists are missing"):
        read_stack(file)


# --- OME-Zarr by another writer ---------------------------------------------------------------------------------------


def test_an_ome_zarr_of_another_writer_is_read(tmp_path):
    pytest.importorskip("yaozarrs", reason="yaozarrs, another writer of OME-Zarr, isn't installed")
    stack = read_stack(makers.write_zarr(tmp_path / "a.ome.zarr", counts()[0]))
    np.testing.assert_array_equal(stack.data, counts()[0])
    assert stack.pixel_size == pytest.approx((0.12, 0.11))
    assert stack.focus_step == pytest.approx(0.3)
    assert stack.names == ("plus", "minus")
    several = makers.write_zarr(tmp_path / "b.ome.zarr", counts(), several=True)
    np.testing.assert_array_equal(read_stack(several, 1).data, counts()[1])
    with pytest.raises(StackError, match=r"holds 2 images; a stack is one: series = 0 … 1"):
        read_stack(several)


# --- the tables of benchmarks/formats.py ------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")  # napari's own modules warn of what they'll change
@pytest.mark.parametrize("row", formats.FOREIGN, ids=lambda row: row.format)
def test_what_a_file_says_is_kept(tmp_path, row):
    try:
        cells = formats.read_row(row, tmp_path)
    except ImportError as error:
        pytest.skip(f"what writes it isn't installed: {error}")
    assert formats.LOST not in cells
    assert formats.KEPT in cells


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("suffix", "kind", "reader", "way"), list(formats.opened_rows(None)))
def test_what_is_written_is_opened_by_others(tmp_path, suffix, kind, reader, way):
    try:
        *same, scale, unit, names = formats.opened_row(suffix, way, tmp_path)
    except ImportError as error:
        pytest.skip(f"{reader} isn't installed: {error}")
    assert same == [formats.KEPT, formats.KEPT]
    assert scale == "0.3 × 0.12 × 0.11"
    assert unit in ("µm", "micrometer")
    assert all(name in names for name in ("delta n", "plus", "minus"))


# --- what one format has alone ----------------------------------------------------------------------------------------


def test_a_plane_that_a_czi_lacks_is_named(tmp_path):
    pytest.importorskip("pylibCZIrw")
    path = makers.write_czi(tmp_path / "a.czi", counts(scenes=1), written=lambda place: place != (0, 1, 2))
    with pytest.raises(StackError, match="its plane Z 2, C 1, counted from 0, is missing"):
        read_stack(path)


def test_channels_of_a_czi_with_unlike_pixels_are_refused(tmp_path):
    pytest.importorskip("pylibCZIrw")
    path = makers.write_czi(tmp_path / "a.czi", counts(scenes=1), kinds=(np.uint16, np.uint8))
    with pytest.raises(StackError, match=r"pixels of several kinds \(Gray16, Gray8\)"):
        read_stack(path)


def test_a_coloured_czi_is_refused(tmp_path):
    pytest.importorskip("pylibCZIrw")
    data = np.stack([counts(1, 1, 1)] * 3, -1)
    path = makers.write_czi(tmp_path / "a.czi", data)
    with pytest.raises(StackError, match="is a colour image, 3 samples per pixel"):
        read_stack(path)


def test_time_in_a_lif_is_taken_as_the_focus(tmp_path):
    pytest.importorskip("liffile")
    path = makers.write_lif(tmp_path / "a.lif", makers.lif_image("a", counts()[0, 0], "TYX", STEPS))
    with pytest.warns(StackWarning, match="axis of time"):
        assert read_stack(path).data.shape == (1, 4, 6, 8)


def test_tiles_of_a_lif_are_refused(tmp_path):
    pytest.importorskip("liffile")
    path = makers.write_lif(tmp_path / "a.lif", makers.lif_image("tiles", counts(1)[0], "MZYX", STEPS))
    with pytest.raises(StackError, match=r"tiles has axes of M \(2\) beside T, Z, C, Y and X"):
        read_stack(path)


def test_an_nd2_that_was_never_calibrated_has_no_pixel_size(tmp_path):
    pytest.importorskip("nd2")
    path = makers.write_nd2(tmp_path / "a.nd2", counts(1).swapaxes(1, 2), pixel=1.0, calibrated=False)
    stack = read_stack(path)
    assert (stack.pixel_size, stack.focus_step) == (None, 0.3)
