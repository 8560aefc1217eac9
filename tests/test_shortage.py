"""Memory that runs out although there seemed to be room: one line says so, and on a GPU batches are halved once."""

import errno
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch
from distant import Device, bring, send

from recon.cli import main
from recon.earlier.path_length import path_length
from recon.earlier.tikhonov import tikhonov
from recon.fit.bounds import Bounds
from recon.fit.descent import minimise
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.report import figures
from recon.run import room
from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    ShortageWarning,
    ShortOfMemoryError,
    Volume,
    image,
)
from torchdic.files.stack import write_stack, write_volume
from torchdic.memory import free, shortage
from torchdic.memory.held import course_of, most
from torchdic.memory.shortage import as_shortage, halved_once, is_shortage

GRID = Grid((4, 22, 20), (0.5, 0.2, 0.21))
SCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4))
SETTINGS = Acquisition([Prism((0.05, 0.21), 1.1), Prism((0.17, -0.04), -0.7)], [0.6, -0.9])
FIDELITY = Fidelity(sources=8)
MANY = Fidelity(sources=32)
CPU = torch.device("cpu")

# so small an array holds no light for long
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")


@pytest.fixture
def delta(smooth_field):
    return smooth_field(GRID, 0.01)


def images(delta):
    with torch.no_grad():
        return image(Volume(GRID, delta, 1.37), SCOPE, SETTINGS, MANY)


def test_an_image_that_runs_out_of_a_gpus_memory_is_computed_in_half_batches(delta):
    with Device() as ample:
        whole = images(send(delta))
    with Device(room=int(0.75 * ample.most)) as scarce, pytest.warns(ShortageWarning, match="half as many sources"):
        halved = images(send(delta))
    assert scarce.most < ample.most
    torch.testing.assert_close(bring(halved), bring(whole), rtol=0, atol=1e-13)
    with Device(room=int(0.1 * ample.most)), pytest.warns(ShortageWarning), pytest.raises(torch.OutOfMemoryError):
        images(send(delta))


def problem(data):
    medium = empty_medium(GRID, 1.37, data)
    recipe = Recipe("adam", 4, draft_sources=None)
    return Problem.from_recipe(data, Setup(medium, SCOPE, SETTINGS), FIDELITY, recipe)


def descend_until_short(data, device, room, taken):
    """Take the steps of a descent on a device that has so many bytes of room after the second one."""
    for step in minimise(problem(send(data))):
        taken.append(step)
        if step.number == 2:
            device.room = room


@pytest.mark.parametrize(
    "share", [pytest.param(0.95, id="of a gradient"), pytest.param(0.7, id="of an image", marks=pytest.mark.slow)]
)
def test_a_descent_that_runs_out_of_a_gpus_memory_goes_on_in_half_batches(delta, share):
    """It runs out before the third step: another process has taken what is missing."""
    data = images(delta)
    with Device() as ample:
        whole = []
        for step in minimise(problem(send(data))):
            whole.append(step)
            needed, ample.most = ample.most, 0  # the start needs more
    halved = []
    with Device() as scarce, pytest.warns(ShortageWarning, match="meta: the memory ran out: another .* KiB were asked"):
        descend_until_short(data, scarce, int(share * needed), halved)
    assert [step.number for step in halved] == [step.number for step in whole] == [1, 2, 3, 4]
    torch.testing.assert_close(bring(halved[-1].delta), bring(whole[-1].delta), rtol=1e-6, atol=1e-9)


def test_a_second_time_is_the_end_and_steps_so_far_were_handed_out(delta):
    data, taken = images(delta), []
    with Device() as device, pytest.warns(ShortageWarning), pytest.raises(torch.OutOfMemoryError):
        descend_until_short(data, device, 1, taken)
    assert [step.number for step in taken] == [1, 2]


def test_on_the_cpu_nothing_is_tried_again():
    tried = []

    def fail():
        tried.append(1)
        raise MemoryError

    with pytest.raises(MemoryError):
        halved_once(fail, CPU)
    assert len(tried) == 1


def test_every_kind_of_shortage_is_known_and_told_in_one_line():
    """By asking for more than any machine has."""
    for ask in (lambda: torch.empty(1 << 60, dtype=torch.uint8), lambda: np.ones(1 << 59, np.uint8)):
        with pytest.raises((RuntimeError, MemoryError)) as caught:
            ask()
        assert is_shortage(caught.value)
        told = str(as_shortage(caught.value))
        assert told.startswith("the memory ran out: another ")
        assert "were asked for; fewer voxels" in told
        assert "\n" not in told
    for other in (RuntimeError("shapes differ"), ImportError("No module named 'a'")):
        assert as_shortage(other) is other
    # of a library that is first used where there is no room for it
    assert is_shortage(ImportError("_lsprof.so: failed to map segment from shared object"))
    assert is_shortage(OSError(errno.ENOMEM, "Cannot allocate memory", "torch/distributed"))
    assert not is_shortage(OSError(errno.ENOSPC, "No space left on device", "out"))


@pytest.mark.parametrize(("free", "short"), [(1 << 20, True), (1 << 30, False), (None, False)])
def test_what_python_cannot_say_is_a_shortage_only_where_next_to_nothing_is_free(monkeypatch, free, short):
    monkeypatch.setattr(shortage, "free_bytes", lambda device: free)
    assert is_shortage(SystemError("error return without exception set")) is short
    assert not is_shortage(SystemError("bad argument to internal function"))


def test_the_processs_own_limit_is_free_memory_too(tmp_path):
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    assert before[0] != resource.RLIM_INFINITY or free.left_by_limit() is None
    (tmp_path / "statm").write_text("1000 500 0", encoding="ascii")
    limit = 1 << 46  # of which nothing here is short
    try:
        resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
        assert free.left_by_limit(tmp_path / "statm") == limit - 1000 * resource.getpagesize()
        assert 0 < free.left_by_limit() < limit
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert free.left_by_limit(tmp_path / "missing") is None


def test_what_is_refused_is_not_tried_again(delta, monkeypatch):
    monkeypatch.setattr("torchdic.forward.foresee.free_bytes", lambda _device: 1000)
    with Device(), pytest.raises(ShortOfMemoryError, match="need at least"):
        image(Volume(GRID, send(delta), 1.37), SCOPE, SETTINGS, replace(MANY, memory=1))


@pytest.mark.parametrize("command", [pytest.param("calibrate", marks=pytest.mark.slow), "plan", "simulate --exact"])
def test_commands_foresee_their_memory(tmp_path, capsys, monkeypatch, command):
    command, _, exact = command.partition(" --")
    data = 0.5 + 0.02 * np.random.default_rng(0).standard_normal((2, 3, 40, 40)).astype(np.float32)
    write_stack(tmp_path / "stack.ome.tif", data, (0.2, 0.2), 1.0)
    specimen = '[specimen]\nkind = "bead"\nradius = 1.0\ncontrast = 0.03\n[simulation]\nexact = true\n'
    (tmp_path / "run.toml").write_text(SCENE + (specimen if exact else ""), encoding="utf-8")
    wanted = {
        "calibrate": (2 << 20, "Steps of a reconstruction of 8×40×40 voxels"),
        "plan": (2 << 20, "A volume of 8×40×40 voxels by method 'linear'"),
        "simulate": (4 << 20, "Images from the exact field on 80×80 pixels"),
    }
    free, what = wanted[command]
    monkeypatch.setattr("torchdic.memory.free.available", lambda: free)
    monkeypatch.setattr("recon.run.room.PICTURES", 0)
    assert main([command, str(tmp_path / "run.toml"), "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"run.toml: {what} need at least" in line
    assert not (tmp_path / "out").exists()


SCENE = """
volume = { shape = [8, 40, 40], spacing = [0.5, 0.2, 0.2], background = 1.4 }
microscope = { wavelength = 0.546, objective = { na = 0.8 }, condenser = { na = 0.5 } }
data = { path = "stack.ome.tif" }
[acquisition]
focus = [-1.0, 0.0, 1.0]
prisms = [{ shear = [0.0, 0.24], bias = 1.5 }, { shear = [0.24, 0.0], bias = 1.5 }]
"""


@pytest.mark.parametrize(("method", "solve"), [("linear", tikhonov), ("opl", path_length)])
def test_what_a_method_without_a_descent_holds_is_foreseen(monkeypatch, method, solve):
    grid = Grid((6, 90, 84), (0.5, 0.2, 0.21))
    y, x = torch.meshgrid(torch.linspace(-3, 3, 90), torch.linspace(-3, 3, 84), indexing="ij")
    slopes = torch.stack([x, y])[:, None] * (-(x**2) - y**2).exp()
    data = 0.5 + 0.2 * slopes + 0.01 * torch.randn(2, 2, 90, 84)
    setup = Setup(empty_medium(grid, 1.37, data), SCOPE, SETTINGS)
    told = {}
    monkeypatch.setattr(room, "free_bytes", lambda _device: 1)
    monkeypatch.setattr(room, "check_room", lambda wanted, _free, what: told.update({what: wanted}))
    room.check_room_for_direct(method, data, setup, Bounds())
    held = most(course_of(lambda: solve(data, setup, [0.01, 0.01])))
    assert told == {f"A volume of 6×90×84 voxels by method '{method}'": pytest.approx(held, rel=0.3)}


def test_no_report_holds_more_than_is_foreseen(monkeypatch, tmp_path):
    """Torch's bytes and NumPy's, each at their most, beside the images and the volume."""
    images, delta = torch.rand(2, 3, 150, 140), torch.rand(12, 150, 140)
    grid = Grid((12, 150, 140), (0.5, 0.2, 0.21))

    def report():
        figures.draw_images(images, images + 0.1, SETTINGS.prisms, [-1.0, 0.0, 1.0], grid)
        figures.draw_sections({"": delta}, grid)
        pairs = torch.stack([images, images + 0.1], 1).flatten(0, 1)
        write_stack(tmp_path / "images.ome.tif", pairs, (0.2, 0.21), 1.0)
        write_volume(tmp_path / "volume.ome.tif", delta, grid)

    report()  # what is made once stays
    tracemalloc.start()
    try:
        held = most(course_of(report)) + tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    foreseen = room.OF_PIXEL * images.numel() + room.OF_VOXEL * delta.numel()
    assert held < foreseen + room.PICTURES
    assert held > 0.1 * foreseen
