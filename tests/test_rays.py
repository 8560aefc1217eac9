"""Rays against exact answers: Snell's law, the graded-index rod, and the order of the method."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from through import deviation

from data_synthetic import GaussianBall, GradedIndexRod, LayeredMedium
from torchdic import Fidelity, Grid, Rays, Volume, launch, trace
from torchdic.rays import solver as ray_solver

N0 = 1.36
DIRECTIONS = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.0, -0.5], [0.4, 0.6], [-0.7, 0.1]], dtype=torch.float64)


def bundle(count, width=0.5, na=0.08, dtype=torch.float64):
    position = width * (2 * torch.rand(count, 2, dtype=torch.float64) - 1)
    momentum = na * (2 * torch.rand(count, 2, dtype=torch.float64) - 1)
    return Rays(position.to(dtype), momentum.to(dtype), torch.zeros(count, dtype=dtype))


def errors(found, exact):
    return {
        name: float((getattr(found, name).double() - getattr(exact, name)).abs().max())
        for name in ("position", "momentum", "opd")
    }


def rod(alpha=0.1, half_width=1.6, length=60.0, spacing=0.05):
    """A rod sampled so finely (cubic: h⁴·n''''/384 ≈ 1e-11) that the integrator's error is all there is."""
    n = round(2 * half_width / spacing) + 1
    specimen = GradedIndexRod(alpha, 1.6)
    grid = Grid((2, n, n), (length / 2, spacing, spacing))
    return specimen, grid, Volume(grid, specimen.delta(grid), 1.6)


# --- the graded-index rod ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("solver", "order"), [("euler", 1), ("midpoint", 2), ("rk4", 4)])
def test_solver_has_its_order(solver, order):
    """Twice the steps, 2^order less error in position, momentum and W; over one oscillation of the rod's rays."""
    specimen, _, volume = rod()
    start = bundle(20)
    exact = specimen.rays(start.position, start.momentum, -30.0, 30.0)
    steps = (128, 256) if order < 4 else (24, 48)
    coarse, fine = (
        errors(trace(volume, start, Fidelity("rays", steps=n, solver=solver, interpolation="cubic")), exact)
        for n in steps
    )
    for name in coarse:
        # Euler's next order is but 1/128 of an oscillation away
        assert math.log2(coarse[name] / fine[name]) == pytest.approx(order, abs=0.3), name


def test_rk4_is_fourth_order():
    specimen, _, volume = rod()
    start = bundle(20)
    exact = specimen.rays(start.position, start.momentum, -30.0, 30.0)
    steps = [16, 32, 64, 128]
    found = [errors(trace(volume, start, Fidelity("rays", steps=n, interpolation="cubic")), exact) for n in steps]
    for name in ("position", "momentum", "opd"):
        orders = [math.log2(a[name] / b[name]) for a, b in pairwise(found)]
        assert orders == pytest.approx([4, 4, 4], abs=0.25), name


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-9), (torch.float32, 3e-7)], ids=["float64", "float32"]
)
def test_opd_of_the_rod_loses_no_digits_to_the_long_path(dtype, tolerance):
    """The path is 32 µm, W some 0.02 µm: float32's rounding of the path alone would be 4e-6 µm."""
    specimen = GradedIndexRod(0.02, 1.6)
    grid = Grid((20, 81, 81), (1.0, 0.1, 0.1))
    volume = Volume(grid, specimen.delta(grid, dtype), 1.6)
    start = bundle(200, width=1.5, na=0.15, dtype=dtype)
    exact = specimen.rays(start.position, start.momentum, -10.0, 10.0)
    found = trace(volume, start, Fidelity("rays", steps=40, interpolation="cubic"))
    assert float(exact.opd.abs().max()) > 0.01
    assert errors(found, exact)["opd"] < tolerance


@pytest.mark.parametrize(("interpolation", "order"), [("linear", 2), ("cubic", 4)])
def test_interpolation_has_its_order_in_the_voxel_size(interpolation, order):
    """W along rays through a Gaussian ball, against the finest voxels: half the voxel, 2^order less error."""
    ball = GaussianBall(1.0, 0.02, N0, (0.1, -0.2, 0.15))
    start = bundle(300, width=0.9, na=0.3)
    start = Rays(start.position - 4 * start.momentum / N0, start.momentum, start.opd)

    def opd(voxels):
        grid = Grid((voxels,) * 3, (9.6 / voxels,) * 3)
        volume = Volume(grid, ball.delta(grid), N0)
        return trace(volume, start, Fidelity("rays", steps=96, interpolation=interpolation)).opd

    fine = Grid((144,) * 3, (9.6 / 144,) * 3)
    exact = trace(Volume(fine, ball.delta(fine), N0), start, Fidelity("rays", steps=96, interpolation="cubic")).opd
    coarse, half = (float((opd(n) - exact).square().mean().sqrt()) for n in (24, 48))
    assert math.log2(coarse / half) == pytest.approx(order, abs=0.5)
    assert half < 1e-2 * float(exact.abs().max())


# --- polarisation carried along ---------------------------------------------------------------------------------------


def carried(alpha, n0, x, p, length):
    """E of a ray through the rod, started along the local x axis and carried by E' = −(E·t')t; and its local axes.

    In three dimensions (x, y, z), along the ray of n² = n0²(1 − α²r²), solved to 1e-11.
    """

    def local_axes(t):
        # the shortest turn of z to t, v ↦ v + w×v + w×(w×v)/(1 + cosθ) with w = z×t
        w = np.cross([0, 0, 1], t)
        axes = [v + np.cross(w, v) + np.cross(w, np.cross(w, v)) / (1 + t[2]) for v in np.eye(3)]
        np.testing.assert_allclose(axes[2], t, atol=1e-12)
        return np.stack(axes[:2])

    def direction(p, pz):
        return np.array([*p, pz]) / math.hypot(*p, pz)

    pz = math.sqrt(n0**2 * (1 - alpha**2 * (x @ x)) - p @ p)

    def motion(_z, state):
        x, p, e = state[:2], state[2:4], state[4:]
        bend = -(n0**2) * alpha**2 * x / pz
        n = math.hypot(*p, pz)
        # p_z is constant in the rod: t' = p'/n − (n'/n)t, of which E·t = 0 leaves the first
        return [*(p / pz), *bend, *(-(e[:2] @ bend / n) * direction(p, pz))]

    start = local_axes(direction(p, pz))[0]
    end = solve_ivp(motion, (0, length), [*x, *p, *start], rtol=1e-11, atol=1e-12).y[:, -1]
    return end[4:], local_axes(direction(end[2:4], pz))


@pytest.mark.parametrize("given", [pytest.param(0.0, marks=pytest.mark.slow), 0.4])
def test_polarisation_is_carried_parallel_to_itself(given):
    """Along skew rays of both hands in the rod, and two that cross its axis, one of them through θ = 0."""
    _, _, volume = rod()
    xy = np.array([[0.5, 0.1], [0.3, -0.7], [-0.8, 0.0], [0.0, 0.9], [0.4, 0.8]])
    momentum = np.array([[0.02, 0.09], [0.03, 0.05], [0.0, 0.128], [0.0, 0.0], [0.04, 0.08]])
    yx, p = (torch.from_numpy(v[:, ::-1].copy()) for v in (xy, momentum))
    turn = torch.full((5,), given, dtype=torch.float64)
    found = trace(
        volume, Rays(yx, p, torch.zeros_like(turn), turn=turn), Fidelity("rays", steps=512, interpolation="cubic")
    ).turn
    for i in range(5):
        field, axes = carried(0.1, 1.6, xy[i], momentum[i], 60.0)
        expected = math.atan2(axes[1] @ field, axes[0] @ field)
        # RK4 at 1/54 of an oscillation, its error 1e-8 and less
        assert float(found[i]) - given == pytest.approx(expected, abs=1e-8)
    # both hands turn, and rays in a plane with the axis do not
    assert float(found[0]) - given > 5e-3
    assert float(found[2]) - given < -5e-3
    assert float((found[3:] - given).abs().max()) < 1e-8


def test_turn_along_a_helix_is_its_solid_angle():
    """One pitch of a circular helix: its direction circles z once at θ, and τ = ±2π(1 − cosθ)."""
    alpha, n0, radius = 0.1, 1.6, 1.0
    pz = n0 * math.sqrt(1 - 2 * (alpha * radius) ** 2)  # the axial momentum of a circular ray, whose |p| is n0·α·r
    pitch = 2 * math.pi * pz / (n0 * alpha)
    _, _, volume = rod(length=pitch)
    # from (x, y) = (r, 0) towards +y: from +x towards +y, and the other way
    p = n0 * alpha * radius * torch.tensor([[1.0, 0.0], [-1.0, 0.0]], dtype=torch.float64)
    position = torch.tensor([[0.0, radius]], dtype=torch.float64).expand(2, 2)
    start = Rays(position, p, torch.zeros(2, dtype=torch.float64), turn=torch.zeros(2, dtype=torch.float64))
    found = trace(volume, start, Fidelity("rays", steps=512, interpolation="cubic"))
    torch.testing.assert_close(found.position, start.position, rtol=0, atol=1e-6)
    cosine = pz / math.hypot(pz, n0 * alpha * radius)
    expected = 2 * math.pi * (1 - cosine) * torch.tensor([1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(found.turn, expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("options", [{}, {"memory": 1}, {"solver": "dopri5"}], ids=str)
def test_turn_is_asked_for_and_changes_nothing_else(smooth_field, options):
    grid = Grid((5, 8, 9), (0.4, 0.2, 0.2))
    volume = Volume(grid, smooth_field(grid, 0.05), N0, 0.01 * smooth_field(grid, seed=1).abs())
    start, fidelity = bundle(12, na=0.4), Fidelity("rays", **options)
    plain = deviation(volume, start, fidelity)
    turning = deviation(volume, start, fidelity, turn=True)
    assert plain.turn is None
    assert trace(volume, start, fidelity).turn is None
    assert float(turning.turn.abs().min()) > 0
    # an adaptive solver holds τ to its tolerance too, by other steps
    tolerance = 1e-5 if "solver" in options else 0
    for name in ("position", "momentum", "opd", "absorbed"):
        torch.testing.assert_close(getattr(turning, name), getattr(plain, name), rtol=0, atol=tolerance)


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_gradient_of_turn_is_the_central_difference(smooth_field, interpolation):
    grid = Grid((4, 8, 9), (0.6, 0.22, 0.2))
    start = bundle(20, na=0.4)
    weights = torch.rand(20, dtype=torch.float64)

    def of(delta, background):
        found = deviation(
            Volume(grid, delta, background), start, Fidelity("rays", interpolation=interpolation), turn=True
        )
        return (weights * found.turn).sum()

    point = [smooth_field(grid, 0.04), torch.tensor(N0, dtype=torch.float64)]
    for i in range(2):
        values = [v.clone().requires_grad_(i == j) for j, v in enumerate(point)]
        (gradient,) = torch.autograd.grad(of(*values), values[i])
        direction = torch.randn_like(gradient).abs() * torch.where(gradient < 0, -1.0, 1.0)
        step = 1e-5

        def at(t, i=i, direction=direction, step=step):
            return float(of(*(v + t * step * direction if i == j else v for j, v in enumerate(point))))

        expected = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)
        assert abs(expected) > 1e-4
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)


# --- Snell's law ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_snells_law_holds_in_a_layered_medium(interpolation, dtype):
    """n sinθ is conserved to rounding; displacement and W are those of exact quadrature to the sampling's order."""
    layer = LayeredMedium(0.2, N0, -2.0, 3.0, 0.4)
    grid = Grid((200, 3, 4), (0.05, 0.3, 0.3))
    volume = Volume(grid, layer.delta(grid, dtype), N0)
    start = Rays(torch.zeros(5, 2, dtype=dtype), DIRECTIONS.to(dtype), torch.zeros(5, dtype=dtype))
    found = trace(volume, start, Fidelity("rays", interpolation=interpolation))
    exact = layer.rays(start.position.double(), start.momentum.double(), -5.0, 5.0)
    eps = torch.finfo(dtype).eps
    torch.testing.assert_close(found.momentum, start.momentum, rtol=0, atol=100 * eps)
    assert torch.equal(found.momentum[0], torch.zeros(2, dtype=dtype)) or interpolation == "cubic"
    # linear interpolation along z: h²/12 of the change of Δn', which W's integral then mostly cancels
    tolerance = {"linear": 2e-4, "cubic": 2e-6}[interpolation] + 100 * eps
    error = errors(found, exact)
    assert error["opd"] < tolerance
    assert error["position"] < tolerance
    # the layer bends obliquely incident rays by far more than that
    straight = start.position + start.momentum / (N0**2 - start.momentum.square().sum(-1, keepdim=True)).sqrt() * 10
    assert float((exact.position - straight).abs().max()) > 0.1


def equation_of_motion(form):
    """d(α, α')/dz for n(x, z) with n, n_x, n_z given, α = x(z), w = ds/dz = √(1 + α'²)."""

    def right(slope, w, n, nx, nz):
        return w**2 / n * (nx - slope * nz)

    def printed(slope, w, n, nx, nz):
        # Kagalwala & Kanade, Eq. 9: w² − α_z stands for w² − α_z², and n_z·w for α_z·n_z·(w − α_z²/w)
        return w**3 / (n * (w**2 - slope)) * (nx * (w - slope**2 / w) - nz * w)

    def mended(slope, w, n, nx, nz):
        return w**3 / (n * (w**2 - slope**2)) * (nx * (w - slope**2 / w) - slope * nz * (w - slope**2 / w))

    return {"right": right, "printed": printed, "mended": mended}[form]


def ray_in_a_layer(form, layer, slope):
    """x and n sinθ of a ray after a layered medium, from the second-order equation in z, solved to 1e-10."""
    acceleration = equation_of_motion(form)

    def motion(z, state):
        n = layer.background + float(layer.profile(torch.tensor(z, dtype=torch.float64)))
        top = (z - layer.bottom) / layer.edge, (z - layer.bottom - layer.thickness) / layer.edge
        nz = layer.contrast / 2 / layer.edge * (1 / math.cosh(top[0]) ** 2 - 1 / math.cosh(top[1]) ** 2)
        return [state[1], acceleration(state[1], math.sqrt(1 + state[1] ** 2), n, 0.0, nz)]

    end = solve_ivp(motion, (-5.0, 5.0), [0.0, slope], rtol=1e-10, atol=1e-12, max_step=0.05).y[:, -1]
    n = layer.background + float(layer.profile(torch.tensor(5.0, dtype=torch.float64)))
    return end[0], n * end[1] / math.sqrt(1 + end[1] ** 2)


@pytest.mark.parametrize("momentum", [-0.6, *(pytest.param(p, marks=pytest.mark.slow) for p in (0.0, 0.35))])
def test_printed_equation_9_breaks_snells_law_where_ours_keeps_it(momentum):
    """Light from 1.36 into 1.56. As printed, even an axial ray bends, which symmetry forbids; not so in ours."""
    layer = LayeredMedium(0.2, N0, 0.0, math.inf, 0.5)
    grid = Grid((400, 2, 2), (0.025, 0.3, 0.3))
    volume = Volume(grid, layer.delta(grid), N0)
    p0 = torch.tensor([[0.0, momentum]], dtype=torch.float64)
    start = Rays(torch.zeros(1, 2, dtype=torch.float64), p0, torch.zeros(1, dtype=torch.float64))
    ours = trace(volume, start, Fidelity("rays", interpolation="cubic"))
    assert float(ours.momentum[0, 1]) == pytest.approx(momentum, abs=1e-12)
    slope = momentum / math.sqrt(N0**2 - momentum**2)
    for form in ("right", "mended"):
        position, conserved = ray_in_a_layer(form, layer, slope)
        assert conserved == pytest.approx(momentum, abs=1e-8)
        assert position == pytest.approx(float(ours.position[0, 1]), abs=1e-5)
    position, conserved = ray_in_a_layer("printed", layer, slope)
    assert abs(conserved - momentum) > 0.05
    assert abs(position - float(ours.position[0, 1])) > 0.2


@pytest.mark.parametrize("slope", [-0.6, 0.0, 0.45])
def test_right_equation_9_is_fermats_and_the_printed_one_is_not(slope):
    """(n r')' = ∇n in the arc length, by finite differences along the parabola that each form asks for."""
    n, nx, nz = 1.4, 0.03, -0.05
    w = math.sqrt(1 + slope**2)
    # d/dz (n·α'/w) = w·n_x is Eq. 7's transverse part, expanded in α''
    fermat = (w * nx - (nx * slope + nz) * slope / w) * w**3 / n
    assert equation_of_motion("right")(slope, w, n, nx, nz) == pytest.approx(fermat, rel=1e-12)
    assert equation_of_motion("mended")(slope, w, n, nx, nz) == pytest.approx(fermat, rel=1e-12)
    assert abs(equation_of_motion("printed")(slope, w, n, nx, nz) - fermat) > 0.01


# --- other solvers -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_adaptive_solver_meets_its_tolerance_on_a_few_hard_rays_among_many(monkeypatch):
    """Every single ray counts: 3 meet a steep small ball, 600 pass at its side.

    With an RMS over the batch, torchdiffeq's own norm, the hard ones' errors are taken for √(3/600) of what they are.
    """
    grid = Grid((40, 40, 40), (0.15, 0.15, 0.15))
    volume = Volume(grid, GaussianBall(0.35, 0.15, N0, (0.5, 1.6, 1.6)).delta(grid), N0)
    hard, easy = bundle(3, width=0.3, na=0.01), bundle(600, width=1.2, na=0.01)
    position = torch.cat((hard.position + 1.6, easy.position - 1.2))
    start = Rays(position, torch.cat((hard.momentum, easy.momentum)), torch.zeros(603, dtype=torch.float64))
    alone = Rays(start.position[:3], start.momentum[:3], start.opd[:3])
    # steps that end at the spline's knots: 4th order, 5e-10 µm off
    exact = trace(volume, alone, Fidelity("rays", steps=400, interpolation="cubic"))
    tolerance = 1e-9
    fidelity = Fidelity("rays", solver="dopri5", tolerance=tolerance, interpolation="cubic")

    def error():
        found = trace(volume, start, fidelity)
        return max(errors(Rays(found.position[:3], found.momentum[:3], found.opd[:3]), exact).values())

    ours = error()
    # local errors of some dozen steps add up
    assert ours < 30 * tolerance
    monkeypatch.setattr(ray_solver, "_largest", lambda state: state.square().mean().sqrt())
    assert error() > 5 * ours


@pytest.mark.parametrize("solver", ["dopri5", *(pytest.param(s, marks=pytest.mark.slow) for s in ("bosh3", "dopri8"))])
def test_adaptive_solver_does_not_jump_over_a_specimen_behind_an_empty_stretch(solver):
    layer = LayeredMedium(0.1, N0, 12.0, 1.0, 0.2)
    grid = Grid((140, 2, 2), (0.25, 0.3, 0.3))
    start = Rays(torch.zeros(5, 2, dtype=torch.float64), DIRECTIONS, torch.zeros(5, dtype=torch.float64))
    found = trace(Volume(grid, layer.delta(grid), N0), start, Fidelity("rays", solver=solver, interpolation="cubic"))
    exact = layer.rays(start.position, start.momentum, -17.5, 17.5)
    assert float(exact.opd.min()) > 0.09
    # the layer's edges are as wide as a voxel: 1 % by sampling
    torch.testing.assert_close(found.opd, exact.opd, rtol=0.01, atol=0)


@pytest.mark.parametrize("solver", [pytest.param("bosh3", marks=pytest.mark.slow), "dopri5", "dopri8"])
def test_adaptive_solvers_agree_with_the_exact_rod(solver):
    specimen, _, volume = rod()
    start = bundle(20)
    exact = specimen.rays(start.position, start.momentum, -30.0, 30.0)
    found = trace(volume, start, Fidelity("rays", solver=solver, tolerance=1e-7, interpolation="cubic"))
    assert max(errors(found, exact).values()) < 1e-4


# --- the contract of trace -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(), (3,), (2, 3, 4), (0,)], ids=str)
def test_rays_cross_the_empty_volume_straight_from_face_to_face(shape, dtype):
    grid = Grid((5, 6, 7), (0.4, 0.2, 0.2))
    volume = Volume(grid, torch.zeros(grid.shape, dtype=dtype), N0)
    start = Rays(
        torch.randn(*shape, 2, dtype=dtype), 0.3 * torch.randn(*shape, 2, dtype=dtype), torch.rand(shape, dtype=dtype)
    )
    found = trace(volume, start, Fidelity("rays"))
    pz = (N0**2 - start.momentum.square().sum(-1, keepdim=True)).sqrt()
    torch.testing.assert_close(found.position, start.position + 2.0 * start.momentum / pz)
    assert torch.equal(found.momentum, start.momentum)
    assert torch.equal(found.opd, start.opd)
    assert found.absorbed is None


def test_opd_is_added_to_the_given_one_and_absorption_too(smooth_field):
    grid = Grid((5, 8, 9), (0.4, 0.2, 0.2))
    volume = Volume(grid, smooth_field(grid, 0.02), N0, 0.01 * smooth_field(grid, seed=1).abs())
    start = bundle(12)
    given = torch.rand(12, dtype=torch.float64)
    bare = trace(volume, start, Fidelity("rays"))
    found = trace(volume, Rays(start.position, start.momentum, given, given / 2), Fidelity("rays"))
    torch.testing.assert_close(found.opd, bare.opd + given, rtol=0, atol=1e-15)
    torch.testing.assert_close(found.absorbed, bare.absorbed + given / 2, rtol=0, atol=1e-15)
    assert float(bare.absorbed.min()) > 0


def test_volume_reaches_its_outer_faces():
    """A uniform volume of nz slices is nz·dz thick: half a voxel beyond the outermost centres on each side."""
    grid = Grid((3, 4, 4), (0.8, 0.3, 0.3))
    volume = Volume(
        grid, torch.full(grid.shape, 0.05, dtype=torch.float64), N0, torch.full(grid.shape, 0.01, dtype=torch.float64)
    )
    momentum = torch.tensor([[0.3, -0.5]], dtype=torch.float64)
    found = trace(
        volume,
        Rays(torch.zeros(1, 2, dtype=torch.float64), momentum, torch.zeros(1, dtype=torch.float64)),
        Fidelity("rays"),
    )
    inside, outside = (math.sqrt(n**2 - 0.34) for n in (N0 + 0.05, N0))
    assert float(found.opd) == pytest.approx(2.4 * (inside - outside), rel=1e-12)
    # an absolute path of 2.4·n/p_z through κ
    assert float(found.absorbed) == pytest.approx(2.4 * 0.01 * (N0 + 0.05) / inside, rel=1e-12)
    torch.testing.assert_close(found.position, 2.4 * momentum / inside)


def test_beyond_the_sides_rays_see_the_edge_voxels_index():
    grid = Grid((3, 4, 4), (0.8, 0.3, 0.3))
    delta = torch.zeros(grid.shape, dtype=torch.float64)
    delta[:, -1] = 0.04
    momentum = torch.zeros(2, 2, dtype=torch.float64)
    position = torch.tensor([[3.0, 0.1], [-3.0, 0.1]], dtype=torch.float64)
    found = trace(
        Volume(grid, delta, N0), Rays(position, momentum, torch.zeros(2, dtype=torch.float64)), Fidelity("rays")
    )
    torch.testing.assert_close(found.opd, torch.tensor([2.4 * 0.04, 0.0], dtype=torch.float64))
    torch.testing.assert_close(found.position, position)


def test_launched_rays_would_cross_the_plane_at_voxel_centres():
    grid = Grid((6, 5, 8), (0.5, 0.2, 0.3))
    momentum = torch.tensor([[0.4, -0.1], [0.0, 0.6]], dtype=torch.float64)
    background = torch.tensor(N0, dtype=torch.float64)
    start = launch(grid, momentum, background, plane=0.7, margin=1)
    assert start.position.shape == (2, 7, 10, 2)
    crossing = (
        start.position
        + (1.5 + 0.7) * momentum[:, None, None] / (N0**2 - momentum.square().sum(-1)).sqrt()[:, None, None, None]
    )
    for source in crossing:
        torch.testing.assert_close(source[1:-1, 0, 0], grid.coordinates(1, dtype=torch.float64))
        torch.testing.assert_close(source[0, 1:-1, 1], grid.coordinates(2, dtype=torch.float64))
    assert torch.equal(start.momentum[1, 3, 4], momentum[1])
    assert not start.opd.any()


def test_no_steps_means_one_per_slice_and_others_are_as_said(smooth_field):
    grid = Grid((6, 8, 9), (0.4, 0.2, 0.2))
    volume = Volume(grid, smooth_field(grid, 0.05), N0)
    start = bundle(30)

    def of(steps):
        return trace(volume, start, Fidelity("rays", steps=steps, interpolation="cubic"))

    default, same, fewer, more, exact = (of(n) for n in (None, 6, 2, 24, 192))
    assert torch.equal(default.opd, same.opd)
    error = [errors(f, exact)["opd"] for f in (fewer, default, more)]
    assert error[0] > 2 * error[1] > 4 * error[2] > 0


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"memory": 1},
        {"interpolation": "cubic"},
        {"solver": "dopri5"},
        pytest.param({"solver": "bosh3", "interpolation": "cubic"}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_rays_that_would_turn_are_counted_in_an_error(options):
    """Index 1.0 in a medium of 1.5 totally reflects n·sinθ > 1."""
    layer = LayeredMedium(-0.45, 1.5, -1.0, 2.0, 0.3)
    grid = Grid((40, 3, 3), (0.15, 0.3, 0.3))
    momentum = torch.tensor([[0.0, 0.2], [1.2, 0.0], [0.6, 0.6], [0.0, -1.3], [-0.9, 0.9]], dtype=torch.float64)
    start = Rays(torch.zeros(5, 2, dtype=torch.float64), momentum, torch.zeros(5, dtype=torch.float64))
    volume = Volume(grid, layer.delta(grid), 1.5)
    with pytest.raises(ValueError, match=r"3 of 5 rays can't go on toward \+z"):
        trace(volume, start, Fidelity("rays", **options))


def test_ray_is_reversible(smooth_field):
    """Through the z-mirrored volume with momentum reversed, a ray returns to where it came from: Fermat's symmetry."""
    grid = Grid((12, 16, 16), (0.3, 0.2, 0.2))
    delta = smooth_field(grid, 0.03)
    start = bundle(50)
    fidelity = Fidelity("rays", steps=120, interpolation="cubic")
    there = trace(Volume(grid, delta, N0), start, fidelity)
    back = trace(
        Volume(grid, delta.flip(0), N0), Rays(there.position, -there.momentum, torch.zeros_like(there.opd)), fidelity
    )
    # RK4 with steps of 0.03 µm; beyond the sides and faces the field has kinks
    torch.testing.assert_close(back.position, start.position, rtol=0, atol=1e-6)
    torch.testing.assert_close(-back.momentum, start.momentum, rtol=0, atol=1e-6)


def test_opd_is_the_difference_of_paths_from_the_plane_wave():
    """W = ∫n ds − p0·(x − x0) − p_z0·(z − z0), by integrating the path itself in numpy for one bent ray."""
    ball = GaussianBall(0.8, 0.05, N0)
    grid = Grid((96, 96, 96), (0.0625, 0.0625, 0.0625))
    x0, p0 = np.array([0.1, -0.5]), np.array([-0.1, 0.35])

    def motion(z, state):
        x, p = state[:2], state[2:4]
        delta = 0.05 * math.exp(-(z**2 + x @ x) / 1.28)
        n = N0 + delta
        pz = math.sqrt(n**2 - p @ p)
        return [*(p / pz), *(n * -delta * x / 0.64 / pz), n**2 / pz]

    end = solve_ivp(motion, (-3, 3), [*x0, *p0, 0.0], rtol=1e-11, atol=1e-12).y[:, -1]
    expected = end[4] - p0 @ (end[:2] - x0) - 6 * math.sqrt(N0**2 - p0 @ p0)
    start = Rays(*(torch.from_numpy(v)[None] for v in (x0, p0)), torch.zeros(1, dtype=torch.float64))
    found = trace(Volume(grid, ball.delta(grid), N0), start, Fidelity("rays", interpolation="cubic"))
    assert float(found.opd) == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(found.position[0], end[:2], atol=1e-5)
    np.testing.assert_allclose(found.momentum[0], end[2:4], atol=1e-5)


def test_rays_of_another_dtype_are_converted_with_their_graph(smooth_field):
    grid = Grid((5, 8, 9), (0.4, 0.2, 0.2))
    volume = Volume(grid, smooth_field(grid, 0.02), N0)
    position = torch.zeros(3, 2, dtype=torch.float32, requires_grad=True)
    found = trace(volume, Rays(position, torch.zeros(3, 2), torch.zeros(3)), Fidelity("rays"))
    assert found.opd.dtype == found.position.dtype == volume.delta.dtype == torch.float64
    (gradient,) = torch.autograd.grad(found.position.sum(), position)
    assert gradient.dtype == torch.float32
    assert gradient.abs().min() > 0.5  # δx hardly depends on where a ray starts
