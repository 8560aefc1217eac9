"""Rays become a field: each pixel once, energy conserved, branches summed where the mesh of rays folds."""

import math

import pytest
import torch
from through import deviation, ray_field

from data_synthetic import GaussianBall
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, launch
from torchdic.rays.landing import extend, tube_area
from torchdic.rays.mesh import SURROUND, Mesh, crossed_caustics
from torchdic.rays.trace import Deviation

N0 = 1.36
WAVELENGTH = 0.546
GRID = Grid((1, 13, 18), (1.0, 0.2, 0.25))


def coverage(grid, displacement):
    """How many triangles cover each pixel, (source, y, x), and with what sum of orientations."""
    mesh = Mesh(grid, displacement)
    pairs = mesh.covered(displacement)
    source, triangle, pixel = pairs.source, pairs.triangle, pairs.pixel
    edges = mesh.edges(displacement)[source, triangle]
    sign = torch.sign(edges[:, 0, 1] * edges[:, 1, 0] - edges[:, 0, 0] * edges[:, 1, 1])
    shape = (len(displacement), *grid.shape[1:])
    flat = (source * shape[1] + pixel[:, 0]) * shape[2] + pixel[:, 1]
    count, oriented = (torch.zeros(math.prod(shape), dtype=torch.float64) for _ in range(2))
    count.index_add_(0, flat, torch.ones(len(flat), dtype=torch.float64))
    oriented.index_add_(0, flat, sign.double())
    return count.reshape(shape), oriented.reshape(shape)


def rays_at_home(grid, dtype=torch.float64):
    ny, nx = grid.shape[1] + 2 * SURROUND, grid.shape[2] + 2 * SURROUND
    y, x = (
        ((torch.arange(n, dtype=torch.float64) - (n - 1) / 2) * d).to(dtype)
        for n, d in ((ny, grid.spacing[1]), (nx, grid.spacing[2]))
    )
    return torch.meshgrid(y, x, indexing="ij")


def displaced(grid, function, dtype=torch.float64):
    y, x = rays_at_home(grid, dtype)
    return torch.stack(torch.broadcast_tensors(*function(y, x)), -1)[None].to(dtype)


DISPLACEMENTS = {
    "none": lambda y, x: (0 * y, 0 * x),
    "whole-pixels": lambda y, x: (0 * y + 0.4, 0 * x - 0.75),
    "half-pixels": lambda y, x: (0 * y + 0.1, 0 * x - 0.125),
    "beyond-the-margin": lambda y, x: (0 * y - 1.3, 0 * x + 2.21),
    "stretched-onto-ties": lambda y, x: (y, x),
    "sheared-along-the-diagonals": lambda y, x: (0.8 * x, 0 * x),
    "swirl": lambda y, x: (0.5 * x * torch.exp(-(x**2) - y**2), -0.5 * y * torch.exp(-(x**2) - y**2)),
    "wave": lambda y, x: (0.15 * torch.sin(4 * y + x), 0.17 * torch.cos(3 * x - 2 * y)),
    "random": lambda y, x: (0.09 * (torch.rand_like(y) - 0.5), 0.11 * (torch.rand_like(x) - 0.5)),
}


@pytest.mark.parametrize("function", DISPLACEMENTS.values(), ids=DISPLACEMENTS.keys())
def test_unfolded_mesh_covers_each_pixel_exactly_once(function, dtype):
    count, oriented = coverage(GRID, displaced(GRID, function, dtype))
    assert torch.equal(count, torch.ones_like(count))
    assert torch.equal(oriented, torch.ones_like(oriented))


@pytest.mark.parametrize("size", [1e-7, 1e-4, 1e-2])
def test_rays_almost_on_their_pixels_cover_each_once(dtype, size):
    """Rounding must not open gaps between triangles that meet almost at a pixel."""
    grid = Grid((1, 64, 64), (1.0, 0.15, 0.15))
    count, _ = coverage(
        grid, displaced(grid, lambda y, x: (size * torch.randn_like(y), size * torch.randn_like(x)), dtype)
    )
    assert torch.equal(count, torch.ones_like(count))


def test_fold_covers_with_three_branches_of_alternating_orientation():
    """A strong cylindrical lens: between the caustics each pixel has 3 rays, one of them turned over; outside, one."""
    grid = Grid((1, 6, 80), (1.0, 0.25, 0.05))
    lens = displaced(grid, lambda y, x: (0 * y + 0.03, -2.5 * x * torch.exp(-(x**2) / 0.5)))
    count, oriented = coverage(grid, lens)
    assert torch.equal(oriented, torch.ones_like(oriented))
    assert sorted(set(count.flatten().tolist())) == [1, 3]
    # caustics where d/dx0 [x0 − 2.5 x0 exp(−2 x0²)] = 0, found on a fine line
    x0 = torch.linspace(-2, 2, 400_001, dtype=torch.float64)
    landing = x0 - 2.5 * x0 * torch.exp(-2 * x0**2)
    caustic = float(landing[(x0 < 0) & (x0 > -1)].max())
    x = grid.coordinates(2, dtype=torch.float64)
    clear = (x.abs() - caustic).abs() > 0.05
    expected = torch.where(x.abs() < caustic, 3.0, 1.0).double()
    assert torch.equal(count[0, 2][clear], expected[clear])


def test_edge_on_triangles_and_collapsed_meshes_stay_finite():
    for function in (lambda y, x: (-y, -x), lambda y, x: (0 * y, -x), lambda y, x: (-2 * y, -2 * x)):
        count, oriented = coverage(GRID, displaced(GRID, function))
        assert bool(count.isfinite().all())
        assert bool(oriented.isfinite().all())


def test_tube_area_is_the_determinant_of_the_landing_map():
    grid = Grid((1, 5, 6), (1.0, 0.2, 0.25))
    matrix = torch.tensor([[0.2, -0.3], [0.4, -0.1]], dtype=torch.float64)

    def linear(y, x):
        return matrix[0, 0] * y + matrix[0, 1] * x, matrix[1, 0] * y + matrix[1, 1] * x

    expected = torch.linalg.det(torch.eye(2, dtype=torch.float64) + matrix)
    area = tube_area(displaced(grid, linear), grid)
    torch.testing.assert_close(area, expected.expand_as(area))


@pytest.mark.parametrize(
    ("leaving", "landed", "caustics"),
    [
        ((1, 1), (1, 1), 0),  # never folded
        ((-1, 1), (-1, 1), 0),  # folded before
        ((-1, 1), (1, 1), 1),
        ((1, 1), (-1, 1), 1),
        ((1, 1), (-1, -1), 2),  # a point focus: both at once
        ((1, 1), (-1, -2), 2),  # an astigmatic one: one after the other
        ((-1, -2), (3, 1), 2),
        ((1, 1), (-1e-9, 1), 1),
        ((1, 1), (3, 0.5), 0),  # magnified only
    ],
)
def test_caustics_on_a_straight_way_are_where_a_tubes_area_vanishes(leaving, landed, caustics):
    """For triangles whose two edges are scaled by these factors."""

    def edges(scale):
        y, x = scale
        return torch.tensor([[[[0.0, 1.0 * x], [1.0 * y, 0.0]]]], dtype=torch.float64)

    assert float(crossed_caustics(edges(leaving), edges(landed))) == caustics
    assert float(crossed_caustics(edges(landed), edges(leaving))) == caustics


def test_extension_there_and_back_is_nothing():
    p0 = torch.tensor([0.3, -0.2], dtype=torch.float64)
    n0 = torch.tensor(N0, dtype=torch.float64)
    rays = Deviation(torch.randn(9, 2).double(), 0.1 * torch.randn(9, 2).double(), torch.randn(9).double(), None)
    back = extend(extend(rays, p0, n0, 3.7), p0, n0, -3.7)
    for name in ("position", "momentum", "opd"):
        torch.testing.assert_close(getattr(back, name), getattr(rays, name), rtol=0, atol=1e-14)


def test_extension_is_a_straight_ray_in_the_medium():
    """x = x_e + (p/p_z)·d and W = W_e + d·(n0²/p_z − p0·p/p_z − p_z0), the path less the plane wave's phase."""
    p0 = torch.tensor([0.3, -0.2], dtype=torch.float64)
    n0 = torch.tensor(N0, dtype=torch.float64)
    dp = 0.2 * torch.randn(9, 2, dtype=torch.float64)
    rays = Deviation(torch.zeros(9, 2, dtype=torch.float64), dp, torch.zeros(9, dtype=torch.float64), None)
    found = extend(rays, p0, n0, 2.0)
    p = p0 + dp
    pz, pz0 = (N0**2 - p.square().sum(-1)).sqrt(), math.sqrt(N0**2 - 0.13)
    torch.testing.assert_close(found.position, 2 * (p / pz[:, None] - p0 / pz0), rtol=0, atol=1e-14)
    torch.testing.assert_close(found.opd, 2 * (N0**2 / pz - (p0 * p).sum(-1) / pz - pz0), rtol=0, atol=1e-14)


def ball(grid, contrast=0.03, sigma=1.0, centre=(0.3, -0.2, 0.25)):
    return Volume(grid, GaussianBall(sigma, contrast, N0, centre).delta(grid), N0)


@pytest.mark.parametrize("plane", [*(pytest.param(z, marks=pytest.mark.slow) for z in (-1.0, 0.3)), 2.0])
def test_energy_flows_through_the_plane_undiminished(plane):
    """∫ p_z |U|² over the plane is that of the plane wave, to second order of the mesh: a quarter at half the voxel."""
    excess = []
    for n in (32, 64):
        grid = Grid((24, n, n), (0.4, 12.8 / n, 12.8 / n))
        volume = ball(grid, contrast=0.05)
        momentum = torch.tensor([[0.2, -0.3]], dtype=torch.float64)
        fidelity = Fidelity("rays", interpolation="cubic")
        field = ray_field(volume, WAVELENGTH, momentum, plane, fidelity)
        # p_z of the local wave: its envelope's phase gradient is k0·δp, here by the spectrum
        spectrum = torch.fft.fft2(field, norm="forward")
        waves = momentum[0, :, None, None] + WAVELENGTH * grid.frequencies(dtype=torch.float64)
        pz = (N0**2 - waves.square().sum(0)).clamp_min(0).sqrt()
        flux = float((spectrum[0].abs().square() * pz).sum()) / math.sqrt(N0**2 - 0.13)
        excess.append(abs(flux - 1))
    assert excess[1] < 2e-4
    assert excess[1] < 0.4 * excess[0] or excess[0] < 1e-4


def test_amplitude_is_what_conserves_it():
    grid = Grid((24, 48, 48), (0.4, 0.25, 0.25))
    volume = ball(grid, contrast=0.05)
    momentum = torch.zeros(1, 2, dtype=torch.float64)
    with_, without = (
        ray_field(volume, WAVELENGTH, momentum, 3.0, Fidelity("rays", amplitude=a))[0].abs() for a in (True, False)
    )
    torch.testing.assert_close(without, torch.ones_like(without))
    # a converging lens brightens what is behind its centre
    assert float(with_[23:25, 24:26].min()) > 1.1
    assert float(with_.min()) < 0.99


@pytest.mark.parametrize("plane", [-1.0, *(pytest.param(z, marks=pytest.mark.slow) for z in (0.3, 1.5))])
def test_reference_plane_does_not_show_for_a_smooth_ball(plane):
    """Where the field is formed is a matter of computation: within 1 % of the contrast at planes inside the ball."""
    grid = Grid((28, 48, 48), (0.45, 0.3, 0.3))
    microscope = Microscope(WAVELENGTH, Objective(0.6), Condenser(0.25))
    acquisition = Acquisition([Prism((0.1, 0.2), 1.2)], [0.0, 2.0])
    volume = ball(grid, contrast=0.02, sigma=1.8)
    expected, found = (
        image(volume, microscope, acquisition, Fidelity("rays", sources=3, interpolation="cubic", reference_plane=z))
        for z in (0.225, plane)
    )
    contrast = float((expected - math.sin(0.6) ** 2).abs().max())
    assert float((found - expected).abs().max()) < 0.01 * contrast


def test_field_at_a_fold_is_the_sum_of_its_branches():
    """A cylinder lens focuses before the plane: there 3 rays interfere, each with its amplitude, path and caustic.

    The branches are found by bisection on a ray fan 50 times finer than the mesh; a wrong caustic phase shows.
    """
    wavelength = 0.1
    grid = Grid((40, 3, 400), (0.25, 0.3, 0.02))
    z, x = grid.coordinates(0, dtype=torch.float64), grid.coordinates(2, dtype=torch.float64)
    delta = 0.08 * torch.exp(-(z[:, None] ** 2 + x**2) / 2)[:, None, :].expand(grid.shape).contiguous()
    volume = Volume(grid, delta, N0)
    momentum, background = torch.zeros(1, 2, dtype=torch.float64), volume.background
    fidelity = Fidelity("rays", interpolation="cubic", steps=40)
    plane = 16.0
    field = ray_field(volume, wavelength, momentum, plane, fidelity)[0, 1]
    assert bool(field.isfinite().all())

    start = launch(grid, momentum, background, plane)
    fan = torch.linspace(-3.5, 3.5, 7001, dtype=torch.float64)
    position = torch.stack((torch.zeros_like(fan), fan), -1)
    exit_ = deviation(volume, type(start)(position, torch.zeros_like(position), torch.zeros_like(fan)), fidelity)
    landed = extend(exit_, momentum[0], background, plane - 5.0)
    landing = fan + landed.position[:, 1]
    step = fan[1] - fan[0]
    area = torch.gradient(landing, spacing=float(step))[0]
    # area at the exit face tells whether the caustic lies behind it: then the way on to the plane crosses it
    folded_at_exit = torch.gradient(fan + exit_.position[:, 1], spacing=float(step))[0] < 0
    assert not bool(folded_at_exit.any())

    compared = 0
    for i in range(120, 280, 7):
        target = float(x[i])
        crossing = torch.nonzero((landing[:-1] - target) * (landing[1:] - target) <= 0)[:, 0]
        if len(crossing) != 3 or float(area[crossing].abs().min()) < 0.15:
            continue
        expected = 0j
        for j in crossing.tolist():
            t = float((target - landing[j]) / (landing[j + 1] - landing[j]))
            opd, tube, p = (float(v[j] + t * (v[j + 1] - v[j])) for v in (landed.opd, area, landed.momentum[:, 1]))
            amplitude = (math.sqrt(N0**2 - p**2) / N0 * abs(tube)) ** -0.5
            # the extension to this plane runs forward in truth, where a caustic costs −π/2
            phase = 2 * math.pi / wavelength * opd - (math.pi / 2 if tube < 0 else 0)
            expected += amplitude * complex(math.cos(phase), math.sin(phase))
        assert abs(complex(field[i]) - expected) < 0.05 * max(1, abs(expected)), (i, complex(field[i]), expected)
        compared += 1
    assert compared > 3


def test_opd_between_rays_is_interpolated_in_third_order():
    """Σ w_i [W_i + ½ δp_i·(X − x_i)]: half the mesh, an eighth of the error. A slide W + δp·(X − x) has a quarter."""
    momentum = torch.tensor([[0.0, 0.3]], dtype=torch.float64)

    def opd(refinement):
        n = 33 * refinement
        grid = Grid((24, 2, n), (0.4, 0.3, 12.8 / n))
        z, x = grid.coordinates(0, dtype=torch.float64), grid.coordinates(2, dtype=torch.float64)
        delta = 0.04 * torch.exp(-(z[:, None] ** 2 + x**2) / 2)[:, None, :].expand(grid.shape).contiguous()
        fidelity = Fidelity("rays", interpolation="cubic", amplitude=False)
        # so long a wavelength that no phase wraps
        field = ray_field(Volume(grid, delta, N0), 10.0, momentum, 4.0, fidelity)
        return field[0, 0, refinement // 2 :: refinement].angle() / (2 * math.pi) * 10.0

    exact = opd(27)
    coarse, fine = (float((opd(r) - exact).square().mean().sqrt()) for r in (3, 9))
    assert math.log(coarse / fine, 3) == pytest.approx(3, abs=0.5)


# --- polarisation carried by the field -------------------------------------------------------------------------------


def test_field_carries_the_turn_of_its_rays(smooth_field):
    """Each branch is (cos τ, sin τ) times the envelope; without folds the envelope is what is left of both."""
    grid = Grid((6, 20, 22), (0.6, 0.22, 0.2))
    volume = Volume(grid, smooth_field(grid, 0.04), N0, 0.01 * smooth_field(grid, seed=1).abs())
    momentum = torch.tensor([[0.3, -0.2], [-0.5, 0.4]], dtype=torch.float64)
    fidelity = Fidelity("rays")
    plain = ray_field(volume, WAVELENGTH, momentum, 0.3, fidelity)
    turned = ray_field(volume, WAVELENGTH, momentum, 0.3, fidelity, polarised=True)
    assert turned.shape == (2, 2, 20, 22)
    assert float(turned[:, 1].abs().max()) > 1e-3
    found = (turned[:, 1] / turned[:, 0]).real.atan()
    torch.testing.assert_close(turned[:, 0], plain * found.cos(), rtol=0, atol=1e-12)
    torch.testing.assert_close(turned[:, 1], plain * found.sin(), rtol=0, atol=1e-12)
    # τ at the pixel is that of the ray through it, which the mesh interpolates in second order
    leaving = deviation(volume, launch(grid, momentum, volume.background, 0.3), fidelity, turn=True)
    nearest = float((found - leaving.turn).abs().mean())
    assert nearest < 0.2 * float(leaving.turn.abs().mean())


def test_turn_is_kept_by_the_extension():
    p0, n0 = torch.tensor([0.3, -0.2], dtype=torch.float64), torch.tensor(N0, dtype=torch.float64)
    dp, turn = 0.1 * torch.randn(9, 2, dtype=torch.float64), torch.rand(9, dtype=torch.float64)
    rays = Deviation(torch.zeros_like(dp), dp, torch.zeros_like(turn), None, turn)
    assert torch.equal(extend(rays, p0, n0, -2.0).turn, turn)


def test_gradient_of_a_turned_field_is_the_central_difference(smooth_field):
    grid = Grid((3, 8, 9), (0.6, 0.22, 0.2))
    momentum = torch.tensor([[0.31, -0.12], [-0.17, 0.24]], dtype=torch.float64)
    delta = smooth_field(grid, 0.04) + 0.01
    weights = torch.randn(2, 2, 8, 9, dtype=torch.complex128)

    def of(delta):
        field = ray_field(Volume(grid, delta, N0), WAVELENGTH, momentum, 0.3, Fidelity("rays"), polarised=True)
        return (weights * field).real.sum()

    value = delta.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(of(value), value)
    direction = torch.randn_like(gradient).abs() * torch.where(gradient < 0, -1.0, 1.0)
    # so small a step that hardly any ray goes from one piece of the field or the mesh to the next
    step = 1e-7
    at = [float(of(delta + t * step * direction)) for t in (-2, -1, 1, 2)]
    expected = (8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * step)
    assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-6)
