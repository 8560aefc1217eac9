"""Memory is foreseen: within 30 % of what is measured, so that batches fit a budget and what can't be is refused."""

import math
from dataclasses import replace
from itertools import cycle, pairwise

import pytest
import torch

from torchdic import (
    Acquisition,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    ShortOfMemoryError,
    Spectrum,
    Volume,
    foreseen,
    image,
    image_field,
)
from torchdic.forward import foresee
from torchdic.memory import free as machine
from torchdic.memory.budget import Batches
from torchdic.planning.work_precision import peak_bytes

GRID = Grid((7, 26, 30), (0.3, 0.2, 0.21))
N0 = 1.36
AMPLE = 1 << 40
POINTS = 0.2 * torch.tensor([[0.0, 0.0], [1.0, -0.3], [-0.6, 0.9], [0.2, 0.7], [-0.8, -0.5]], dtype=torch.float64)
SCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4, POINTS))
ACQUISITION = Acquisition([Prism((0.05, 0.21), 1.1), None, Prism((0.17, -0.04), -0.7)], [0.6, -0.9])
MANY = Acquisition([Prism((0.0, 0.2), 0.3 * i) for i in range(4)], [0.2 * i for i in range(6)])
LENSES = Polarisation(analyser_extinction=0.01, pupil=JonesPupil({6: (0.1, 0.0)}, depolarisation=True))
NARROW = replace(SCOPE, objective=Objective(0.3, {4: 0.1}))
LEAKY = replace(SCOPE, polarisation=Polarisation(analyser_extinction=0.01))
COLOURS = replace(SCOPE, spectrum=Spectrum((0.5, 0.546, 0.6)))
SCENES = {
    "projection": (Fidelity("projection"), {}),
    "projection-cubic": (Fidelity("projection", interpolation="cubic"), {}),
    "projection-many-images": (Fidelity("projection"), {"acquisition": MANY}),
    "rays-cubic": (Fidelity("rays", interpolation="cubic"), {}),
    "rays": (Fidelity("rays"), {}),
    "projection-map": (Fidelity("projection", object_aberration="linear"), {}),
    "rays-absorbing": (Fidelity("rays"), {"absorbing": True}),
    "rays-double": (Fidelity("rays", solver="midpoint"), {"dtype": torch.float64}),
    "wave-1": (Fidelity("wave", order=1), {}),
    "rays-turned": (Fidelity("rays"), {"scope": replace(SCOPE, polarisation=LENSES)}),
    "rays-padded": (Fidelity("rays", padding=6), {}),
    "wave-2": (Fidelity("wave"), {}),
    "wave-absorbing": (Fidelity("wave", steps=14), {"absorbing": True}),
    "wave-lenses": (Fidelity("wave", steps=3), {"scope": replace(SCOPE, polarisation=LENSES)}),
    "projection-narrow": (Fidelity("projection"), {"scope": NARROW, "acquisition": MANY}),
    "wave-leaky": (Fidelity("wave", steps=3), {"scope": LEAKY, "acquisition": MANY}),
    "wave-narrow-lenses": (Fidelity("wave", steps=3), {"scope": replace(NARROW, polarisation=LENSES)}),
    "wave-colours": (Fidelity("wave", padding=5), {"scope": COLOURS}),
}
# kept whole, in batches, and a single source's steps in slabs
BUDGETS = {"whole": AMPLE, "batches": 2_500_000, "least": 1}
USUAL = ("projection", "wave-2")
DEAR = (
    "wave-colours",
    "projection-cubic",
    "projection-many-images",
    "rays-cubic",
    "projection-map",
    "rays-absorbing",
    "rays-double",
    "rays-turned",
    "rays-padded",
    "rays",
    "wave-leaky",
)
CASES = [
    pytest.param(
        *scene,
        budget,
        id=f"{name}-{kind}",
        marks=() if name in USUAL or (kind == few and name not in DEAR) else pytest.mark.slow,
    )
    for (name, scene), few in zip(SCENES.items(), cycle(BUDGETS), strict=False)
    for kind, budget in BUDGETS.items()
]


@pytest.fixture
def specimen(smooth_field):
    """A function that makes a volume."""

    def make(dtype=torch.float32, *, absorbing=False, learned=False):
        delta = smooth_field(GRID, 0.01).to(dtype)
        absorption = 0.001 * delta.abs() if absorbing else None
        return Volume(GRID, delta.requires_grad_(learned), N0, absorption)

    return make


def measured(volume, scope, acquisition, fidelity, *, gradient):
    """Most bytes held at once, of those that a second run allocates."""

    def run():
        with torch.set_grad_enabled(gradient):
            images = image(volume, scope, acquisition, fidelity)
            if gradient:
                volume.delta.grad = None
                images.sum().backward()

    return peak_bytes(run)[1]


@pytest.mark.parametrize(("fidelity", "parts", "budget"), CASES)
def test_estimate_is_within_30_percent_of_what_is_held(specimen, fidelity, parts, budget):
    """Every way across the specimen, with a gradient and without."""
    scope, acquisition = parts.get("scope", SCOPE), parts.get("acquisition", ACQUISITION)
    fidelity = replace(fidelity, memory=budget)
    for gradient in (False, True):
        volume = specimen(parts.get("dtype", torch.float32), absorbing=parts.get("absorbing", False), learned=gradient)
        found = foreseen(volume, scope, acquisition, fidelity, gradient=gradient)
        assert found == foreseen(volume, scope, acquisition, fidelity, gradient=None if gradient else False)
        assert found.peak / measured(volume, scope, acquisition, fidelity, gradient=gradient) == pytest.approx(
            1, abs=0.3
        )
        assert found.peak <= budget or found.peak == found.least


def test_rays_through_nothing_are_foreseen_too():
    """Corners of their mesh lie on pixels, which makes more pairs of a triangle and a pixel."""
    volume = Volume(GRID, torch.zeros(GRID.shape), N0)
    one = replace(SCOPE, condenser=None)
    for scope in (one, SCOPE):
        bytes_ = measured(volume, scope, ACQUISITION, Fidelity("rays"), gradient=False)
        assert foreseen(volume, scope, ACQUISITION, Fidelity("rays")).peak / bytes_ == pytest.approx(1, abs=0.3)


def test_without_a_gradient_batches_stay_in_the_caches_and_images_are_the_same(specimen, monkeypatch):
    volume, fidelity = specimen(torch.float64), Fidelity("wave")
    whole = foreseen(volume, SCOPE, ACQUISITION, fidelity)
    images = image(volume, SCOPE, ACQUISITION, fidelity)
    monkeypatch.setattr(foresee, "CACHED", whole.peak // 2)
    found = foreseen(volume, SCOPE, ACQUISITION, fidelity)
    assert 1 <= found.sources < whole.sources == 5
    assert found.peak <= whole.peak // 2
    torch.testing.assert_close(image(volume, SCOPE, ACQUISITION, fidelity), images, rtol=0, atol=1e-13)
    # with one they are as large as the budget allows
    assert foreseen(specimen(torch.float64, learned=True), SCOPE, ACQUISITION, fidelity).sources == 5


@pytest.mark.parametrize("propagation", ["projection", "rays", "wave"])
def test_nothing_is_kept_where_nothing_is_learned(specimen, propagation):
    """With gradients enabled, as they are unless someone says otherwise."""
    volume, fidelity = specimen(), Fidelity(propagation)
    _, held = peak_bytes(lambda: image(volume, SCOPE, ACQUISITION, fidelity))
    assert foreseen(volume, SCOPE, ACQUISITION, fidelity).peak / held == pytest.approx(1, abs=0.3)


def test_a_learned_background_of_a_field_is_foreseen(monkeypatch):
    """Room for half of what its gradient holds: sources in batches bring it down."""
    transmission = torch.polar(torch.ones(80, 96), 0.1 * torch.rand(80, 96))
    grid = Grid((1, 80, 96), (1.0, 0.2, 0.21))
    background = torch.tensor(N0, requires_grad=True)

    def run(memory):
        def gradient():
            fidelity = Fidelity(memory=memory)
            image_field(transmission, grid, SCOPE, MANY, background=background, fidelity=fidelity).sum().backward()

        return peak_bytes(gradient)[1]

    whole = run(AMPLE)
    assert run(whole * 6 // 10) < 0.8 * whole


@pytest.mark.slow
def test_steps_that_an_adaptive_solver_ignores_change_no_estimate(specimen):
    few, many = (
        foreseen(specimen(), SCOPE, ACQUISITION, Fidelity("rays", solver="dopri5", steps=steps))
        for steps in (None, 100)
    )
    assert few == many


def test_the_least_is_what_is_held_at_the_smallest_budget():
    """Two sources in a deep volume: a second copy of its gradient is more than a second source."""
    grid = Grid((64, 40, 40), (0.2, 0.2, 0.2))
    volume = Volume(grid, torch.zeros(grid.shape, requires_grad=True), N0)
    scope = replace(SCOPE, condenser=Condenser(0.4, POINTS[:2]))
    fidelity = Fidelity("wave", order=1, steps=1, memory=1)
    found = foreseen(volume, scope, ACQUISITION, fidelity)
    assert found.peak == found.least
    held = measured(volume, scope, ACQUISITION, fidelity, gradient=True)
    assert found.peak / held == pytest.approx(1, abs=0.3)


def test_a_smaller_budget_makes_slabs_then_smaller_batches_then_both(specimen):
    volume, fidelity = specimen(learned=True), Fidelity("wave")
    whole = foreseen(volume, SCOPE, ACQUISITION, fidelity)
    assert (whole.sources, whole.slabs) == (5, False)
    budgets = [whole.peak * i // 60 for i in range(60, 0, -1)]
    found = [foreseen(volume, SCOPE, ACQUISITION, replace(fidelity, memory=m)) for m in budgets]
    ways = list(dict.fromkeys((f.sources, f.slabs) for f in found))
    assert ways[:2] == [(5, False), (5, True)]
    assert ways[-1] == (1, True)
    assert all(a.sources >= b.sources and a.peak >= b.peak for a, b in pairwise(found))
    for plan, budget in zip(found, budgets, strict=True):
        assert plan.peak <= budget or plan.peak == plan.least
        assert plan.least <= plan.peak


def test_without_a_gradient_less_is_foreseen(specimen):
    volume = specimen(learned=True)
    with torch.no_grad():
        alone = foreseen(volume, SCOPE, ACQUISITION)
    assert alone == foreseen(specimen(), SCOPE, ACQUISITION) == foreseen(volume, SCOPE, ACQUISITION, gradient=False)
    assert alone.peak < foreseen(volume, SCOPE, ACQUISITION).peak / 2


@pytest.mark.parametrize("sources", [1, 40])
@pytest.mark.parametrize("name", [*SCENES, "wave-cubic", "wave-cubic-lenses-double"])
def test_no_scene_holds_more_than_what_spares_its_measurement(name, sources, specimen):
    """A scene that fits by a number of bytes a pixel is not measured: whatever it is, it must hold less."""
    more = {
        "wave-cubic": (Fidelity("wave", interpolation="cubic", padding=4), {}),
        "wave-cubic-lenses-double": (
            Fidelity("wave", interpolation="cubic", steps=14),
            {"scope": replace(SCOPE, polarisation=LENSES), "dtype": torch.float64, "absorbing": True},
        ),
    }
    fidelity, parts = (SCENES | more)[name]
    scope = parts.get("scope", SCOPE)
    points = POINTS[torch.arange(sources) % len(POINTS)]
    scope = replace(scope, condenser=replace(scope.condenser, points=points))
    volume = specimen(parts.get("dtype", torch.float32), absorbing=parts.get("absorbing", False))
    with torch.no_grad():
        scene = volume, scope, parts.get("acquisition", ACQUISITION), fidelity
        room, ample, _ = foresee._demand(*scene, 0 if fidelity.object_aberration is None else 3)
        assert room._peak(Batches(sources)) < ample


@pytest.mark.slow
def test_a_learned_lens_or_medium_is_kept_too(specimen):
    """Of lenses' matrices only where they are learned."""
    pupils = [JonesPupil({6: (torch.tensor(0.1, requires_grad=learned), 0.0)}) for learned in (False, True)]
    fixed, learned = (
        foreseen(specimen(learned=True), replace(SCOPE, polarisation=Polarisation(pupil=p)), ACQUISITION).peak
        for p in pupils
    )
    assert learned > fixed
    medium = Volume(GRID, specimen().delta, torch.tensor(N0, requires_grad=True))
    bytes_ = peak_bytes(lambda: image(medium, SCOPE, ACQUISITION, Fidelity()).sum().backward())[1]
    assert foreseen(medium, SCOPE, ACQUISITION).peak / bytes_ == pytest.approx(1, abs=0.3)


# --- what is free ----------------------------------------------------------------------------------------------------


@pytest.fixture
def free(monkeypatch):
    """A function that sets the bytes that are free."""
    return lambda number: monkeypatch.setattr(foresee, "free_bytes", lambda _device: number)


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_what_the_least_batch_wants_is_refused_with_the_numbers(specimen, free, propagation):
    volume, fidelity = specimen(learned=True), Fidelity(propagation)
    least = foreseen(volume, SCOPE, ACQUISITION, fidelity).least
    free(least - 1)
    with pytest.raises(ShortOfMemoryError, match=r"3 prism settings × 2 focus planes of 7×26×30 voxels .* GiB .* free"):
        image(volume, SCOPE, ACQUISITION, fidelity)
    free(least)
    image(volume, SCOPE, ACQUISITION, fidelity)
    free(None)
    image(volume, SCOPE, ACQUISITION, fidelity)


def test_little_room_makes_batches_and_the_same_image(specimen, free):
    volume = specimen(torch.float64, learned=True)
    found = []
    for room in (AMPLE, foreseen(volume, SCOPE, ACQUISITION).least):
        free(room)
        images = image(volume, SCOPE, ACQUISITION)
        (gradient,) = torch.autograd.grad(images.square().sum(), volume.delta)
        found.append((images.detach(), gradient))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)


def test_fields_are_refused_too(free):
    transmission = torch.ones(26, 30, dtype=torch.complex64)
    free(1000)
    with pytest.raises(ShortOfMemoryError, match="26×30 pixels"):
        image_field(transmission, GRID, SCOPE, ACQUISITION, background=N0)
    free(AMPLE)
    image_field(transmission, GRID, SCOPE, ACQUISITION, background=N0)


def test_free_bytes_are_those_of_the_machine():
    known = machine.free_bytes(torch.device("cpu"))
    assert known is None or known > 1 << 20
    assert machine.free_bytes(torch.device("meta")) is None


def test_available_memory_is_linuxs_estimate(tmp_path):
    table = tmp_path / "meminfo"
    table.write_text("MemTotal: 2048 kB\nMemFree: 100 kB\nMemAvailable:    1024 kB\n", encoding="ascii")
    assert machine.available(table) == 1 << 20
    assert machine.available(tmp_path / "missing") is None


@pytest.mark.parametrize(
    ("line", "folder", "names"),
    [
        ("0::/job/step", "", ("memory.max", "memory.current", "inactive_file")),
        ("4:cpu,memory:/job/step", "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")),
    ],
    ids=["v2", "v1"],
)
def test_control_groups_leave_what_the_tightest_of_them_leaves(tmp_path, line, folder, names):
    """Each group on the way to the root has a limit of its own; pages of files that no one reads don't count."""
    membership, base = tmp_path / "cgroup", tmp_path / folder
    membership.write_text(f"{line}\n", encoding="utf-8")
    most, now, cached = names
    for part, limit, used in (("job", "9000", "5000"), ("job/step", "8000", "7000"), ("", "max", "9999")):
        (base / part).mkdir(parents=True, exist_ok=True)
        (base / part / most).write_text(f"{limit}\n", encoding="ascii")
        (base / part / now).write_text(f"{used}\n", encoding="ascii")
        (base / part / "memory.stat").write_text(f"anon 5\n{cached} 500\n", encoding="ascii")
    assert sorted(machine.left_by_groups(tmp_path, membership)) == [1500, 4500]
    assert machine.left_by_groups(tmp_path, tmp_path / "missing") == []


def test_gib_is_what_a_message_counts_in():
    with pytest.raises(ShortOfMemoryError, match=r"This need at least 3 GiB of memory, 1.5 GiB are free"):
        machine.check_room(3 << 30, 3 << 29, "This")
    machine.check_room(3 << 30, None, "This")
    assert math.isclose(machine.GIB, 2**30)
