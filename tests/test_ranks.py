"""Several processes compute what one computes, and end together."""

import json
import os
import signal
import socket
import sys
import threading
import time
import warnings

import pytest
import tifffile
import torch
import torch.distributed as dist
from several_ranks import forked, led
from small_bead import CONFIG

from recon.cli import main
from recon.cli.processes.torchrun import MARK, place
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    LostRankError,
    Microscope,
    Objective,
    Prism,
    Spectrum,
    Volume,
    image,
    image_field,
)
from torchdic.errors import BatchWarning
from torchdic.forward.own_part import OwnPart
from torchdic.linear import transfer_functions
from torchdic.ranks.agreement import gathered
from torchdic.ranks.each import each
from torchdic.ranks.group import alone, rank, ranks, shares_out
from torchdic.ranks.meeting import _answered, _called
from torchdic.ranks.shared import _parts, everywhere, shared
from torchdic.ranks.signals import signals_later

GRID = Grid((4, 14, 17), (0.5, 0.16, 0.15))
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")

SCENES = {
    "directions that don't divide evenly": Fidelity("wave", sources=7),
    "fewer directions than ranks": Fidelity("wave", sources=2),
    "one direction": Fidelity("wave", sources=1),
    "rays": Fidelity("rays", sources=4),
    "projection": Fidelity("projection", sources=5, padding=2),
    "object aberration": Fidelity("projection", sources=4, object_aberration="linear"),
}


def learned_scene():
    """What a scene may learn, float64."""
    generator = torch.Generator().manual_seed(0)
    smooth = torch.rand(1, 1, 2, 4, 4, generator=generator, dtype=torch.float64)
    delta = 0.03 * torch.nn.functional.interpolate(smooth, GRID.shape, mode="trilinear")[0, 0]
    values = {"delta": delta, "n0": torch.tensor(1.4).double(), "bias": torch.tensor(1.2).double()}
    values |= {"focus": torch.tensor(-0.4).double(), "coma": torch.tensor(0.3).double()}
    return {name: value.requires_grad_() for name, value in values.items()}


def images_of(v, fidelity, **parts):
    microscope = Microscope(0.546, Objective(0.8, {7: v["coma"]}), Condenser(0.5), **parts)
    acquisition = Acquisition((Prism((0.05, 0.2), v["bias"]), None), (v["focus"], 0.0, 0.7))
    return image(Volume(GRID, v["delta"], v["n0"]), microscope, acquisition, fidelity)


def images_of_field(v, fidelity):
    """Each direction has a transmission of its own."""
    microscope = Microscope(0.546, Objective(0.8, {7: v["coma"]}), Condenser(0.5))
    phase = v["delta"][torch.arange(len(microscope.sources(fidelity.sources)[1])) % GRID.shape[0]]
    acquisition = Acquisition((Prism((0.05, 0.2), v["bias"]),), (v["focus"], 0.3))
    return image_field(torch.exp(20j * phase), GRID, microscope, acquisition, background=v["n0"], fidelity=fidelity)


def responses(v, fidelity):
    """Of a weak specimen, as real numbers."""
    microscope = Microscope(0.546, Objective(0.8, {7: v["coma"]}), Condenser(0.5))
    acquisition = Acquisition((Prism((0.05, 0.2), v["bias"]),), (v["focus"], 0.3))
    return torch.view_as_real(transfer_functions(GRID, microscope, acquisition, v["n0"], fidelity))


def every_scene():
    found = {name: (images_of, fidelity, {}) for name, fidelity in SCENES.items()}
    many = Fidelity("wave", sources=5)
    found["colours"] = images_of, many, {"spectrum": Spectrum((0.52, 0.546), (2.0, 1.0))}
    found["camera"] = images_of, many, {"camera": Camera(pixel_size=0.33)}
    found |= {"fields": (images_of_field, many, {}), "transfer": (responses, many, {})}
    return found


def values_and_gradients(of, fidelity, parts):
    v = learned_scene()
    images = of(v, fidelity, **parts)
    weights = torch.rand(images.shape, generator=torch.Generator().manual_seed(1), dtype=images.dtype)
    gradients = torch.autograd.grad((weights * images.square()).sum(), list(v.values()), materialize_grads=True)
    return [images.detach(), *gradients]


def differences():
    """For each scene the largest difference between ranks and one process, relative to the largest value."""
    found = {}
    for name, scene in every_scene().items():
        assert shares_out()
        shared_out = values_and_gradients(*scene)
        with alone():
            by_one = values_and_gradients(*scene)
        found[name] = max(
            float((a - b).abs().max() / b.abs().max().clamp_min(1e-300))
            for a, b in zip(shared_out, by_one, strict=True)
        )
    return found


@pytest.mark.parametrize(
    "number", [pytest.param(2, marks=pytest.mark.slow), 3, pytest.param(4, marks=pytest.mark.slow)]
)
def test_images_and_gradients_of_ranks_are_those_of_one_process(number, tmp_path):
    """To Δn, the medium's index, bias, focus and an aberration, in float64."""
    found = led(differences, number, tmp_path)
    assert found == {name: pytest.approx(0, abs=1e-12) for name in every_scene()}


@pytest.mark.parametrize("of", range(1, 8))
@pytest.mark.parametrize(("directions", "planes"), [(1, 1), (1, 5), (2, 3), (3, 1), (13, 2)])
def test_parts_of_all_ranks_cover_each_image_and_direction_once(of, directions, planes):
    parts = [OwnPart.among(directions, planes, number, of) for number in range(of)]
    done = [(d, p) for part in parts if not part.idle for d in part.directions for p in part.planes]
    assert sorted(done) == [(d, p) for d in range(directions) for p in range(planes)]


# --- what happens on one rank happens on all --------------------------------------------------------------------------


def one(value):
    return value.sum()


def own(value, failing):
    if rank() == failing:
        raise ValueError(f"{failing} can't")
    return value.sum() * (rank() + 1)


class TurnWarning(BatchWarning):
    """Of a test."""


def warned(value):
    warnings.warn(TurnWarning(f"rank {rank()}", severity=rank()), stacklevel=1)
    return own(value, None)


def test_an_error_of_one_rank_is_raised_and_the_ranks_go_on(tmp_path):
    def body():
        x = torch.ones(3, requires_grad=True)
        with pytest.raises(ValueError, match="2 can't") as raised:
            shared(one, own, x, 2)
        assert "rank 2" in raised.value.__notes__[0]
        total = shared(one, own, x, None)
        (gradient,) = torch.autograd.grad(total, x)
        return total.item(), gradient.tolist()

    assert led(body, 3, tmp_path) == (18.0, [6.0] * 3)


def test_of_all_ranks_warnings_the_worst_is_given(tmp_path):
    def body():
        with pytest.warns(TurnWarning) as caught:
            shared(one, warned, torch.ones(2))
        with pytest.raises(TurnWarning):  # the tests' filters make it an error
            shared(one, warned, torch.ones(2))
        return [str(w.message) for w in caught], shared(one, own, torch.ones(2), None).item()

    assert led(body, 3, tmp_path) == (["rank 2"], 12.0)


def test_gradients_that_nobody_asks_for_are_forgotten(tmp_path):
    def body():
        x = torch.ones(3, requires_grad=True)
        for _ in range(3):
            shared(one, own, x, None)
        while _parts:  # the thread that added the last sum up may hold it, and its graph, a moment longer
            time.sleep(0.001)
        shared(one, own, x.detach(), None)
        return everywhere(kept)

    assert led(body, 2, tmp_path) == [0, 0]


def kept():
    import gc

    from torchdic.ranks.shared import KeptPart

    return sum(type(thing) is KeptPart for thing in gc.get_objects())


def by_itself(tmp):
    assert not shares_out()
    parts = gathered(rank())
    (tmp / str(rank())).touch()
    return parts, ranks()


def test_everywhere_runs_a_function_on_all_ranks(tmp_path):
    assert led(lambda: everywhere(by_itself, tmp_path), 3, tmp_path) == [([0, 1, 2], 3)] * 3
    assert all((tmp_path / str(number)).exists() for number in range(3))
    assert everywhere(by_itself, tmp_path) == [([0], 1)]


def squared(item):
    """An item that says who computed it, and that nothing of it was shared out."""
    if item == 13:
        raise ValueError("13 isn't liked")
    return item**2, rank(), shares_out()


def test_each_of_many_items_is_computed_by_one_rank(tmp_path):
    def body():
        with pytest.raises(ValueError, match="13 isn't liked"):
            list(each(squared, [1, 13]))
        return list(each(squared, range(5)))

    who = [0, 1, 2, 0, 1]
    assert led(body, 3, tmp_path) == [(i**2, number, False) for i, number in enumerate(who)]
    assert list(each(squared, range(5))) == [(i**2, 0, False) for i in range(5)]


def test_items_come_as_soon_as_they_are_there():
    seen = []
    items = each(lambda item: seen.append(item) or item, [3, 4])
    assert next(items) == 3
    assert seen == [3]


def gone(which):
    if rank() == which:
        os._exit(9)


def test_a_rank_that_ends_is_told_of(tmp_path):
    def body():
        with pytest.raises(LostRankError, match="has ended"):
            everywhere(gone, 1)
        return True

    assert led(body, 2, tmp_path)


def test_signals_wait_until_the_ranks_have_computed():
    came = []
    before = signal.signal(signal.SIGTERM, lambda *_: came.append(True))
    try:
        with signals_later():
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.01)
            assert came == []
        assert came == [True]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_ranks_find_each_other_although_an_earlier_attempt_has_left_its_answers():
    store = dist.HashStore()
    store.set("attempt", "old")
    store.set("old/answer/1", "x")
    store.set("old/heard/1", "x")
    names = {}

    def follower():
        names[1] = _answered(store, 1)

    def leader():
        time.sleep(0.2)  # the other one finds the earlier name
        names[0] = _called(store, 2)

    threads = [threading.Thread(target=run) for run in (follower, leader)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert names[0] == names[1] != "old"


# --- the command ------------------------------------------------------------------------------------------------------


def test_only_torchrun_makes_ranks(monkeypatch):
    for name, value in {"SLURM_NTASKS": "4", "SLURM_PROCID": "1", "RANK": "1", "WORLD_SIZE": "4"}.items():
        monkeypatch.setenv(name, value)
    assert place() is None
    for name, value in {MARK: "none", "LOCAL_RANK": "1", "LOCAL_WORLD_SIZE": "2"}.items():
        monkeypatch.setenv(name, value)
    assert place() == (1, 4, 1, 2)
    monkeypatch.setenv("WORLD_SIZE", "1")
    assert place() is None


def commanded(monkeypatch, words, number, folder):
    """The exit codes of a command's processes as torchrun would start them, and what they print, in one string."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    told = {MARK: "a test", "WORLD_SIZE": number, "LOCAL_WORLD_SIZE": number, "MASTER_ADDR": "127.0.0.1"}
    for name, value in {**told, "MASTER_PORT": port}.items():
        monkeypatch.setenv(name, str(value))

    def run(rank):
        os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "TORCHELASTIC_ERROR_FILE": f"{folder}/{rank}.json"}
        sys.stdout, sys.stderr = (open(stream, "w", buffering=1, closefd=False) for stream in (1, 2))  # noqa: SIM115
        return main(list(map(str, words)))

    codes = forked(run, number, folder)
    return codes, "".join((folder / f"{rank}.txt").read_text() for rank in range(number))


@pytest.fixture
def bead(tmp_path, monkeypatch):
    """The configuration of a small bead, with its stack, in the current folder."""
    monkeypatch.chdir(tmp_path)
    config = tmp_path / "run.toml"
    config.write_text(CONFIG)
    assert main(["simulate", "run.toml", "--out", "made"]) == 0
    return config


def test_two_processes_find_the_volume_of_one(bead, tmp_path, monkeypatch, no_pictures):
    """float32: sums in another order differ in the last bits, which 4 steps carry on to 2e-5 of the contrast here."""
    assert main(["reconstruct", "run.toml", "--out", "one"]) == 0
    codes, printed = commanded(monkeypatch, ["reconstruct", "run.toml", "--out", "two"], 2, tmp_path)
    assert codes == [0, 0], printed
    assert printed.count("misfit") > 0
    assert printed.count("two/volume.ome.tif:") == 1
    one, two = (tifffile.imread(tmp_path / name / "volume.ome.tif") for name in ("one", "two"))
    assert abs(two - one).max() < 1e-4 * abs(one).max()


@pytest.mark.slow
def test_a_run_goes_on_with_another_number_of_processes(bead, tmp_path, monkeypatch, no_pictures):
    assert main(["reconstruct", "run.toml", "--out", "one"]) == 0
    for steps, number in ((2, 1), (3, 4), (4, 1)):
        bead.write_text(CONFIG.replace("steps = 4", f"steps = {steps}"))
        words = ["reconstruct", "run.toml", "--out", "several", "--resume"]
        if number > 1:
            codes, printed = commanded(monkeypatch, words, number, tmp_path)
            assert codes == [0] * number, printed
            monkeypatch.delenv(MARK)
        else:
            assert main(words) == 0
    steps = (tmp_path / "several" / "log.csv").read_text().splitlines()[1:]
    assert [row.split(",")[0] for row in steps] == ["1", "2", "3", "4"]
    one, several = (tifffile.imread(tmp_path / name / "volume.ome.tif") for name in ("one", "several"))
    assert abs(several - one).max() < 1e-4 * abs(one).max()


def test_bad_input_is_told_once_by_the_first_process(bead, tmp_path, monkeypatch):
    bead.write_text(CONFIG.replace("background = 1.4", "background = -1.4"))
    codes, printed = commanded(monkeypatch, ["reconstruct", "run.toml"], 2, tmp_path)
    assert codes == [2, 0]
    assert printed.count("\n") == 1
    assert "-1.4 must be a refractive index" in printed
    assert "-1.4 must be" in json.loads((tmp_path / "0.json").read_text())["message"]["message"]
