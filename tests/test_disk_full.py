"""A full disk costs what has no room, and nothing else."""

import errno
import resource
import warnings
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tifffile
import tomli_w
import torch
from matplotlib.figure import Figure
from results import BESIDE, RESULTS

from recon.cli import main
from recon.fit.step import Step
from recon.report import figures
from recon.run import checkpoint
from recon.run.checkpoint import Checkpoint, UnsavedWarning
from recon.run.log import open_log
from torchdic import Grid
from torchdic.errors import StackError
from torchdic.files.stack import read_volume, write_stack, write_volume
from torchdic.files.whole import WriteError, write_text, written_whole

SHAPE = (2, 3, 14, 12)
CONFIG = {
    "volume": {"shape": [4, 14, 12], "spacing": [0.5, 0.25, 0.25], "background": 1.5},
    "microscope": {"wavelength": 0.546, "objective": {"na": 0.6}, "condenser": {"na": 0.3}},
    "acquisition": {
        "focus": [-0.5, 0.0, 0.5],
        "prisms": [{"shear": [0.0, 0.24], "bias": 1.5}, {"shear": [0.24, 0.0], "bias": -1.2}],
    },
    "fidelity": {"sources": 3},
    "reconstruction": {"steps": 2, "checkpoint_every": 1},
    "specimen": {"kind": "gaussian_ball", "sigma": 0.4, "contrast": 0.02},
    "data": {"path": "stack.ome.tif"},
}


@pytest.fixture
def full(monkeypatch):
    """A function after which files of these names have no room."""

    def fill(*names):
        replace = Path.replace

        def fails(path, target):
            if Path(target).name in names:
                raise OSError(errno.ENOSPC, "No space left on device", str(path))
            return replace(path, target)

        monkeypatch.setattr(Path, "replace", fails)

    return fill


@contextmanager
def limited():
    """No file may grow beyond 8 KiB, as where a disk is full; nor may pytest's own output, so no longer than needed."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def run(tmp_path, capsys, no_pictures):
    """A function that runs a command on CONFIG; returns (exit code, lines on stderr without the bar, what is left)."""
    light = 0.5 + 0.05 * np.random.default_rng(0).standard_normal(SHAPE)
    write_stack(tmp_path / "stack.ome.tif", light.astype(np.float32))
    (tmp_path / "config.toml").write_text(tomli_w.dumps(CONFIG), encoding="utf-8")

    def call(command, *options):
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            code = main([command, str(tmp_path / "config.toml"), "--out", str(tmp_path / "out"), *options])
        lines = capsys.readouterr().err.replace("\r", "\n").split("\n")
        told = [line for line in lines if line.startswith("torchdic: ")]
        return code, told, {path.name for path in (tmp_path / "out").iterdir()}

    return call


def test_a_checkpoint_without_room_is_told_and_the_run_goes_on(run, full):
    full("checkpoint.pt")
    code, told, left = run("reconstruct")
    assert code == 0
    assert len([line for line in told if "checkpoint.pt: cannot be written: No space left on device" in line]) == 1
    assert left == RESULTS - {"checkpoint.pt"}


@pytest.mark.parametrize(
    "name", sorted(RESULTS - {"log.csv", "images.png", "sections.png", "misfit.png", "checkpoint.pt", *BESIDE})
)
def test_a_result_without_room_is_named_and_the_others_are_kept(run, full, name):
    full(name)
    code, told, left = run("reconstruct")
    assert code == 2
    assert told[-1].startswith("torchdic: error: ")
    assert (
        f"{name}: cannot be written: No space left on device; make room and go on with --resume, from step 2"
        in told[-1]
    )
    assert left == RESULTS - {name, *BESIDE} | {"checkpoint.pt"}


def test_an_index_without_room_is_told_and_loses_nothing(run, full):
    full("README.txt")
    code, told, left = run("reconstruct")
    assert code == 0
    assert "README.txt: cannot be written: No space left on device" in told[-1]
    assert left == RESULTS - {"README.txt"}


def test_a_picture_for_which_no_memory_is_left_is_named_and_the_others_are_kept(run, monkeypatch):
    def save(_, path):
        if path.name == "images.png":
            raise MemoryError("Unable to allocate 7.5 GiB for an array")
        path.touch()

    monkeypatch.setattr(figures, "save", save)
    code, told, left = run("reconstruct")
    assert code == 2
    assert "images.png: cannot be written: the memory ran out: another 7.5 GiB were asked for" in told[-1]
    assert told[-1].endswith("go on with --resume, from step 2")
    assert left == RESULTS - {"images.png", *BESIDE}


def test_a_run_whose_results_had_no_room_goes_on_to_write_them(run, monkeypatch, full, tmp_path):
    with monkeypatch.context() as patch:
        full("volume.ome.tif", "metrics.json")
        code, told, _ = run("reconstruct")
        assert code == 2
        assert "volume.ome.tif: cannot be written" in told[-1]
        assert "nor can 1 other result" in told[-1]
        patch.undo()
    monkeypatch.undo()
    monkeypatch.setattr(figures, "save", lambda _, path: path.touch())
    code, _, left = run("reconstruct", "--resume")
    assert code == 0
    assert left == RESULTS


def test_a_simulation_without_room_is_one_line(run, full):
    full("stack.ome.tif")
    code, told, _ = run("simulate")
    assert code == 2
    assert len(told) == 1
    assert "stack.ome.tif: cannot be written: No space left on device" in told[0]


def test_a_volume_without_room_is_written_compressed(run, full, monkeypatch, tmp_path):
    imwrite = tifffile.imwrite

    def needs_room(path, data, **options):
        if options.get("compression") is None and data.size == 4 * 14 * 12:  # the volume
            raise OSError(f"{data.size} requested and 0 written")  # as numpy says it
        imwrite(path, data, **options)

    monkeypatch.setattr(tifffile, "imwrite", needs_room)
    code, told, left = run("reconstruct")
    assert code == 0
    assert any("0 written; the disk may be full; it is written compressed instead" in line for line in told)
    assert left == RESULTS
    assert read_volume(tmp_path / "out" / "volume.ome.tif")[0].shape == (4, 14, 12)


def test_every_writer_names_its_file_and_the_reason(tmp_path):
    step = Step(1, 0.5, 0.6, torch.rand(4, 40, 40), 0.1, {}, {})
    figure = Figure()
    figure.subplots().imshow(np.random.default_rng(0).random((200, 200)))
    writers = {
        "text.txt": lambda path: write_text(path, "µ" * 9000),
        "checkpoint.pt": lambda path: checkpoint.save(path, Checkpoint(step, [], "")),
        "figure.png": lambda path: figures.save(figure, path),
        "volume.ome.tif": lambda path: write_volume(path, torch.rand(4, 40, 40), Grid((4, 40, 40), (1, 1, 1))),
    }
    for name, write in writers.items():
        with limited(), pytest.raises((WriteError, StackError), match="cannot be written: ") as caught:
            write(tmp_path / name)
        assert str(caught.value).startswith(f"{tmp_path / name}: ")
        assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_an_error_keeps_its_number_and_names_the_final_file(tmp_path):
    with pytest.raises(WriteError) as caught, written_whole(tmp_path / "a.txt"):
        raise OSError(errno.EDQUOT, "Disk quota exceeded", "elsewhere")
    assert caught.value.errno == errno.EDQUOT
    assert caught.value.filename == str(tmp_path / "a.txt")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_log_without_room_is_told_once_and_kept_in_memory():
    row = (1, 0.5, 0.6, 0.1)
    with warnings.catch_warnings(record=True, action="always") as told, open_log(Path("/dev/full"), []) as log:
        log.add(row)
        log.add((2, *row[1:]))
    (message,) = (str(warning.message) for warning in told if warning.category is UnsavedWarning)
    assert message.startswith("/dev/full: cannot be written: ")
    assert message.endswith("; the run goes on, and tries again at its end")
    assert [number for number, *_ in log.rows] == [1, 2]


# --- what would be found only when the volume is written --------------------------------------------------------------


def test_a_voxel_too_small_for_tiffs_resolution_is_written_all_the_same(tmp_path):
    """Its size stands in OME-XML; the page's own, in pixels per cm, is two 32-bit integers."""
    grid = Grid((2, 4, 4), (1e-7, 1.6e-7, 1.6e-7))
    write_volume(tmp_path / "volume.ome.tif", torch.zeros(2, 4, 4), grid)
    assert np.allclose(read_volume(tmp_path / "volume.ome.tif")[1].spacing, grid.spacing, rtol=1e-12)


def test_a_pixel_in_metres_is_refused_before_the_descent(run, tmp_path):
    values = CONFIG | {"volume": {**CONFIG["volume"], "spacing": [5e-7, 2.5e-7, 2.5e-7]}}
    (tmp_path / "config.toml").write_text(tomli_w.dumps(values), encoding="utf-8")
    (tmp_path / "out").mkdir()
    code, told, left = run("reconstruct")
    assert code == 2
    assert "volume.spacing[1]: 2.5e-07 µm is no size of a pixel" in told[0]
    assert left == set()
