"""Each object point with the defocus of its own: against the plain sum over points, plates, and the wave equation."""

import math
from dataclasses import replace

import pytest
import torch

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.object_aberration.levels import MOST_LEVELS, levels, object_levels
from torchdic.object_aberration.wavefront import CAREFUL, effective_defocus
from torchdic.plane_waves import axial_difference, exp_i

N0 = 1.36
WAVELENGTH = 0.546
K0 = 2 * math.pi / WAVELENGTH
GRID = Grid((5, 12, 15), (0.5, 0.2, 0.21))
POINTS = torch.tensor([[0.0, 0.0], [0.31, -0.12], [-0.17, 0.24]], dtype=torch.float64)
SCOPE = Microscope(WAVELENGTH, Objective(0.75), Condenser(0.4, POINTS))
ACQUISITION = Acquisition([Prism((0.05, 0.21), 1.1), None], [0.6, -0.9])
LINEAR = Fidelity("projection", object_aberration="linear")
CONE = replace(LINEAR, object_aberration="cone")
BENT = Fidelity("rays", amplitude=False, object_aberration="linear")
MODES = {"linear": LINEAR, "cone": CONE, "bent": BENT}


@pytest.fixture(params=MODES.values(), ids=MODES.keys())
def fidelity(request):
    return request.param


def without(fidelity):
    return replace(fidelity, object_aberration=None)


def stained(delta, seed=0):
    """A volume whose absorption is seen wherever its index is uniform."""
    random = torch.Generator().manual_seed(seed)
    return Volume(GRID, delta, N0, 0.02 * torch.rand(GRID.shape, generator=random, dtype=torch.float64))


# --- the sum over levels -------------------------------------------------------------------------------------------


def scene():
    """A field of three sources, a map of δ from −0.2 to 0.7 µm, and p_z − p_z0 where waves go on."""
    random = torch.Generator().manual_seed(3)
    field = torch.randn(3, 12, 15, generator=random, dtype=torch.complex128)
    defocus = 0.9 * torch.rand(12, 15, generator=random, dtype=torch.float64) - 0.2
    difference, pz = axial_difference(GRID, WAVELENGTH, torch.tensor(N0, dtype=torch.float64), POINTS)
    return field, defocus, torch.where(pz > 0, difference, 0)


def spread_one_by_one(field, defocus, difference):
    """Σ_x' U(x')·exp(−2πi f·x')·exp(−i k0 δ(x') q(f)) as it stands, pixel by pixel."""
    total = torch.zeros_like(field)
    for index in range(defocus.numel()):
        point = torch.zeros_like(field)
        y, x = divmod(index, defocus.shape[1])
        point[:, y, x] = field[:, y, x]
        total += torch.fft.fft2(point, norm="forward") * exp_i(-K0 * defocus[y, x] * difference)
    return total


@pytest.mark.parametrize("span", [1e-12, 0.01, 1.0, 8.0])
def test_levels_are_the_sum_over_object_points_to_rounding(span):
    """Whatever δ spans, from less than a rounding of the phase to ±b = 30 rad."""
    field, defocus, difference = scene()
    defocus = span * defocus
    found = levels(defocus, K0 * N0).spread(field, WAVELENGTH, difference)
    expected = spread_one_by_one(field, defocus, difference)
    # of 180 terms; the interpolation's weights add up to at most 1 + (2/π)·ln(levels)
    eps = 100 * torch.finfo(torch.float64).eps
    torch.testing.assert_close(found, expected, rtol=0, atol=eps * float(field.abs().max()))


def test_components_of_a_field_spread_alike():
    field, defocus, difference = scene()
    shared = levels(defocus, K0 * N0)
    both = shared.spread(torch.stack((field, 2j * field), 1), WAVELENGTH, difference)
    alone = shared.spread(field, WAVELENGTH, difference)
    torch.testing.assert_close(both, torch.stack((alone, 2j * alone), 1), rtol=1e-13, atol=1e-13)


def test_error_falls_with_the_levels_as_the_bound_does():
    """8·(b/2)^K/K!: geometric and better; each tolerance is met, and by no more than a few levels."""
    field, defocus, difference = scene()
    exact = spread_one_by_one(field, defocus, difference)
    size = float(field.abs().mean((1, 2)).max())
    counts, errors = [], []
    for tolerance in (1e-1, 1e-2, 1e-4, 1e-6, 1e-8):
        shared = levels(defocus, K0 * N0, tolerance)
        counts.append(len(shared.defocus))
        errors.append(float((shared.spread(field, WAVELENGTH, difference) - exact).abs().max()) / size)
        assert 1e-5 * tolerance < errors[-1] < tolerance
    assert counts == sorted(counts)
    assert counts[-1] < 3 * counts[0]


def test_shares_of_a_point_sum_to_one_and_give_back_its_defocus():
    _, defocus, _ = scene()
    shared = levels(defocus, 9.0)
    torch.testing.assert_close(shared.share.sum(0), torch.ones_like(defocus), rtol=0, atol=1e-13)
    torch.testing.assert_close(torch.tensordot(shared.defocus, shared.share, 1), defocus, rtol=0, atol=1e-13)


def test_single_precision_asks_for_fewer_levels():
    _, defocus, _ = scene()
    assert len(levels(defocus.float(), 2.0).defocus) < len(levels(defocus, 2.0).defocus)
    # ±1 rad, as the module says
    assert len(levels(torch.tensor([[-1.0, 1.0]]), 1.0).defocus) == 9


# --- laws of the image ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("contrast", [0.12, -0.07])
@pytest.mark.parametrize("defocus", ["exact", "paraxial"])
def test_plate_over_all_points_is_a_plain_shift_of_focus(contrast, defocus):
    """Uniform index: δ = t(1 − n0/n) of every point, t from it to the last face, positive nearer to the lens."""
    volume = stained(torch.full(GRID.shape, contrast, dtype=torch.float64))
    fidelity = replace(LINEAR, defocus=defocus, reference_plane=-0.3)
    shift = (GRID.extent[0] / 2 + 0.3) * (1 - N0 / (N0 + contrast))
    moved = replace(ACQUISITION, focus=[z - shift for z in ACQUISITION.focus])
    found, expected = image(volume, SCOPE, ACQUISITION, fidelity), image(volume, SCOPE, moved, without(fidelity))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)
    unmoved = image(volume, SCOPE, ACQUISITION, without(fidelity))
    assert float((found - unmoved).abs().max()) > 1e-3


def test_plate_shifts_the_cones_points_alike(fidelity):
    """A cone's δ is not the plate's paraxial one, but it is uniform too."""
    volume = stained(torch.full(GRID.shape, 0.12, dtype=torch.float64))
    half = math.asin(0.4 / N0) if fidelity is CONE else None
    options = {"fidelity": CAREFUL, "method": fidelity.object_aberration, "half_angle": half}
    shift = float(effective_defocus(volume, volume.mean_plane(), **options)[0, 0])
    moved = replace(ACQUISITION, focus=[z - shift for z in ACQUISITION.focus])
    found, expected = image(volume, SCOPE, ACQUISITION, fidelity), image(volume, SCOPE, moved, without(fidelity))
    # the fit of a cone takes its differences over half²
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_empty_volume_is_left_as_it_is(fidelity, dtype):
    volume = stained(torch.zeros(GRID.shape, dtype=torch.float64))
    volume = Volume(GRID, volume.delta.to(dtype), N0, volume.absorption)
    found, plain = (image(volume, SCOPE, ACQUISITION, f) for f in (fidelity, without(fidelity)))
    # a map of rounding, and its sum over 5 or 9 levels
    torch.testing.assert_close(found, plain, rtol=0, atol=100 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("fidelity", [LINEAR, CONE], ids=["linear", "cone"])
def test_image_turns_and_mirrors_with_the_specimen(fidelity, smooth_field):
    delta = smooth_field(GRID, 0.02)
    turned = Grid((5, 15, 12), (0.5, 0.21, 0.2))
    found = image(Volume(GRID, delta, N0), SCOPE, ACQUISITION, fidelity)
    assert float((found - image(Volume(GRID, delta, N0), SCOPE, ACQUISITION, without(fidelity))).abs().max()) > 1e-3

    def scope(sign):
        return replace(SCOPE, condenser=Condenser(0.4, POINTS.flip(1) if sign is None else POINTS * sign))

    across = Acquisition([Prism((0.21, 0.05), 1.1), None], ACQUISITION.focus)
    other = image(Volume(turned, delta.transpose(1, 2), N0), scope(None), across, fidelity)
    torch.testing.assert_close(other, found.transpose(2, 3), rtol=0, atol=1e-10)
    flipped = Acquisition([Prism((-0.05, 0.21), 1.1), None], ACQUISITION.focus)
    mirrored = image(Volume(GRID, delta.flip(1), N0), scope(torch.tensor([-1, 1])), flipped, fidelity)
    torch.testing.assert_close(mirrored, found.flip(2), rtol=0, atol=1e-10)


def test_stain_under_a_plate_is_seen_where_its_plane_waves_meet():
    """Below 6 µm of index 1.50 each wave of a thin stain gathers t(√(n² − p²) − n): straight rays miss 0.56 µm."""
    thickness, index, na = 6.0, N0 + 0.14, 0.4
    grid = Grid((33, 48, 50), (0.2, 0.18, 0.18))
    delta = torch.zeros(grid.shape, dtype=torch.float64)
    delta[3:] = index - N0
    y, x = (grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    kappa = torch.zeros_like(delta)
    kappa[1] = 0.1 * torch.exp(-((y[:, None] - 0.4) ** 2 + (x + 0.3) ** 2) / 0.1)
    plane = grid.centre(0, 1)
    focus = [plane + z for z in (0.0, 0.56, 1.2)]

    transmission = torch.exp(-K0 * grid.spacing[0] * kappa[1]).to(torch.complex128)
    p2 = WAVELENGTH**2 * grid.frequencies(dtype=torch.float64).square().sum(0)
    inside, outside = ((n**2 - p2.clamp_max(na**2)).sqrt() - n for n in (index, N0))
    waves = torch.where(p2 <= na**2, torch.fft.fft2(transmission), 0)
    phases = [K0 * (thickness * inside + (z - plane - thickness) * outside) for z in focus]
    exact = torch.stack([torch.fft.ifft2(waves * exp_i(phase)).abs().square() for phase in phases])

    def error(fidelity):
        fidelity = replace(fidelity, reference_plane=plane)
        taken = Microscope(WAVELENGTH, Objective(na)), Acquisition([None], focus)
        found = image(Volume(grid, delta, N0, kappa), *taken, fidelity)[0]
        return float((found - exact).square().mean().sqrt() / exact.std())

    # what is left is the plate's spherical aberration
    assert error(Fidelity("projection")) > 0.05
    assert error(LINEAR) < 0.05 * error(Fidelity("projection"))


def test_map_reads_the_volume_as_a_spline_in_the_fidelitys_steps(smooth_field):
    """Whatever solver and interpolation the fidelity's own rays have."""
    volume = Volume(GRID, smooth_field(GRID, 0.02), N0)
    plane = volume.mean_plane()
    for fidelity in (replace(BENT, solver="dopri5", steps=3), replace(LINEAR, interpolation="linear", steps=3)):
        shared = object_levels(volume, plane, SCOPE, fidelity)
        found = torch.tensordot(shared.defocus, shared.share, 1)
        expected = effective_defocus(volume, plane, fidelity=replace(CAREFUL, steps=3))
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-13)


# --- gradients and memory ------------------------------------------------------------------------------------------


def total(volume, fidelity, focus=0.6):
    images = image(volume, SCOPE, Acquisition(ACQUISITION.prisms, [focus, -0.9]), fidelity)
    random = torch.Generator().manual_seed(1)
    return (images * torch.rand(images.shape, generator=random, dtype=images.dtype)).sum()


@pytest.mark.parametrize(
    ("start", "fidelity"),
    [
        pytest.param(0.03, LINEAR, id="linear"),
        pytest.param(0.03, CONE, id="cone"),
        pytest.param(0.03, replace(LINEAR, defocus="paraxial"), id="paraxial", marks=pytest.mark.slow),
        pytest.param(0.0, LINEAR, id="at-zero-linear"),
        pytest.param(0.0, CONE, id="at-zero-cone", marks=pytest.mark.slow),
        pytest.param(0.0, replace(LINEAR, defocus="paraxial"), id="at-zero-paraxial", marks=pytest.mark.slow),
    ],
)
def test_gradient_is_the_central_difference(smooth_field, fidelity, start):
    """In Δn, also where it is 0 and the map has no span, in the background and in the focus."""
    values = [start * smooth_field(GRID), torch.tensor(N0).double(), torch.tensor(0.6).double()]
    ways = [smooth_field(GRID, seed=2), torch.tensor(1.0).double(), torch.tensor(1.0).double()]

    def of(delta, background, focus):
        volume = stained(delta)
        return total(Volume(GRID, delta, background, volume.absorption), fidelity, focus)

    leaves = [v.clone().requires_grad_() for v in values]
    gradients = torch.autograd.grad(of(*leaves), leaves)
    for i, (gradient, way) in enumerate(zip(gradients, ways, strict=True)):
        if fidelity is CONE and i == 1:
            continue  # its half angle depends on the background, but carries no gradient
        # second derivatives of a spline have kinks at the voxel centres: few rays may cross them
        step = 1e-7 if i == 0 and fidelity is not CONE else 1e-5

        def at(t, i=i, way=way, step=step):
            with torch.no_grad():
                return float(of(*(v + t * step * way if j == i else v for j, v in enumerate(values))))

        expected = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)
        assert abs(expected) > 1e-4
        assert float((gradient * way).sum()) == pytest.approx(expected, rel=1e-6)


def test_gradient_goes_through_the_map_too(smooth_field, monkeypatch):
    delta = smooth_field(GRID, 0.03).requires_grad_()
    (whole,) = torch.autograd.grad(total(Volume(GRID, delta, N0), LINEAR), delta)
    monkeypatch.setattr(
        "torchdic.object_aberration.levels.effective_defocus", lambda *a, **k: effective_defocus(*a, **k).detach()
    )
    (cut,) = torch.autograd.grad(total(Volume(GRID, delta, N0), LINEAR), delta)
    assert float((whole - cut).abs().max()) > 0.01 * float(whole.abs().max())


@pytest.mark.parametrize("fidelity", [CONE, LINEAR, BENT])
@pytest.mark.slow
def test_recomputed_gradient_is_the_kept_one(smooth_field, fidelity):
    def gradient(memory):
        delta = smooth_field(GRID, 0.03).requires_grad_()
        return torch.autograd.grad(total(Volume(GRID, delta, N0), replace(fidelity, steps=3, memory=memory)), delta)[0]

    # the same sums in another order, of derivatives over half² or the voxel's size squared
    torch.testing.assert_close(gradient(1), gradient(1 << 30), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("learned", [("delta",), ("background",), ("delta", "background")], ids="-".join)
def test_levels_keep_no_more_than_they_count(learned):
    """Beyond what imaging keeps: each level's share of every source, and the map's own for all of them."""
    field, defocus, difference = scene()
    for name, value in (("delta", defocus), ("background", difference)):
        value.requires_grad_(name in learned)
    shared = levels(defocus, K0 * N0)
    held = {}

    def keep(tensor):
        held[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        shared.spread(field.requires_grad_(), WAVELENGTH, difference)
    found, kept = sum(storage.nbytes() for storage in held.values()), 5 * len(shared.defocus) + 4
    assert 0.4 * kept < found / difference.numel() / 8 <= kept


def test_batches_share_the_map_and_its_levels(smooth_field):
    volume = Volume(GRID, smooth_field(GRID, 0.03), N0)
    with torch.no_grad():
        batched, whole = (total(volume, replace(LINEAR, memory=m)) for m in (1, 1 << 30))
    torch.testing.assert_close(batched, whole, rtol=1e-12, atol=0)


# --- errors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("condenser", [None, Condenser(0.0)], ids=["none", "axial"])
def test_cone_needs_a_condensers_aperture(condenser):
    volume = stained(torch.zeros(GRID.shape, dtype=torch.float64))
    with pytest.raises(ValueError, match="takes its half angle from the condenser, whose NA must be above 0"):
        image(volume, replace(SCOPE, condenser=condenser), ACQUISITION, CONE)
    image(volume, replace(SCOPE, condenser=condenser), ACQUISITION, LINEAR)


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_map_without_bound_is_refused(value):
    defocus = torch.zeros(4, 5)
    defocus[1, 2] = value
    with pytest.raises(ValueError, match="without bound: light of some object point leaves the volume collimated"):
        levels(defocus, 1.0)


def test_too_wide_a_map_is_refused_with_its_numbers():
    defocus = torch.tensor([[-30.0, 100.0]])
    with pytest.raises(ValueError, match=rf"from -30 to 100 µm asks for \d+ levels, more than {MOST_LEVELS}: light of"):
        levels(defocus, 3.0)
    assert len(levels(defocus, 1.0).defocus) <= MOST_LEVELS


def test_reference_plane_outside_the_volume_is_refused():
    with pytest.raises(ValueError, match=r"object plane 2.0 µm lies outside the volume"):
        image(
            stained(torch.zeros(GRID.shape, dtype=torch.float64)),
            SCOPE,
            ACQUISITION,
            replace(LINEAR, reference_plane=2.0),
        )
