"""The specimen's own aberration against apparent depths, the graded-index rod, and one method against the other."""

import importlib.util
import math
import sys
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch.autograd.functional import jacobian

from data_synthetic import GaussianBall, GradedIndexRod, LayeredMedium
from torchdic import Fidelity, Grid, Volume
from torchdic.object_aberration.wavefront import CAREFUL, effective_defocus, wavefront

N0 = 1.36
DIRECTIONS = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, -0.5], [0.5, -0.7], [1.0, 0.6]], dtype=torch.float64)
FIGURE = Path(__file__).parents[1] / "experiments" / "figure4.py"


def uniform(contrast, nz=10, spacing=0.4, dtype=torch.float64):
    grid = Grid((nz, 5, 4), (spacing, 0.3, 0.35))
    return Volume(grid, torch.full(grid.shape, contrast, dtype=dtype), N0)


def ball(voxels, sides=(12.0, 14.0, 14.2), sigma=1.0):
    """A smooth ball off centre, in a volume so wide that its edges are empty to 1e-9."""
    grid = Grid(voxels, tuple(length / n for length, n in zip(sides, voxels, strict=True)))
    return Volume(grid, GaussianBall(sigma, 0.05, N0, (0.3, 0.1, -0.2)).delta(grid), N0)


def places(count, width=1.5):
    return width * (2 * torch.rand(count, 2, dtype=torch.float64) - 1)


def orders(errors):
    return [math.log2(a / b) for a, b in pairwise(errors)]


# --- homogeneous media and plates ----------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [math.inf, 2000.0, 7.0])
def test_empty_volume_shifts_nothing_in_any_direction(lens, dtype):
    volume = uniform(0.0, dtype=dtype)
    momentum = DIRECTIONS.to(dtype)[:, None, None]
    eps = torch.finfo(dtype).eps
    linear = effective_defocus(volume, -1.7, momentum, lens=lens)
    assert linear.dtype == dtype
    assert linear.shape == (5, 5, 4)
    # the steepest ray is 70 µm long if it goes on to a lens, 9 µm in the volume
    assert float(linear.abs().max()) < 100 * eps
    for half in (0.05, 0.4):
        cone = effective_defocus(volume, -1.7, momentum, method="cone", half_angle=half, lens=lens)
        assert float(cone.abs().max()) < 100 * eps / half**2


def apparent_depths(thickness, index, sine):
    """Where the backward extensions of two neighbouring rays cross, below a plate's face: sagittal and tangential.

    By Snell's law alone: rays of one inclination, turned about the point's normal, cross on it; rays of neighbouring
    inclinations where ∂(x − d·tanθ)/∂θ = 0.
    """

    def tangents(s):
        return s / math.sqrt(N0**2 - s**2), thickness * s / math.sqrt(index**2 - s**2)

    outside, x = tangents(sine)
    (before, x_before), (after, x_after) = tangents(sine - 1e-5), tangents(sine + 1e-5)
    return x / outside, (x_after - x_before) / (after - before)


@pytest.mark.parametrize("contrast", [0.15, pytest.param(-0.1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("momentum", [(0.0, 0.4), (-0.3, 0.6), (0.9, 0.0)])
def test_plate_shifts_by_its_mean_apparent_depth(contrast, momentum):
    """δ = t − (d_s + d_t)/2, which is t·{1 − ½[p_z0/p_z + n²p_z0³/(n0²p_z³)]}."""
    index, plane = N0 + contrast, -1.1
    thickness = 2.0 - plane
    sine = math.hypot(*momentum)
    sagittal, tangential = apparent_depths(thickness, index, sine)
    seen = wavefront(uniform(contrast), plane, torch.tensor(momentum, dtype=torch.float64), points=places(3))
    torch.testing.assert_close(
        seen.defocus, torch.full((3,), thickness - (sagittal + tangential) / 2).double(), rtol=0, atol=1e-7
    )
    ratio = math.sqrt(N0**2 - sine**2) / math.sqrt(index**2 - sine**2)
    formula = thickness * (1 - (ratio + ratio**3 * index**2 / N0**2) / 2)
    assert float(seen.defocus[0]) == pytest.approx(formula, abs=1e-12)
    # the tangential radius lies along the momentum, the sagittal one across it
    along = torch.tensor(momentum, dtype=torch.float64) / sine
    depth = seen.cosine[0] * seen.radius[0]
    assert float(along @ depth @ along) == pytest.approx(tangential, abs=1e-7)
    assert float(depth.trace()) == pytest.approx(sagittal + tangential, abs=1e-7)
    assert float(depth.det()) == pytest.approx(sagittal * tangential, abs=1e-6)


@pytest.mark.parametrize("contrast", [0.15, -0.1, -0.36])
def test_plate_seen_along_its_normal_shifts_by_its_thickness_times_one_less_the_ratio_of_indices(contrast):
    """A denser plate brings what lies under it nearer to the lens: δ > 0."""
    found = effective_defocus(uniform(contrast), -1.6)
    expected = 3.6 * (1 - N0 / (N0 + contrast))
    torch.testing.assert_close(found, torch.full((5, 4), expected, dtype=torch.float64), rtol=0, atol=1e-12)
    assert math.copysign(1, expected) == math.copysign(1, contrast)


def test_layers_add_up():
    layer = LayeredMedium(0.2, N0, -1.0, 2.0, 0.3)
    grid = Grid((120, 3, 2), (0.05, 0.3, 0.3))
    z = torch.linspace(-2, 3, 20001, dtype=torch.float64)
    index = N0 + layer.profile(z)
    p2 = DIRECTIONS.square().sum(-1, keepdim=True)
    ratio = (N0**2 - p2).sqrt() / (index**2 - p2).sqrt()
    expected = torch.trapezoid(1 - (ratio + ratio**3 * index**2 / N0**2) / 2, z)
    found = effective_defocus(Volume(grid, layer.delta(grid), N0), -2.0, DIRECTIONS, points=torch.zeros(2).double())
    # the spline's h⁴ at a face six voxels wide
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-6)


# --- graded-index rod ----------------------------------------------------------------------------------------------


def rod(alpha, length, half_width, spacing):
    """A rod whose second derivatives a spline misses by the fraction α²h²/4, its error h²/12 of the fourth ones."""
    n = round(2 * half_width / spacing) + 1
    grid = Grid((2, n, n), (length / 2, spacing, spacing))
    specimen = GradedIndexRod(alpha, N0)
    return specimen, Volume(grid, specimen.delta(grid), N0)


@pytest.mark.parametrize("turn", [0.3, 4.0, *(pytest.param(t, marks=pytest.mark.slow) for t in (1.2, 2.0, 3.0))])
def test_rod_on_its_axis_images_by_its_abcd_matrix(turn):
    """An axial point L before the end face seems at L − tan(αL)/α; past a quarter pitch its image is real."""
    alpha, length = 0.25, turn / 0.25
    _, volume = rod(alpha, length, 0.2, 0.01)
    fidelity = Fidelity("rays", steps=100, interpolation="cubic")
    found = effective_defocus(volume, -length / 2, fidelity=fidelity, points=torch.zeros(2, dtype=torch.float64))
    assert float(found) == pytest.approx(length - math.tan(turn) / alpha, rel=1e-5)


@pytest.mark.parametrize("plane", [-2.0, 0.7])
def test_rod_off_its_axis_has_the_foci_of_its_exact_rays(plane):
    """Neighbouring rays x + d·slope cross at −d, an eigenvalue of ∂x/∂slope; their mean is what the lens sees."""
    specimen, volume = rod(0.2, 8.0, 1.25, 0.025)
    points, momenta = places(6, 0.5), 0.15 * (2 * torch.rand(6, 2, dtype=torch.float64) - 1)
    fidelity = Fidelity("rays", steps=80, interpolation="cubic")
    found = effective_defocus(volume, plane, momenta, fidelity, points=points)
    for point, momentum, shift in zip(points, momenta, found, strict=True):

        def leaving(p, point=point):
            end = specimen.rays(point[None], p[None], plane, 4.0)
            slope = end.momentum / (N0**2 - end.momentum.square().sum(-1, keepdim=True)).sqrt()
            return end.position[0], slope[0]

        position, slope = jacobian(leaving, momentum)
        depths = torch.linalg.eigvals(position @ torch.linalg.inv(slope)).real
        assert float(shift) == pytest.approx(4.0 - plane - float(depths.mean()), rel=5e-5)
        assert abs(float(shift)) > 0.05


def test_index_graded_along_one_axis_bends_the_wave_along_that_one():
    alpha = 0.2
    grid = Grid((2, 41, 65), (2.0, 0.05, 0.05))
    x = grid.coordinates(2, dtype=torch.float64)
    delta = (N0 * ((1 - (alpha * x) ** 2).sqrt() - 1)).expand(grid.shape).clone()
    fidelity = Fidelity("rays", steps=80, interpolation="cubic")
    point = torch.zeros(2, dtype=torch.float64)
    for options in ({}, {"method": "cone", "half_angle": 1e-3}):
        radius = wavefront(Volume(grid, delta, N0), -1.5, fidelity=fidelity, points=point, **options).radius
        exact = torch.diag(torch.tensor([3.5, math.tan(alpha * 3.5) / alpha], dtype=torch.float64))
        # α²h²/4 = 2.5e-5 of the bending
        torch.testing.assert_close(radius, exact, rtol=0, atol=4e-5)


@pytest.mark.parametrize(
    ("solver", "order"),
    [pytest.param("euler", 1, marks=pytest.mark.slow), pytest.param("midpoint", 2, marks=pytest.mark.slow), ("rk4", 4)],
)
def test_solver_has_its_order(solver, order):
    """Along a skew ray inside one voxel, off the axis, where errors odd in the step cancel; against many steps."""
    _, volume = rod(0.25, 4.0, 1.8, 0.9)
    point, momentum = (torch.tensor(v, dtype=torch.float64) for v in ((0.2, 0.5), (0.1, -0.05)))

    def of(count, solver):
        fidelity = Fidelity("rays", steps=count, solver=solver, interpolation="cubic")
        return float(effective_defocus(volume, -2.0, momentum, fidelity, points=point))

    exact = of(128, "rk4")
    steps = (32, 64, 128) if order < 2 else (8, 16, 32)
    errors = [abs(of(n, solver) - exact) for n in steps]
    assert orders(errors) == pytest.approx([order] * 2, abs=0.2)


# --- one method against the other ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("momentum", "lens"),
    [
        pytest.param(p, lens, id=f"{p.tolist()}-{lens}", marks=() if i == fast else pytest.mark.slow)
        for lens, fast in ((math.inf, 4), (25.0, 3))
        for i, p in enumerate(DIRECTIONS)
    ],
)
def test_narrow_cone_agrees_with_the_linear_pair(momentum, lens):
    """To 1e-4 µm of a shift of 0.07 to 0.2 µm, wherever the lens is."""
    volume, points = ball((60, 120, 120)), places(20)
    linear = effective_defocus(volume, -0.7, momentum, points=points, lens=lens)
    cone = effective_defocus(volume, -0.7, momentum, points=points, lens=lens, method="cone", half_angle=0.01)
    assert float(linear.abs().max()) > 0.05
    torch.testing.assert_close(cone, linear, rtol=0, atol=1e-4)


def test_cone_reads_linear_slices_too():
    """The cone needs no second derivatives; with voxels of a fifth of σ linear ones cost some per cent."""
    volume, points = ball((60, 70, 72)), places(20)
    options = {"points": points, "method": "cone", "half_angle": 0.3}
    linear = effective_defocus(volume, -0.7, DIRECTIONS[1], Fidelity("rays"), **options)
    cubic = effective_defocus(volume, -0.7, DIRECTIONS[1], **options)
    assert 1e-6 < float((linear - cubic).abs().max()) < 0.1 * float(cubic.abs().max())


@pytest.mark.parametrize("momentum", DIRECTIONS[[0, 3]], ids=lambda p: str(p.tolist()))
@pytest.mark.parametrize("lens", [math.inf, 25.0])
def test_cone_is_second_order_in_its_half_angle(momentum, lens):
    """In a plate, where sampling and steps are exact."""
    volume = uniform(0.15)
    limit = float(effective_defocus(volume, -1.3, momentum, lens=lens)[0, 0])
    halves = (0.08, 0.04, 0.02, 0.01)
    found = [
        float(effective_defocus(volume, -1.3, momentum, lens=lens, method="cone", half_angle=h)[0, 0]) for h in halves
    ]
    assert orders([abs(d - limit) for d in found]) == pytest.approx([2] * 3, abs=0.05)


def test_cone_is_exact_for_a_sphere_where_a_parabola_is_short_by_a_quarter_of_the_angle_squared():
    radius, half = 3.5, torch.linspace(0.05, 0.3, 6, dtype=torch.float64)
    depth, across = radius * (1 - half.cos()), radius * half.sin()
    torch.testing.assert_close((across**2 + depth**2) / (2 * depth), torch.full_like(half, radius))
    short = 1 - across**2 / (2 * depth) / radius
    torch.testing.assert_close(-short, half**2 / -4, rtol=0.03, atol=0)
    found = wavefront(uniform(0.0), -1.5, DIRECTIONS[3], points=torch.zeros(2).double(), method="cone", half_angle=0.3)
    exact = 3.5 / found.cosine * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(found.radius, exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("method", [{}, {"method": "cone", "half_angle": 0.2}], ids=["linear", "cone"])
def test_lens_law_is_met_in_the_sharp_plane(method):
    """H = cosθ/(z_L − f) with H = ½ tr κ; for the linear pair κ = (R + L)⁻¹ with the radii of a lens at infinity."""
    volume, lens = ball((30, 35, 36)), 40.0
    momentum, points = DIRECTIONS[3], places(10)
    seen = wavefront(volume, -1.2, momentum, points=points, lens=lens, **method)
    mean = seen.curvature.diagonal(dim1=-2, dim2=-1).mean(-1)
    torch.testing.assert_close(mean, seen.mean_curvature)
    torch.testing.assert_close(seen.mean_curvature, seen.cosine / (lens - seen.sharp_plane))
    torch.testing.assert_close(seen.defocus, seen.sharp_plane + 1.2)
    if not method:
        far = wavefront(volume, -1.2, momentum, points=points)
        distance = (lens - 6.0) / far.cosine[:, None, None] * torch.eye(2, dtype=torch.float64)
        torch.testing.assert_close(seen.curvature, torch.linalg.inv(far.radius + distance))
        assert not far.curvature.any()


def test_near_lens_sees_an_astigmatic_point_nearer_by_its_square_over_the_distance():
    """δ(z_L) − δ(∞) = cosθ·((R1 − R2)/2)²/(L + R̄): the design's R = ½n0·tr(T⁻¹NT⁻¹) is the lens at infinity."""
    volume, point = uniform(0.15), torch.zeros(2).double()
    far = wavefront(volume, -2.0, DIRECTIONS[4], points=point)
    first, second = torch.linalg.eigvalsh(far.radius)
    for lens in (20.0, 200.0, 2000.0):
        near = effective_defocus(volume, -2.0, DIRECTIONS[4], points=point, lens=lens)
        distance = (lens - 2.0) / far.cosine
        gain = far.cosine * ((first - second) / 2) ** 2 / (distance + (first + second) / 2)
        torch.testing.assert_close(near - far.defocus, gain, rtol=1e-8, atol=1e-13)


# --- sampling and symmetry -----------------------------------------------------------------------------------------


def test_shift_does_not_depend_on_voxel_size():
    """The second derivatives of a spline are second order in the voxel, and so is the shift."""
    points, momentum = places(20), DIRECTIONS[1]

    def of(*voxels):
        return effective_defocus(ball(voxels), -0.7, momentum, points=points)

    exact = of(96, 160, 160)
    errors = [float((of(*voxels) - exact).square().mean().sqrt()) for voxels in ((30, 35, 36), (60, 70, 72))]
    assert orders(errors)[0] > 1.8
    assert errors[1] < 1e-3
    # unequal voxels
    assert float((of(50, 150, 80) - exact).abs().max()) < 2e-3


def test_map_is_that_of_the_voxel_centres():
    volume = ball((12, 9, 14), sides=(6.0, 6.0, 7.0))
    y, x = (volume.grid.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    points = torch.stack(torch.meshgrid(y, x, indexing="ij"), -1)
    found = effective_defocus(volume, -1.0, DIRECTIONS[1])
    assert found.shape == (9, 14)
    torch.testing.assert_close(found, effective_defocus(volume, -1.0, DIRECTIONS[1], points=points), rtol=0, atol=1e-13)
    every = effective_defocus(volume, -1.0, DIRECTIONS[:3, None, None])
    assert every.shape == (3, 9, 14)
    torch.testing.assert_close(every[1], found, rtol=0, atol=1e-13)


@pytest.mark.parametrize("options", [{}, {"method": "cone", "half_angle": 0.1}], ids=["linear", "cone"])
def test_map_turns_and_mirrors_with_the_specimen(options, smooth_field):
    grid = Grid((6, 11, 14), (0.4, 0.2, 0.25))
    delta = smooth_field(grid, 0.02)
    turned = Grid((6, 14, 11), (0.4, 0.25, 0.2))
    momentum = torch.tensor([0.2, -0.4], dtype=torch.float64)
    found = effective_defocus(Volume(grid, delta, N0), -0.9, momentum, **options)
    other = effective_defocus(Volume(turned, delta.transpose(1, 2), N0), -0.9, momentum.flip(0), **options)
    mirrored = effective_defocus(Volume(grid, delta.flip(1), N0), -0.9, momentum * torch.tensor([-1, 1]), **options)
    torch.testing.assert_close(other, found.T, rtol=0, atol=1e-10)
    torch.testing.assert_close(mirrored, found.flip(0), rtol=0, atol=1e-10)
    assert float(found.std()) > 0.01


def test_only_what_lies_behind_the_point_shifts_it():
    grid = Grid((20, 7, 8), (0.3, 0.4, 0.4))
    delta = torch.zeros(grid.shape, dtype=torch.float64)
    delta[:8] = 0.05 * torch.rand(8, 7, 8, dtype=torch.float64)
    found = effective_defocus(Volume(grid, delta, N0), 2.4, DIRECTIONS[2])
    # a spline's influence falls by 2 + √3 a voxel: 0.05·3.7⁻¹⁰ at the tenth, over its size squared
    assert float(found.abs().max()) < 1e-4
    torch.testing.assert_close(
        effective_defocus(Volume(grid, delta, N0), 3.0), torch.zeros(7, 8).double(), rtol=0, atol=0
    )


# --- gradients and memory ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [{}, {"lens": 9.0}, {"method": "cone", "half_angle": 0.15}],
    ids=["linear", "near lens", "cone"],
)
def test_gradient_in_index_and_background_is_that_of_central_differences(options, smooth_field):
    grid = Grid((5, 8, 9), (0.4, 0.3, 0.35))
    delta, way = smooth_field(grid, 0.03), smooth_field(grid, seed=1)
    points, momentum = places(4, 0.8), DIRECTIONS[1]
    weight = torch.tensor([1.0, -0.3, 0.7, 2.0], dtype=torch.float64)

    def total(delta, background):
        return weight @ effective_defocus(Volume(grid, delta, background), -0.7, momentum, points=points, **options)

    background = torch.tensor(N0, dtype=torch.float64)
    leaves = (delta.requires_grad_(), background.requires_grad_())
    by_delta, by_background = torch.autograd.grad(total(*leaves), leaves)
    step = 1e-6
    with torch.no_grad():
        slope = float(total(delta + step * way, background) - total(delta - step * way, background)) / (2 * step)
        assert float((by_delta * way).sum()) == pytest.approx(slope, rel=1e-6)
        slope = float(total(delta, background + step) - total(delta, background - step)) / (2 * step)
        assert float(by_background) == pytest.approx(slope, rel=1e-6)


def test_recomputed_gradient_is_the_kept_one(smooth_field):
    grid = Grid((9, 8, 9), (0.3, 0.3, 0.35))

    def gradient(memory):
        delta = smooth_field(grid, 0.03).requires_grad_()
        found = effective_defocus(
            Volume(grid, delta, N0), -1.0, fidelity=Fidelity("rays", interpolation="cubic", memory=memory)
        )
        return torch.autograd.grad(found.square().sum(), delta)[0]

    torch.testing.assert_close(gradient(1), gradient(1 << 30), rtol=1e-12, atol=1e-12)


def test_result_requires_grad_only_where_the_volume_does():
    assert not effective_defocus(uniform(0.1), 0.0).requires_grad
    assert CAREFUL.interpolation == "cubic"


# --- errors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"plane": 2.1}, r"plane 2.1 µm lies outside the volume, which fills -2 … 2 µm"),
        ({"plane": math.nan}, "nan"),
        ({"lens": 1.9}, r"lens at 1.9 µm must lie behind the volume, whose last face is at 2 µm"),
        ({"fidelity": Fidelity("rays", solver="dopri5", interpolation="cubic")}, "dopri5"),
        ({"fidelity": Fidelity("rays")}, "second derivatives"),
        ({"half_angle": 0.1}, "no use"),
        ({"method": "cone"}, "half_angle None"),
        ({"method": "cone", "half_angle": 0.0}, r"half_angle 0.0 rad must be above 0 and below"),
        ({"method": "cone", "half_angle": 0.8, "momentum": DIRECTIONS[4]}, r"45.84° around a ray at 59.04° from z"),
    ],
    ids=str,
)
def test_what_breaks_a_law_is_refused_with_both_numbers(options, words):
    with pytest.raises(ValueError, match=words):
        effective_defocus(uniform(0.02), **{"plane": 0.0, **options})


@pytest.mark.parametrize("options", [{}, {"method": "cone", "half_angle": 0.1}], ids=["linear", "cone"])
def test_rays_that_would_turn_are_counted_in_an_error(options):
    """Index 1.0 in a medium of 1.36 totally reflects n·sinθ > 1; a dense plate traps n·sinθ > 1.36."""
    layer = LayeredMedium(-0.36, N0, -1.0, 2.0, 0.3)
    grid = Grid((40, 3, 3), (0.15, 0.3, 0.3))
    volume = Volume(grid, layer.delta(grid), N0)
    momentum = torch.tensor([[0.0, 0.2], [1.15, 0.0], [-0.8, 0.8], [0.5, 0.5]], dtype=torch.float64)
    count = r"2 of 4" if not options else r"\d+ of 68"
    with pytest.raises(ValueError, match=count + r" rays can't go on toward \+z"):
        effective_defocus(volume, -2.5, momentum, points=torch.zeros(2).double(), **options)


def test_rays_that_a_plate_traps_are_counted_in_an_error():
    with pytest.raises(ValueError, match=r"1 of 2 rays can't go on toward \+z"):
        effective_defocus(
            uniform(0.2), 0.0, torch.tensor([[0.0, 1.4], [0.3, 0.0]]).double(), points=torch.zeros(2).double()
        )


# --- Figure 4 ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_figure_4_shows_a_depression_that_pulls_up_what_lies_beneath(monkeypatch, tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("figure4_experiment", FIGURE)
    figure4 = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(figure4)
    monkeypatch.setattr(figure4, "GRID", Grid((12, 1, 65), (0.4, 0.2, 0.2)))
    monkeypatch.setattr(sys, "argv", ["figure4.py", "--out", str(tmp_path / "out")])
    maps, original = [], figure4.aberration_map
    monkeypatch.setattr(figure4, "aberration_map", lambda delta: maps.append(original(delta)) or maps[-1])
    assert figure4.main() == 0
    assert (tmp_path / "out" / "figure4.png").stat().st_size > 10_000
    assert "depression" in capsys.readouterr().out
    convex, dented = maps
    middle = 32 + round(figure4.DENT[0][1] / 0.2)
    # behind the object's middle: a plate of about 3 µm; the depression diverges and adds to it
    plate = 3.0 * (1 - 1.33 / 1.41)
    assert float(convex[1, 32]) == pytest.approx(plate, rel=0.2)
    assert float(dented[1, middle]) > float(convex[1, middle])
    # nothing lies between the last slices and the lens
    assert float(dented[-1].abs().max()) < 1e-3
