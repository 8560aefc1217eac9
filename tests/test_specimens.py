"""Specimens hold the volume they should, where they should, and their exact answers solve the equations."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad, solve_ivp

from data_synthetic import (
    Bead,
    CellPhantom,
    Ellipsoid,
    EtchedGlassGrating,
    EtchedGlassStep,
    GaussianBall,
    GradedIndexRod,
    LayeredMedium,
    Organelle,
)
from torchdic.grid import Grid

GRID = Grid((30, 61, 72), (0.3, 0.2, 0.21))
SPECIMENS = [
    Bead(2.5, 0.03, 1.56, (0.2, -0.3, 0.5)),
    LayeredMedium(0.1, 1.4, -1.0, 2.0, 0.5),
    GradedIndexRod(0.02, 1.6, (0.5, -0.3)),
    GaussianBall(1.0, 0.03, 1.36, (0.4, 1.0, -2.0)),
    CellPhantom(),
    EtchedGlassStep(1.3, 1.46, 1.40, (0.6, 0.8), 0.4, 0.2),
    EtchedGlassGrating(1.3, 1.46, 1.40, (0.6, 0.8), 0.4, 0.2, period=3.1, duty=0.4),
]


def each(specimen):
    return type(specimen).__name__


def voxel(grid):
    return math.prod(grid.spacing)


@pytest.mark.parametrize("specimen", SPECIMENS, ids=each)
def test_index_is_background_plus_delta(specimen):
    delta, index = specimen.delta(GRID), specimen.index(GRID)
    assert delta.shape == GRID.shape
    assert delta.dtype == torch.float64
    assert torch.equal(index, specimen.background + delta)
    assert float(delta.abs().max()) > 0
    single = specimen.index(GRID, torch.float32, "cpu")
    assert single.dtype == torch.float32
    assert torch.equal(single, index.float())
    assert specimen.delta(GRID, dtype=torch.float32).is_contiguous()


@pytest.mark.parametrize("specimen", [s for s in SPECIMENS if not isinstance(s, LayeredMedium)], ids=each)
def test_swapped_or_flipped_axes_show(specimen):
    grid = Grid((40, 40, 40), (0.21, 0.21, 0.21))
    delta = specimen.delta(grid)
    for axes in ((1,), (2,)):
        assert not torch.allclose(delta.flip(axes), delta, atol=1e-5)
    assert not torch.allclose(delta.transpose(1, 2), delta, atol=1e-5)
    assert not torch.allclose(delta.transpose(0, 2), delta, atol=1e-5)


def test_layered_medium_shows_a_flip_along_z_only():
    delta = LayeredMedium(0.1, 1.4, -1.0, 1.0, 0.5).delta(GRID)
    assert torch.equal(delta[:, :1, :1].expand(GRID.shape), delta)
    assert not torch.allclose(delta.flip(0), delta, atol=1e-3)


@pytest.mark.parametrize("spacing", [(0.15, 0.15, 0.15), (0.4, 0.2, 0.2), (0.13, 0.31, 0.17)])
@pytest.mark.parametrize("subpixels", [4, 5])
def test_fill_sums_to_the_volume(spacing, subpixels):
    ellipsoid = Ellipsoid((2.0, 2.6, 3.1), (0.03, 0.05, -0.07))
    grid = Grid(tuple(math.ceil(7 / d) for d in spacing), spacing)
    fill = ellipsoid.fill(grid, subpixels)
    assert float(fill.min()) == 0
    assert float(fill.max()) == 1
    # Only the rim's columns err: measured 1e-4 of the volume at most.
    assert float(fill.sum()) * voxel(grid) == pytest.approx(ellipsoid.volume, rel=4e-4)


def test_fill_converges_with_subpixels():
    ellipsoid = Ellipsoid((2.0, 2.0, 2.0), (0.01, 0.02, 0.03))
    grid = Grid((16, 24, 24), (0.3, 0.2, 0.2))
    fine = ellipsoid.fill(grid, 64)
    errors = [float((ellipsoid.fill(grid, n) - fine).square().mean().sqrt()) for n in (1, 4, 16)]
    assert errors[1] < 0.3 * errors[0]
    assert errors[2] < 0.3 * errors[1]


@pytest.mark.parametrize("shape", [(20, 30, 30), (21, 31, 30), (21, 30, 31)])
def test_centred_bead_is_symmetric(shape):
    delta = Bead(2.0, 0.03, 1.56).delta(Grid(shape, (0.25, 0.2, 0.2)))
    for axis in range(3):
        assert torch.allclose(delta.flip(axis), delta, rtol=0, atol=1e-15)
    if shape[1] == shape[2]:
        assert torch.allclose(delta.mT, delta, rtol=0, atol=1e-15)


def test_bead_moves_with_its_centre():
    grid = Grid((20, 30, 32), (0.25, 0.2, 0.2))
    delta, moved = (Bead(1.5, 0.03, 1.56, c).delta(grid) for c in ((0.0, 0.0, 0.0), (0.25, -0.4, 0.6)))
    assert torch.allclose(delta.roll((1, -2, 3), (0, 1, 2)), moved, rtol=0, atol=1e-14)


def test_bead_reaching_out_of_the_box_is_cut():
    delta = Bead(5.0, 0.03, 1.56, (0.0, 0.0, 6.0)).delta(Grid((4, 20, 20), (0.2, 0.2, 0.2)))
    assert float(delta[:, :, 0].max()) == 0
    assert delta[:, 10, -1] == pytest.approx([0.03] * 4, rel=1e-12)
    assert float(Bead(1.0, 0.03, 1.56, (50.0, 0.0, 0.0)).delta(GRID).abs().max()) == 0


def test_index_does_not_depend_on_voxel_size():
    ball, bead = GaussianBall(1.0, 0.03, 1.36, (0.3, 0.1, -0.2)), Bead(2.0, 0.03, 1.56, (0.3, 0.1, -0.2))
    sums = {
        each(s): [
            float(s.delta(Grid((2 * n, 2 * n + 1, 2 * n), (10 / n,) * 3)).sum()) * (10 / n) ** 3 for n in (24, 40)
        ]
        for s in (ball, bead)
    }
    # The Gaussian's Riemann sum is exact to exp(−2π²σ²/d²); the bead's to its rim.
    assert sums["GaussianBall"] == pytest.approx([0.03 * (2 * math.pi) ** 1.5] * 2, rel=1e-10)
    assert sums["Bead"] == pytest.approx([0.03 * 4 / 3 * math.pi * 8] * 2, rel=3e-3)


def test_cell_holds_its_organelles():
    cell, grid = CellPhantom(), Grid((60, 70, 90), (0.1, 0.1, 0.1))
    delta = cell.delta(grid)
    for part in (cell.cytoplasm, cell.nucleus, *cell.nucleoli, cell.vacuole, cell.lipid):
        voxels = int((delta - part.contrast).abs().lt(1e-12).sum())
        assert voxels * voxel(grid) > 0.2 * part.shape.volume
    z, y, x = (round(grid.index(a, c)) for a, c in enumerate(cell.lipid.shape.centre))
    assert float(delta[z, y, x]) == pytest.approx(0.05)
    mass = cell.cytoplasm.contrast * cell.cytoplasm.shape.volume
    for part, host in (
        (cell.nucleus, cell.cytoplasm),
        (cell.vacuole, cell.cytoplasm),
        (cell.lipid, cell.cytoplasm),
    ):
        mass += (part.contrast - host.contrast) * part.shape.volume
    mass += sum((n.contrast - cell.nucleus.contrast) * n.shape.volume for n in cell.nucleoli)
    assert float(delta.sum()) * voxel(grid) == pytest.approx(mass, rel=2e-4)
    plain = CellPhantom(nucleus=None, nucleoli=(), vacuole=None, lipid=None).delta(grid)
    assert torch.equal(plain, 0.022 * cell.cytoplasm.shape.fill(grid))


@pytest.mark.parametrize("edge", [0.0, 0.5])
@pytest.mark.parametrize("direction", [(0.0, 1.0), (0.0, -2.0), (1.0, 0.0), (0.6, 0.8)])
def test_etched_step_s_opd_rises_along_its_direction(direction, edge):
    step = EtchedGlassStep(1.3, 1.46, 1.40, direction, 0.4, 0.13, edge)
    opd = step.delta(GRID).sum(0) * GRID.spacing[0]
    unit = torch.tensor(direction, dtype=torch.float64) / math.hypot(*direction)
    y, x = (GRID.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    u = unit[0] * y[:, None] + unit[1] * x - 0.4
    high, low = opd[u > 2.9], opd[u < -2.9]
    # tanh is within 1e-5 of its end at u = 2.9 µm, 5.8 edge widths.
    assert high - low.mean() == pytest.approx(np.full(len(high), step.opd_step), rel=3e-5)
    assert step.opd_step == pytest.approx(1.3 * 0.06)
    assert low == pytest.approx(np.full(len(low), 0.06 * (GRID.extent[0] / 2 + 0.13 - 0.65)), rel=3e-5)


def test_etched_step_is_anti_aliased_at_its_wall():
    grid = Grid((4, 3, 6), (0.5, 0.2, 0.2))
    step = EtchedGlassStep(0.6, 1.5, 1.4, (0.0, 1.0), offset=0.05)
    opd = step.delta(grid).sum(0)[1] * 0.5
    # The wall at 0.05 µm leaves 3 of the 4 columns of the voxel from 0 to 0.2 µm on the high side.
    assert (opd - opd[0]) / step.opd_step == pytest.approx([0, 0, 0, 0.75, 1, 1], abs=1e-12)


@pytest.mark.parametrize("duty", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("direction", [(0.0, 1.0), (1.0, 0.0)])
def test_grating_fills_its_exact_share_and_has_its_mean_index(duty, direction):
    """Over whole periods the mean surface is surface + height·(duty − ½); walls on voxel faces, so exactly."""
    grid = Grid((9, 40, 40), (0.3, 0.2, 0.2))
    grating = EtchedGlassGrating(0.7, 1.46, 1.40, direction, 1.0, 0.13, period=4.0, duty=duty)
    level = 0.13 + 0.7 * (duty - 0.5)
    expected = 0.06 * (level + grid.extent[0] / 2) / grid.extent[0]
    assert float(grating.delta(grid).mean()) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("edge", [0.0, 0.05])
@pytest.mark.parametrize("direction", [(0.0, 1.0), (0.0, -2.0), (1.0, 0.0), (0.6, 0.8)])
def test_grating_is_a_step_up_and_a_step_down_in_each_period_along_its_direction(direction, edge):
    period, duty = 3.0, 0.4
    grating = EtchedGlassGrating(1.3, 1.46, 1.40, direction, 0.4, 0.13, edge, period=period, duty=duty)
    unit = torch.tensor(direction, dtype=torch.float64) / math.hypot(*direction)
    y, x = (GRID.coordinates(axis, dtype=torch.float64) for axis in (1, 2))
    y, x = torch.meshgrid(y, x, indexing="ij")
    u = torch.remainder(unit[0] * y + unit[1] * x - 0.4, period)
    opd = grating.delta(GRID).sum(0) * GRID.spacing[0]
    # a voxel's diagonal or six edge widths from any wall, where tanh is within 1e-5 of its end
    inside = (u > 0.3) & (u < duty * period - 0.3)
    outside = (u > duty * period + 0.3) & (u < period - 0.3)
    low = 0.06 * (GRID.extent[0] / 2 + 0.13 - 0.65)
    assert min(int(inside.sum()), int(outside.sum())) > 500
    assert opd[outside] == pytest.approx(np.full(int(outside.sum()), low), rel=3e-5)
    assert opd[inside] == pytest.approx(np.full(int(inside.sum()), low + grating.opd_step), rel=3e-5)
    # a period further along the direction it is the same, half a period further it isn't; off the walls by a little
    y, x = y + 0.013, x + 0.017
    for share, same in ((1.0, True), (0.5, False)):
        away = grating.surface_height(y + share * period * unit[0], x + share * period * unit[1])
        assert torch.allclose(away, grating.surface_height(y, x), rtol=0, atol=1e-9) == same


def test_grating_s_first_ridge_is_the_step():
    step, grating = (
        EtchedGlassStep(0.6, 1.5, 1.4, offset=0.05),
        EtchedGlassGrating(0.6, 1.5, 1.4, offset=0.05, period=9),
    )
    near = Grid((4, 3, 20), (0.5, 0.2, 0.2))  # within half a ridge of the wall
    assert torch.equal(step.delta(near), grating.delta(near))
    assert step.opd_step == grating.opd_step


def test_layer_has_its_indices():
    layer = LayeredMedium(0.1, 1.4, bottom=-2.0, thickness=4.0, edge=0.2)
    z = torch.tensor([-20.0, -2.0, 0.0, 2.0, 20.0], dtype=torch.float64)
    assert layer.profile(z) == pytest.approx([0, 0.05, 0.1, 0.05, 0], abs=1e-8)
    face = LayeredMedium(0.1, 1.4)
    assert face.profile(z) == pytest.approx([0, 0.1 * (1 + math.tanh(-2)) / 2, 0.05, 0.0982, 0.1], abs=1e-4)


def integrate(gradient, index, background, position, momentum, start, end):
    """The ray equations with W, as an initial-value problem solved by DOP853 to 1e-12."""
    pz0 = math.sqrt(background**2 - momentum @ momentum)

    def rates(z, state):
        x, p = state[:2], state[2:4]
        n = index(z, x)
        pz = math.sqrt(n**2 - p @ p)
        bending, q = n**2 - background**2, pz - pz0
        opd = (bending + (p - momentum) @ (p - momentum) + q**2) / (2 * pz)
        return [*(p / pz), *(n * gradient(z, x) / pz), opd]

    state = [*position, *momentum, 0.0]
    answer = solve_ivp(rates, (start, end), state, "DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    return answer[:2], answer[2:4], answer[4]


RAYS = torch.tensor(
    [[[1.5, -0.7], [0.0, 0.0]], [[0.5, -0.3], [0.2, -0.3]], [[-3.0, 2.0], [-0.5, 0.1]]], dtype=torch.float64
)


def test_graded_index_rod_s_rays_solve_the_ray_equations():
    rod, start, end = GradedIndexRod(0.04, 1.6, (0.5, -0.3)), -10.0, 35.0
    axis = np.array(rod.axis)

    def index(_, x):
        return 1.6 * math.sqrt(1 - 0.04**2 * ((x - axis) @ (x - axis)))

    def gradient(z, x):
        return -((1.6 * 0.04) ** 2) * (x - axis) / index(z, x)

    exact = rod.rays(RAYS[:, 0], RAYS[:, 1], start, end)
    for i, (position, momentum) in enumerate(RAYS.numpy()):
        x, p, opd = integrate(gradient, index, 1.6, position, momentum, start, end)
        assert exact.position[i] == pytest.approx(x, abs=1e-9)
        assert exact.momentum[i] == pytest.approx(p, abs=1e-10)
        assert float(exact.opd[i]) == pytest.approx(opd, abs=1e-9)


def test_graded_index_rod_s_opd_is_the_phase_over_the_plane_wave_s():
    # W = ∫(p·dx + p_z dz) − [p0·(x − x0) + p_z0·(z − z0)], by quadrature along the closed-form ray.
    rod, length = GradedIndexRod(0.04, 1.6), 20.0
    x0, p0 = RAYS[2]
    pz0 = math.sqrt(1.6**2 - float(p0 @ p0))
    pz = math.sqrt(1.6**2 * (1 - 0.04**2 * float(x0 @ x0)) - float(p0 @ p0))

    def rate(z):
        p = rod.rays(x0, p0, 0.0, z).momentum
        return float(p @ p) / pz + pz

    exact = rod.rays(x0, p0, 0.0, length)
    plane_wave = float(p0 @ (exact.position - x0)) + pz0 * length
    assert float(exact.opd) == pytest.approx(quad(rate, 0, length, epsabs=1e-12)[0] - plane_wave, abs=1e-10)


def test_graded_index_rod_images_its_face_after_a_period():
    rod = GradedIndexRod(0.04, 1.6)
    x0 = torch.tensor([1.0, -2.0], dtype=torch.float64)
    pz = 1.6 * math.sqrt(1 - 0.04**2 * 5)
    after = rod.rays(x0, torch.zeros(2, dtype=torch.float64), 0.0, 2 * math.pi * pz / (1.6 * 0.04))
    assert after.position == pytest.approx(x0.numpy(), abs=1e-12)
    assert after.momentum == pytest.approx([0, 0], abs=1e-13)


def test_layered_medium_s_rays_solve_the_ray_equations():
    layer, start, end = LayeredMedium(-0.15, 1.5, -2.0, 3.0, 0.7), -9.0, 8.0

    def index(z, _):
        return 1.5 - 0.075 * (math.tanh((z + 2) / 0.7) - math.tanh((z - 1) / 0.7))

    exact = layer.rays(RAYS[:, 0], RAYS[:, 1], start, end)
    for i, (position, momentum) in enumerate(RAYS.numpy()):
        x, p, opd = integrate(lambda z, x: np.zeros(2), index, 1.5, position, momentum, start, end)
        assert exact.position[i] == pytest.approx(x, abs=1e-9)
        assert exact.momentum[i] == pytest.approx(p, abs=1e-12)
        assert float(exact.opd[i]) == pytest.approx(opd, abs=1e-9)


def test_layered_medium_obeys_snell_s_law():
    # Far from a face n·sinθ is unchanged: the slope beyond it is that of Snell's angle.
    layer = LayeredMedium(0.2, 1.33, edge=0.3)
    momentum = torch.tensor([1.33 * math.sin(0.6), 0.0], dtype=torch.float64)
    x = [float(layer.rays(torch.zeros(2), momentum, -8.0, z).position[0]) for z in (10.0, 11.0)]
    angle = math.asin(math.sin(0.6) * 1.33 / 1.53)
    assert x[1] - x[0] == pytest.approx(math.tan(angle), rel=1e-10)


@pytest.mark.parametrize("limits", [(-math.inf, math.inf), (-1.5, 2.0)])
def test_gaussian_ball_s_opd_is_the_integral_along_the_ray(limits):
    ball, plane = GaussianBall(1.2, 0.03, 1.36, (0.4, 0.8, -0.6)), -0.7
    opd = ball.straight_opd(RAYS[:, 0], RAYS[:, 1], plane, *limits)
    for ray, found in zip(RAYS.numpy(), opd, strict=True):
        slope = ray[1] / math.sqrt(1.36**2 - ray[1] @ ray[1])

        def delta(z, position=ray[0], slope=slope):
            place = np.array([z, *(position + slope * (z - plane))]) - np.array(ball.centre)
            return 0.03 * math.exp(-place @ place / (2 * 1.2**2)) * math.sqrt(1 + slope @ slope)

        low, high = np.clip(limits, -15, 15)
        assert float(found) == pytest.approx(quad(delta, low, high, epsabs=1e-13, limit=200)[0], abs=1e-11)


BODY = Organelle(Ellipsoid((0.5, 0.5, 0.5), (0.0, 0.0, 0.0)), 0.03)


@pytest.mark.parametrize(
    ("make", "law"),
    [
        (lambda: Bead(-1.0, 0.03, 1.56), "radius -1.0 µm must be above 0"),
        (lambda: Bead(1.0, -0.5, 1.33), r"index 1.33 \+ \(-0.5\) of the bead must be at least 1"),
        (lambda: Bead(1.0, 0.03, 0.5), "index 0.5 of the background must be at least 1"),
        (lambda: Bead(1.0, 0.03, 1.5, (0.0, math.nan, 0.0)), "centre .* must be finite numbers"),
        (lambda: Bead(1.0, 0.03, 1.5, subpixels=0), "subpixels 0 must be a whole number of at least 1"),
        (lambda: Ellipsoid((1.0, 0.0, 1.0)), "semi-axis along y 0.0 µm must be above 0"),
        (lambda: Ellipsoid((1.0, math.inf, 1.0)), "semi_axes .* must be finite numbers"),
        (lambda: LayeredMedium(0.1, 1.4, edge=0.0), "edge 0.0 µm must be above 0"),
        (lambda: LayeredMedium(0.1, 1.4, thickness=-1.0), "thickness -1.0 µm must be above 0"),
        (lambda: LayeredMedium(-0.5, 1.4), "of the layer must be at least 1"),
        (lambda: GradedIndexRod(0.0, 1.6), "alpha 0.0 1/µm must be above 0"),
        (lambda: GradedIndexRod(0.2, 1.6).delta(GRID), "beyond 3.903 µm"),
        (lambda: GaussianBall(0.0, 0.03, 1.4), "sigma 0.0 µm must be above 0"),
        (lambda: EtchedGlassStep(1.0, 0.9, 1.4), "index 0.9 of the glass"),
        (lambda: EtchedGlassStep(1.0, 1.5, 1.4, (0.0, 0.0)), "length of the direction 0.0"),
        (lambda: EtchedGlassStep(1.0, 1.5, 1.4, edge=-0.1), "edge -0.1 µm must be above 0"),
        (lambda: EtchedGlassGrating(1.0, 1.5, 1.4, period=0.0), "period 0.0 µm must be above 0"),
        (lambda: EtchedGlassGrating(1.0, 1.5, 1.4, period=2.0, duty=1.0), "duty 1.0 must lie between 0 and 1"),
        (lambda: EtchedGlassGrating(1.0, 0.9, 1.4, period=2.0), "index 0.9 of the glass"),
        (lambda: EtchedGlassStep(math.inf, 1.5, 1.4), "height inf µm must be finite"),
        (lambda: CellPhantom(nucleus=None), "2 nucleoli lie in a nucleus, but the nucleus is None"),
        (lambda: CellPhantom(lipid=BODY), "lipid and nucleus overlap"),
        (lambda: CellPhantom(lipid=Organelle(Ellipsoid((2.7, 0.5, 0.5)), 0.05)), "lipid at .* sticks out"),
        (lambda: CellPhantom(cytoplasm=Organelle(Ellipsoid((3.0, 4.0, 5.0)), -0.4)), "of the cytoplasm"),
        (
            lambda: LayeredMedium(-0.2, 1.4).rays(RAYS[:, 0], RAYS[:, 0], 0.0, 1.0),
            "must be below the index 1.2",
        ),
        (
            lambda: GradedIndexRod(0.1, 1.4).rays(RAYS[:, 0], RAYS[:, 0], 0.0, 1.0),
            "must be below the index 1.4",
        ),
        (
            lambda: GaussianBall(1.0, 0.03, 1.4).straight_opd(RAYS[:, 0], RAYS[:, 0]),
            "must be below the index 1.4",
        ),
    ],
)
def test_bad_values_are_refused(make, law):
    with pytest.raises(ValueError, match=law):
        make()
