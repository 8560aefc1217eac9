"""What a scene does not have costs nothing: transforms, ray equations and bytes, counted with and without it."""

import math
from bisect import bisect_left
from collections import Counter
from dataclasses import replace

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    JonesPupil,
    Layer,
    Microscope,
    Objective,
    Polarisation,
    Prism,
    Spectrum,
    Volume,
    foreseen,
    image,
)
from torchdic.imaging import polarised
from torchdic.object_aberration.levels import object_levels
from torchdic.rays import landing
from torchdic.rays.caustics import Tubes
from torchdic.specimen.interpolation import SliceSampler

N0 = 1.36
SLICES, ROWS, COLUMNS = 5, 24, 30
GRID = Grid((SLICES, ROWS, COLUMNS), (0.4, 0.2, 0.21))
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.17, 0.24]], dtype=torch.float64)
SCOPE = Microscope(0.546, Objective(0.75), Condenser(0.4, POINTS))
# 3 prism settings and 2 focus planes
ACQUISITION = Acquisition([Prism((0.05, 0.21), 1.1), None, Prism((0.17, -0.04), -0.7)], [0.6, -0.9])
IMAGES = 6
# bytes of one real image, and of the complex fields of all sources
PIXELS = 8 * ROWS * COLUMNS
FIELDS = 2 * PIXELS * len(POINTS)


@pytest.fixture
def delta(smooth_field):
    return smooth_field(GRID, 0.02)


@pytest.fixture
def counted(monkeypatch):
    """Counts calls while a function runs: transforms each way, samples of Δn with its gradient and of values, tubes."""
    calls = Counter()

    def watch(owner, name):
        plain = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *a, **k: calls.update([name]) or plain(*a, **k))

    for name in ("fft2", "ifft2", "fft", "ifft", "rfft2", "irfft2", "fftn", "ifftn"):
        watch(torch.fft, name)
    for name in ("sample", "value"):
        watch(SliceSampler, name)
    watch(landing, "tube_area")

    def count(function):
        calls.clear()
        function()
        return dict(calls)

    return count


def peak(function):
    """Most bytes of tensors alive at once while a function runs without gradients, of those it allocated itself."""
    with torch.no_grad(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        function()
    events = [e for e in profiler.profiler.kineto_results.events() if e.name() == "[memory]"]
    live, most = 0, 0
    for event in sorted(events, key=lambda e: e.start_ns()):
        live += event.nbytes()
        most = max(most, live)
    assert most > 0
    return most


def kept(function):
    """Bytes that autograd keeps for the backward pass, each storage once."""
    held = {}

    def keep(tensor):
        held[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        result = function()
    assert result.requires_grad
    return sum(storage.nbytes() for storage in held.values())


def taking(delta, scope=SCOPE, acquisition=ACQUISITION, propagation="wave", absorption=None, learned=False, **options):
    """A function that takes the images."""
    options = {"memory": 1 << 30} | options
    value = delta.clone().requires_grad_(learned)
    volume = Volume(GRID, value, N0, absorption)
    return lambda: image(volume, scope, acquisition, Fidelity(propagation, **options))


# --- how light crosses the specimen --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("propagation", "options", "expected"),
    [
        ("projection", {}, {"value": SLICES, "fft2": 1}),
        ("rays", {}, {"sample": 4 * SLICES, "tube_area": 1, "fft2": 1}),
        ("rays", {"steps": 3}, {"sample": 4 * 3, "tube_area": 1, "fft2": 1}),
        ("rays", {"solver": "euler"}, {"sample": SLICES, "tube_area": 1, "fft2": 1}),
        ("rays", {"solver": "midpoint"}, {"sample": 2 * SLICES, "tube_area": 1, "fft2": 1}),
        ("rays", {"amplitude": False}, {"sample": 4 * SLICES, "fft2": 1}),
        ("wave", {}, {"fft2": 2 * SLICES, "ifft2": 2 * SLICES}),
        ("wave", {"order": 1}, {"fft2": SLICES, "ifft2": SLICES}),
        ("wave", {"steps": 2}, {"fft2": 4, "ifft2": 4}),
    ],
    ids=lambda v: v if isinstance(v, str) else "-".join(map(str, v.values())),
)
def test_each_propagation_does_its_own_work_only(delta, counted, propagation, options, expected):
    """Straight rays solve no ODE, bent ones evaluate it as often as the method's stages, the wave samples nothing.

    One transform of the field that rays make, and one back for each prism and focus.
    """
    found = counted(taking(delta, propagation=propagation, **options))
    assert found == Counter(expected) + Counter(ifft2=IMAGES)


def test_bending_and_amplitude_are_paid_by_those_who_ask_for_them(delta):
    """What the backward pass keeps: more for bent rays than for straight ones, more for those with an amplitude."""
    straight, bent, whole = (
        kept(taking(delta, learned=True, **options))
        for options in (
            {"propagation": "projection"},
            {"propagation": "rays", "amplitude": False},
            {"propagation": "rays"},
        )
    )
    assert straight < bent / 3
    assert bent < whole
    bent, whole = (peak(taking(delta, propagation="rays", amplitude=amplitude)) for amplitude in (False, True))
    # without gradients the most is held before the amplitude is made
    assert bent <= whole


def test_absorption_is_sampled_only_where_there_is_some(delta, counted, propagation):
    """κ = 0 is a value: it costs its samples and bytes, no transform, and shows the same image to rounding."""
    zero = torch.zeros_like(delta)
    without, with_ = (taking(delta, propagation=propagation, absorption=kappa) for kappa in (None, zero))
    cost, more = counted(without), counted(with_)
    extra = {"projection": SLICES, "rays": 4 * SLICES, "wave": 0}[propagation]
    assert Counter(more) == Counter(cost) + Counter(value=extra)
    torch.testing.assert_close(with_(), without(), rtol=0, atol=1e-14)
    kappa_free, absorbing = (
        kept(taking(delta, propagation=propagation, absorption=kappa, learned=True)) for kappa in (None, zero)
    )
    assert kappa_free < absorbing
    if propagation != "projection":  # whose imaging takes more than its sums along rays
        assert peak(without) < peak(with_)


# --- sources, prisms and focus planes ------------------------------------------------------------------------------


def directions(count):
    return replace(SCOPE, condenser=Condenser(0.4, 0.4 * torch.rand(count, 2, dtype=torch.float64) - 0.2))


def test_sources_share_their_transforms_and_evaluations(delta, counted, propagation):
    """A batch of sources is one call whatever its size; bytes grow with it."""
    one, many = (taking(delta, directions(n), propagation=propagation) for n in (1, 8))
    assert counted(one) == counted(many)
    assert 4 * peak(one) < peak(many) < 10 * peak(one)


@pytest.mark.parametrize("count", [*(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2)), 3])
def test_field_of_a_source_serves_every_prism_and_focus(delta, counted, propagation, count):
    """Propagation is paid once a batch; after it, one inverse transform per prism, focus and batch is all."""
    scope = directions(5)
    prisms, focus = ACQUISITION.prisms, [0.6, -0.9, 0.0]

    def room(acquisition):
        """A budget for 2 sources at once: batches of 2, 2 and 1."""
        volume, budgets = Volume(GRID, delta, N0), [int(1.05**i) for i in range(200, 500)]

        def sources(budget):
            return foreseen(volume, scope, acquisition, Fidelity(propagation, memory=budget)).sources

        return budgets[bisect_left(budgets, 2, key=sources)]

    with torch.no_grad():
        alone, several = (
            counted(taking(delta, scope, part, propagation, memory=room(part)))
            for part in (Acquisition(prisms[:p], focus[:f]) for p, f in ((1, 1), (3, count)))
        )
        whole = counted(taking(delta, scope, Acquisition(prisms[:1], focus[:1]), propagation))
    assert Counter(several) == Counter(alone) + Counter(ifft2=3 * (3 * count - 1))
    assert Counter(alone) == Counter({name: 3 * n for name, n in whole.items()})


def test_backward_pass_keeps_the_same_for_each_further_prism_and_focus(delta, propagation):
    """Bytes are those of the propagation, and then so much for each image and for each focus plane."""

    def of(prisms, focus):
        acquisition = Acquisition([Prism((0.05, 0.1 * i), 1.0) for i in range(prisms)], [0.5 * i for i in range(focus)])
        return kept(taking(delta, acquisition=acquisition, propagation=propagation, learned=True))

    assert of(3, 1) - of(2, 1) == of(2, 1) - of(1, 1)
    assert of(1, 3) - of(1, 2) == of(1, 2) - of(1, 1)
    # of each image its field, of each prism its transfer, of each focus plane its defocus
    assert 0 < of(2, 1) - of(1, 1) <= FIELDS + 2 * PIXELS
    assert 0 < of(1, 2) - of(1, 1) <= 2 * FIELDS


def test_without_gradients_no_field_is_kept_for_a_further_prism_or_focus(delta, propagation):
    def of(prisms, focus):
        acquisition = Acquisition([Prism((0.05, 0.1 * i), 1.0) for i in range(prisms)], [0.5 * i for i in range(focus)])
        return peak(taking(delta, acquisition=acquisition, propagation=propagation))

    assert of(4, 1) - of(3, 1) < FIELDS / 2
    assert of(1, 4) - of(1, 3) < FIELDS / 2


# --- absent effects ------------------------------------------------------------------------------------------------

ABSENT = {
    "aberrations": ({"objective": Objective(0.75, aberrations=None)}, {}),
    "no-aberrations": ({"objective": Objective(0.75, aberrations={})}, {}),
    "pupil-as-it-is": ({"objective": Objective(0.75, apodisation=None, layer=None)}, {}),
    "annulus": ({"condenser": Condenser(0.4, POINTS, inner_na=None)}, {}),
    "equal-weights": ({"condenser": Condenser(0.4, POINTS, torch.ones(3, dtype=torch.float64))}, {}),
    "polarisation": ({"polarisation": None}, {}),
    "ideal-polarisation": ({"polarisation": Polarisation()}, {}),
    "jones-pupil": ({"polarisation": Polarisation(pupil=None)}, {}),
    "empty-jones-pupil": ({"polarisation": Polarisation(pupil=JonesPupil({}, {}, depolarisation=False))}, {}),
    "condenser-prism": ({"condenser_prism": True}, {}),
    "spectrum": ({"spectrum": None}, {}),
    "one-colour": ({"spectrum": Spectrum((0.546,))}, {}),
    "camera": ({"camera": None}, {}),
    "camera-of-voxels": ({"camera": Camera(photons=1e4, read_noise=2.0, bits=12, offset=3.0)}, {}),
    "padding": ({}, {"padding": 0}),
    "object-aberration": ({}, {"object_aberration": None}),
    "exact-defocus": ({}, {"defocus": "exact"}),
    "band-limit": ({}, {"band_limit": False}),
    "absorption": ({}, {"absorption": None}),
}


# how light crosses the specimen can have a part in these
CROSSING = {
    "projection": ABSENT,
    "rays": ("absorption", "polarisation", "object-aberration"),
    "wave": ("absorption", "polarisation", "jones-pupil", "spectrum", "padding", "object-aberration"),
}


@pytest.mark.parametrize(
    ("propagation", "absent"),
    [
        pytest.param(
            propagation,
            absent,
            id=f"{propagation}-{name}",
            marks=() if name in CROSSING[propagation] else pytest.mark.slow,
        )
        for propagation in ("projection", "rays", "wave")
        for name, absent in ABSENT.items()
    ],
)
def test_what_is_absent_costs_nothing_and_changes_no_bit(delta, counted, propagation, absent):
    """The noise of a camera belongs to its recording, not to the image."""
    parts, options = absent
    plain = taking(delta, propagation=propagation)
    declared = taking(delta, replace(SCOPE, **parts), propagation=propagation, **options)
    assert counted(declared) == counted(plain)
    assert torch.equal(declared(), plain())
    assert peak(declared) == peak(plain)


def test_no_condenser_is_one_axial_wave(delta, counted, propagation):
    without, axial = (taking(delta, replace(SCOPE, condenser=c), propagation=propagation) for c in (None, Condenser(0)))
    assert counted(without) == counted(axial)
    assert torch.equal(without(), axial())
    assert peak(without) == peak(axial)


# --- present effects -----------------------------------------------------------------------------------------------

PARALLEL = {"ifft2": 2 * 2}  # of two prisms in two focus planes, the field that an ideal analyser stops
COST = {
    "aberrations": ({"objective": Objective(0.75, aberrations={7: 0.0})}, {}),
    "apodisation": ({"objective": Objective(0.75, apodisation="aplanatic")}, {}),
    "layer": ({"objective": Objective(0.75, layer=Layer(0.0, N0, 1.515))}, {}),
    "polarisation": ({"polarisation": Polarisation(analyser_error=0.0)}, PARALLEL),
    "condenser-prism": ({"condenser_prism": False}, {}),
    "camera": ({"camera": Camera(pixel_size=0.3)}, {}),
}


@pytest.mark.parametrize(("parts", "extra"), COST.values(), ids=COST.keys())
def test_what_is_present_costs_its_own(delta, counted, parts, extra):
    """A phase or amplitude in the pupil and the camera's pixels take no transform of a field, an analyser's error does.

    Zero is a value: the part's arrays are made, and what autograd keeps with them.
    """
    plain, declared = (taking(delta, scope, learned=True) for scope in (SCOPE, replace(SCOPE, **parts)))
    assert Counter(counted(declared)) == Counter(counted(plain)) + Counter(extra)
    if "condenser_prism" not in parts:  # each source has a shear's transfer of its own in any case, in its window
        assert kept(declared) > kept(plain)
    # straight rays take less than imaging does, so that its bytes show
    plain, declared = (taking(delta, scope, propagation="projection") for scope in (SCOPE, replace(SCOPE, **parts)))
    if "camera" in parts:  # works on images, after the fields are gone
        assert peak(declared) == peak(plain)
    else:
        assert peak(plain) < peak(declared) <= peak(plain) + 3 * FIELDS


@pytest.mark.parametrize(
    ("options", "method"),
    [
        pytest.param({"propagation": "projection"}, "cone", marks=pytest.mark.slow),
        ({"propagation": "projection"}, "linear"),
        pytest.param({"propagation": "rays", "amplitude": False}, "linear", marks=pytest.mark.slow),
        pytest.param({"propagation": "rays", "amplitude": False}, "cone", marks=pytest.mark.slow),
    ],
)
def test_object_aberration_costs_one_map_an_image_and_a_transform_for_each_level(delta, counted, options, method):
    """Whatever the number of sources, prisms and focus planes; Δn is sampled from the object's plane to the last face.

    The curvature of "linear" is sampled beside the value and its gradient, not by a call of its own.
    """
    for kind in ({}, {"object_aberration": method, "reference_plane": 0.0}):
        taking(delta, **options, **kind)()  # at its first image a kind of scene is measured
    plain = counted(taking(delta, **options))
    without = taking(delta, **options, reference_plane=0.0)
    present = taking(delta, **options, reference_plane=0.0, object_aberration=method)
    map_ = Counter(sample=4 * math.ceil(SLICES / 2))
    extra = Counter(counted(present)) - Counter(plain)
    found = object_levels(
        Volume(GRID, delta, N0),
        0.0,
        SCOPE,
        Fidelity(**options, object_aberration=method),
    )
    assert extra == map_ + Counter(fft2=len(found.defocus) - 1)
    assert 8 < len(found.defocus) < 12
    many = taking(delta, directions(8), **options, reference_plane=0.0, object_aberration=method)
    many()
    assert counted(many) == counted(present)
    assert float((present() - without()).abs().max()) > 1e-4
    kept_, more = (kept(taking(delta, learned=True, **options, object_aberration=m)) for m in (None, method))
    assert kept_ < more
    assert peak(without) < peak(present)


def test_paraxial_defocus_costs_no_transform(delta, counted, propagation):
    exact, paraxial = (taking(delta, propagation=propagation, defocus=d) for d in ("exact", "paraxial"))
    assert counted(exact) == counted(paraxial)
    assert float((exact() - paraxial()).abs().max()) > 1e-4


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
def test_band_limit_costs_no_transform(delta, counted, propagation):
    far = Acquisition(ACQUISITION.prisms, [60.0, -9.0])
    periodic, limited = (taking(delta, SCOPE, far, propagation, band_limit=limit) for limit in (False, True))
    assert counted(periodic) == counted(limited)
    assert float((periodic() - limited()).abs().max()) > 1e-4


def test_caustics_are_not_counted_where_a_bound_rules_them_out(delta, counted, monkeypatch):
    """Rays through a smooth specimen are followed from face to face as if there were no such thing."""
    function = taking(delta, propagation="rays")
    cost, most, images = counted(function), peak(function), function()
    monkeypatch.setattr(landing, "tubes_that_may_fold", lambda *_: None)
    assert counted(function) == cost
    assert torch.equal(function(), images)
    assert peak(function) == most


def test_counting_caustics_takes_neither_transforms_nor_evaluations(delta, counted, monkeypatch):
    """Tubes are made of the rays that there are: a tenth more of bytes at once, none for the backward pass."""
    plain = taking(delta, propagation="rays")
    learned = taking(delta, propagation="rays", learned=True)
    cost, most, saved, images = counted(plain), peak(plain), kept(learned), plain()
    looked = []
    look = Tubes.__call__
    monkeypatch.setattr(Tubes, "__call__", lambda self, state: looked.append(1) or look(self, state))
    monkeypatch.setattr(landing, "tubes_that_may_fold", lambda *_: Tubes(GRID, 1.0))
    assert counted(plain) == cost
    assert len(looked) == SLICES
    assert torch.equal(plain(), images)
    assert most < peak(plain) < 1.15 * most
    assert saved <= kept(learned) < 1.15 * saved


STRAIN = {1: (0.0, 0.0), 6: (0.1, 0.0)}
LEAKY = {"polariser_extinction": 0.0, "analyser_extinction": 0.0}
# fields of each of 4 DIC images and each of 2 bright fields, and the kind of light that comes behind the specimen
PUPILS = {
    "strain": (Polarisation(pupil=JonesPupil(STRAIN)), 1, False),
    "losses": (Polarisation(pupil=JonesPupil(diattenuation=STRAIN)), 1, False),
    "analyser-error": (Polarisation(analyser_error=0.0, pupil=JonesPupil(STRAIN)), 1, False),
    "one-leak": (Polarisation(analyser_extinction=0.0, pupil=JonesPupil(STRAIN)), 2, False),
    "two-leaks": (Polarisation(**LEAKY, pupil=JonesPupil(STRAIN)), 4, False),
    "turn": (Polarisation(pupil=JonesPupil(depolarisation=True)), 1, True),
    "all": (Polarisation(**LEAKY, pupil=JonesPupil(STRAIN, STRAIN, depolarisation=True)), 4, True),
}


@pytest.mark.parametrize(
    ("propagation", "polarisation", "states", "turns"),
    [
        pytest.param(way, *case, id=f"{way}-{name}", marks=() if way != "rays" or case[2] else pytest.mark.slow)
        for way in ("projection", "rays", "wave")
        for name, case in PUPILS.items()
    ],
)
def test_pupil_of_matrices_takes_a_field_for_each_state_of_the_light(
    delta, counted, monkeypatch, propagation, polarisation, states, turns
):
    """One for ideal polarisers, as without; up to 4 for leaky ones, and 4 for the bright field's unpolarised light.

    They share their calls. Rays that carry their polarisation have two components to transform, and no further samples.
    """
    sizes = []

    def sized(transform):
        def call(a, **options):
            result = transform(a, **options)
            sizes.append(result.numel())
            return result

        return call

    for name in ("ifft2", "fft2"):
        monkeypatch.setattr(torch.fft, name, sized(getattr(torch.fft, name)))
    plain, declared = (
        taking(delta, scope, propagation=propagation) for scope in (SCOPE, replace(SCOPE, polarisation=polarisation))
    )
    cost = counted(plain)
    fields, sizes[:] = sum(sizes), []
    assert counted(declared) == cost
    components = 1 if turns and propagation == "rays" else 0
    more = 4 * (states - 1) + 2 * 3 + components
    assert sum(sizes) - fields == more * len(POINTS) * ROWS * COLUMNS
    if propagation == "projection":  # the others take more than imaging does
        assert peak(plain) < peak(declared)


def test_matrices_are_made_once_for_all_prisms_and_focus_planes(delta, monkeypatch):
    calls = Counter()
    for owner, name in ((JonesPupil, "lenses"), (polarised, "turn")):
        plain = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *a, plain=plain, name=name: calls.update([name]) or plain(*a))
    pupil = JonesPupil(STRAIN, depolarisation=True)
    taking(delta, replace(SCOPE, polarisation=Polarisation(pupil=pupil)))()
    assert calls == {"lenses": 1, "turn": 1}


def test_pupil_is_cut_only_by_an_objective(delta, counted, monkeypatch):
    """Its aperture is a mask on the spectrum: no transform, and no bytes for the waves that it stops."""
    calls = []
    aperture = Objective.aperture
    monkeypatch.setattr(Objective, "aperture", lambda *a: calls.append(1) or aperture(*a))
    without, with_ = (
        taking(delta, replace(SCOPE, objective=part), propagation="projection") for part in (None, Objective(0.75))
    )
    cost = counted(without)
    assert len(calls) == 0
    assert counted(with_) == cost
    assert len(calls) == 1
    assert peak(with_) < peak(without)
    assert float((without() - with_()).abs().max()) > 1e-4


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_each_colour_is_an_image_of_its_own(delta, counted, propagation):
    """Three times the work, one after the other: no more bytes at once than the images of the other two."""
    plain = taking(delta, propagation=propagation)
    colours = taking(delta, replace(SCOPE, spectrum=Spectrum((0.5, 0.546, 0.6))), propagation=propagation)
    assert counted(colours) == {name: 3 * n for name, n in counted(plain).items()}
    assert peak(colours) <= peak(plain) + 2 * IMAGES * PIXELS
    assert kept(taking(delta, replace(SCOPE, spectrum=Spectrum((0.5, 0.6))), learned=True)) > 1.9 * kept(
        taking(delta, learned=True)
    )


@pytest.mark.parametrize("propagation", ["projection", pytest.param("rays", marks=pytest.mark.slow), "wave"])
def test_padding_takes_area_and_no_further_call(delta, counted, propagation):
    plain, padded = (taking(delta, propagation=propagation, padding=pad) for pad in (0, 6))
    assert counted(plain) == counted(padded)
    assert plain().shape == padded().shape
    growth = (ROWS + 12) * (COLUMNS + 12) / (ROWS * COLUMNS)
    assert peak(padded) > (1 + growth) / 2 * peak(plain)


def test_gradient_asks_for_no_further_forward_transform(delta, counted):
    """The backward pass has a transform for each of the forward's, and one more for each image, of whose fields
    none is kept.
    """
    learned = taking(delta, learned=True)
    forward = counted(learned)
    assert forward == counted(taking(delta))
    images = learned()
    backward = counted(lambda: images.sum().backward())
    assert backward == {"fft2": forward["ifft2"], "ifft2": forward["fft2"] + IMAGES}


def test_counts_see_what_they_claim_to(counted):
    """A counter that sees nothing would pass most of the above."""
    field = torch.ones(4, 4, dtype=torch.complex128)
    assert counted(lambda: torch.fft.ifft2(torch.fft.fft2(field))) == {"fft2": 1, "ifft2": 1}
    sampler = SliceSampler(GRID, torch.ones(GRID.shape, dtype=torch.float64).unbind(0), "linear")
    zero = torch.zeros(3, dtype=torch.float64)
    assert counted(lambda: (sampler.sample(0.1, zero, zero), sampler.value(0.1, zero, zero))) == {
        "sample": 1,
        "value": 1,
    }
    size = 64 * 64 * 8
    assert peak(lambda: torch.rand(64, 64, dtype=torch.float64).sin()) == 2 * size
    x = torch.ones(64, 64, dtype=torch.float64, requires_grad=True)
    assert kept(lambda: x.sin().cos()) == 2 * size
    assert math.isclose(kept(lambda: x * 2.0 + x.exp()), size)
