"""A stack whose prisms lie in several files, or as channels in another order."""

import numpy as np
import pytest
import tomli_w
from refusal import the_error

from recon.config import dump, load
from recon.run.data import load_data
from torchdic.errors import StackError, StackWarning
from torchdic.files.joined import read_joined
from torchdic.files.stack import write_stack

PLANES, ROWS, COLUMNS = 3, 12, 14


@pytest.fixture
def images():
    """Four prisms' images, each of its own level; counts."""
    random = np.random.default_rng(0)
    levels = np.array([100, 200, 300, 400])[:, None, None, None]
    return (levels + random.normal(0, 3, (4, PLANES, ROWS, COLUMNS))).round().astype(np.uint16)


@pytest.fixture
def put(tmp_path):
    """A function that writes data as a file; returns its path."""

    def write(name, data, pixel=(0.2, 0.2), step=0.5):
        write_stack(tmp_path / name, data, pixel, step)
        return str(tmp_path / name)

    return write


# --- files ------------------------------------------------------------------------------------------------------------


def test_channels_of_files_are_the_prisms_in_the_order_of_the_files(put, images):
    paths = [put("a.ome.tif", images[:1]), put("b.ome.tif", images[1:3]), put("c.ome.tif", images[3])]
    found = read_joined(paths)
    assert np.array_equal(found.data, images)
    assert found.data.dtype == np.uint16
    assert (found.pixel_size, found.focus_step) == (pytest.approx((0.2, 0.2)), pytest.approx(0.5))
    assert all(path in found.source for path in paths)


def test_single_images_are_prisms_of_one_plane(put, images):
    paths = [put(f"{i}.tif", images[i, 0]) for i in range(3)]
    assert np.array_equal(read_joined(paths).data, images[:3, :1])


def test_channels_of_one_file_come_in_the_order_that_is_given(put, images):
    path = put("a.ome.tif", images)
    assert np.array_equal(read_joined([path], [2, 0]).data, images[[2, 0]])
    assert np.array_equal(read_joined([path]).data, images)


def test_a_channel_of_each_file_is_taken(put, images):
    a, b = put("a.ome.tif", images[:2]), put("b.ome.tif", images[2:])
    assert np.array_equal(read_joined([b, a, b], [1, 0, 0]).data, images[[3, 0, 2]])


def test_a_channel_that_a_file_has_not_is_named(put, images):
    path = put("a.ome.tif", images[:2])
    with pytest.raises(StackError, match=r"a\.ome\.tif: has 2 channels, counted from 0; there is no channel 2$"):
        read_joined([path], [0, 2])


def test_a_missing_file_is_named(put, images, tmp_path):
    with pytest.raises(StackError, match=r"b\.tif: no such file"):
        read_joined([put("a.tif", images[0]), str(tmp_path / "b.tif")])


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (np.full((PLANES - 1, ROWS, COLUMNS), 7, np.uint16), r"2 × 12 × 14, but .*a\.tif has 3 × 12 × 14"),
        (np.full((PLANES, ROWS, COLUMNS + 1), 7, np.uint16), r"3 × 12 × 15, but .*a\.tif has 3 × 12 × 14"),
        (np.full((PLANES, ROWS, COLUMNS), 7, np.uint8), r"uint8, but .*a\.tif has uint16"),
        (np.full((PLANES, ROWS, COLUMNS), 7, np.float32), r"float32, but .*a\.tif has uint16"),
    ],
)
def test_files_that_differ_are_no_stack(put, images, other, words):
    with pytest.raises(StackError, match=rf"b\.tif: .*{words}: the files of one stack have the same$"):
        read_joined([put("a.tif", images[0]), put("b.tif", other)])


def test_sizes_that_differ_are_warned_of(put, images):
    paths = [put("a.ome.tif", images[0]), put("b.ome.tif", images[1], pixel=(0.3, 0.3))]
    with pytest.warns(StackWarning, match=r"b\.ome\.tif: its pixel size is .*0\.3.*the latter is used"):
        assert read_joined(paths).pixel_size == pytest.approx((0.2, 0.2))


# --- in a configuration -----------------------------------------------------------------------------------------------

PRISMS = [{"shear": [0.0, 0.2], "bias": 1.5}, {"shear": [0.2, 0.0], "bias": 1.5}, "brightfield"]
WITH_BRIGHT_FIELD = [*PRISMS[:2], {"brightfield": True}]


@pytest.fixture
def config(tmp_path):
    """A function from [data] and what each prism says of its images to a configuration's path."""

    def write(data, *of_prisms):
        told = [base | more for base, more in zip(WITH_BRIGHT_FIELD, of_prisms, strict=False)] if of_prisms else PRISMS
        values = {
            "volume": {"shape": [4, ROWS, COLUMNS], "spacing": [0.5, 0.2, 0.2], "background": 1.335},
            "microscope": {"wavelength": 0.546, "objective": {"na": 0.9}, "condenser": {"na": 0.7}},
            "acquisition": {"focus": [-0.5, 0.0, 0.5], "prisms": told},
        }
        path = tmp_path / "config.toml"
        path.write_text(tomli_w.dumps(values | ({} if data is None else {"data": data})), encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize(
    ("data", "of_prisms", "order"),
    [
        ({"paths": ["b.ome.tif", "a.ome.tif"], "channels": [1, 0]}, (), None),
        ({"paths": ["b.ome.tif", "b.ome.tif", "a.ome.tif"], "channels": [1, 0, 0]}, (), [3, 2, 0]),
        (
            None,
            [
                {"file": "b.ome.tif", "channel": 1},
                {"file": "b.ome.tif", "channel": 0},
                {"file": "a.ome.tif", "channel": 0},
            ],
            [3, 2, 0],
        ),
        ({"path": "all.ome.tif", "channels": [3, 2, 0]}, (), [3, 2, 0]),
        ({"path": "all.ome.tif"}, [{"channel": 3}, {"channel": 2}, {"channel": 0}], [3, 2, 0]),
        (None, [{"file": "2.tif"}, {"file": "1.tif"}, {"file": "0.tif"}], [2, 1, 0]),
        ({"offset": 0}, [{"file": "2.tif"}, {"file": "1.tif"}, {"file": "0.tif"}], [2, 1, 0]),
    ],
)
def test_a_configuration_finds_each_prisms_images(put, images, config, data, of_prisms, order):
    put("all.ome.tif", images)
    put("a.ome.tif", images[:2])
    put("b.ome.tif", images[2:])
    for i in range(3):
        put(f"{i}.tif", images[i])
    path = config(data, *of_prisms)
    if order is None:  # two files for three prisms
        with pytest.raises(
            StackError, match=r"2 prisms × 3 planes, acquisition\.prisms and acquisition\.focus say 3 × 3"
        ):
            load_data(load(path))
        return
    measured = load_data(load(path))
    assert [report.background for report in measured.prisms] == pytest.approx(
        [np.median(images[i]) for i in order], rel=0.02
    )
    resolved = dump(load(path))
    path.write_text(resolved, encoding="utf-8")
    assert dump(load(path)) == resolved


@pytest.mark.parametrize(
    ("data", "of_prisms", "message"),
    [
        ({"path": "a.tif", "paths": ["a.tif"]}, (), "data: path and paths say the same: leave one out"),
        ({"paths": []}, (), "data: paths must hold at least one file"),
        ({"offset": 3}, (), "missing key data.path"),
        ({"paths": ["a.tif", "b.tif"], "channels": [0]}, (), "data: channels [0] must be as many as the 2 paths"),
        ({"path": "a.tif", "channels": [0, -1]}, (), "data: channels [0, -1] must be at least one, each at least 0"),
        ({"path": "a.tif", "channels": [0.0]}, (), "data.channels[0]: 0.0 must be a whole number"),
        (
            {"path": "a.tif"},
            [{"file": "a.tif"}, {"file": "b.tif"}],
            "data.path and acquisition.prisms[0].file say the same: leave one out",
        ),
        (
            {"path": "a.tif", "channels": [0, 1]},
            [{"channel": 0}, {"channel": 1}],
            "data.channels and acquisition.prisms[0].channel say the same: leave one out",
        ),
        (None, [{"file": "a.tif"}, {}], "missing key acquisition.prisms[1].file: every prism has one, or none does"),
        ({"path": "a.tif"}, [{"chanel": 0}], "unknown key acquisition.prisms[0].chanel; did you mean 'channel'?"),
    ],
)
def test_what_does_not_say_where_the_images_are_is_refused(config, data, of_prisms, message):
    assert the_error(config(data, *of_prisms)).startswith(message)
