"""Where the light's energy goes: what rays and the split step conserve, and what absorption and the optics take.

That the flux of rays through a plane in a ball is the incoming one is in test_landing, that of strong balls through
thin slabs in test_wave, and absorption of axial light in test_laws.
"""

import cmath
import math
from itertools import pairwise

import pytest
import torch
from through import deviation, propagate, ray_field

from data_synthetic import GaussianBall
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Prism, Volume, image
from torchdic.plane_waves import axial_difference, axial_momentum
from torchdic.rays import landing
from torchdic.rays.trace import launch

N0 = 1.36
WAVELENGTH = 0.546
K0 = 2 * math.pi / WAVELENGTH
DIRECTIONS = torch.tensor([[0.0, 0.0], [0.35, -0.45], [-0.6, 0.2]], dtype=torch.float64)


def flux(spectrum, volume):
    """Σ p_z |S|² over that of the incoming wave, per source."""
    _, pz = axial_difference(volume.grid, WAVELENGTH, volume.background, DIRECTIONS)
    return (pz * spectrum.abs().square()).sum((1, 2)) / axial_momentum(volume.background, DIRECTIONS)


@pytest.mark.parametrize(("order", "bound"), [(2, 1e-5), (1, 3e-4)])
def test_split_step_conserves_energy_better_with_thinner_slabs(order, bound):
    """The ball of exact_ball_dic.npz, slabs of 1 µm and thinner: half the slab, half of what is lost or gained.

    First order for both forms: what the 4-FFT one leaves out is of second order in φ, and their number grows as 1/φ.
    """
    excess = []
    for slices in (18, 36, 72):
        grid = Grid((slices, 60, 64), (18 / slices, 0.3, 0.3))
        volume = Volume(grid, GaussianBall(2.0, 0.03, N0).delta(grid, torch.float64), N0)
        spectrum = propagate(volume, WAVELENGTH, DIRECTIONS, 9.0, Fidelity("wave", order=order))
        excess.append(flux(spectrum, volume) - 1)
        # what is scattered, and so might have been lost, is some 8 % and more
        assert float(spectrum[:, 0, 0].abs().square().max()) < 0.92
    assert float(excess[0].abs().max()) < bound
    for coarse, fine in pairwise(excess):
        torch.testing.assert_close(coarse / fine, torch.full_like(fine, 2.0), rtol=0.1, atol=0)


def test_rays_carry_their_energy_to_second_order_in_the_mesh():
    """|U|²·p_z/p_z0 at a pixel, p_z that of the ray through it: a third of the mesh, a ninth of the error."""

    def intensity(refinement):
        n = 19 * refinement
        grid = Grid((24, n, n), (0.5, 11.4 / n, 11.4 / n))
        volume = Volume(grid, GaussianBall(1.2, 0.04, N0, (0.1, -0.2, 0.15)).delta(grid), N0)
        fidelity = Fidelity("rays", interpolation="cubic")
        field = ray_field(volume, WAVELENGTH, DIRECTIONS[1:2], 3.0, fidelity)[0].abs().square()
        return field[refinement // 2 :: refinement, refinement // 2 :: refinement]

    exact = intensity(9)
    assert float((exact - 1).abs().max()) > 0.2
    coarse, fine = (float((intensity(r) - exact).square().mean().sqrt()) for r in (1, 3))
    assert math.log(coarse / fine, 3) == pytest.approx(2, abs=0.35)


def leaving(n, contrast, extent, absorber=None):
    """A ball 8.4 µm across on n × n voxels, and rays' field on its last face for all DIRECTIONS."""
    grid = Grid((28, n, n), (extent / 28, 8.4 / n, 8.4 / n))
    centre = (1.5 - extent / 2, 0.1, -0.2)
    absorption = None if absorber is None else GaussianBall(0.8, absorber, N0, centre).delta(grid)
    return Volume(grid, GaussianBall(0.7, contrast, N0, centre).delta(grid), N0, absorption)


@pytest.mark.slow
@pytest.mark.parametrize("absorber", [None, 0.02])
def test_flux_through_the_last_face_is_the_incoming_one_but_for_what_is_absorbed(absorber):
    """Σ|U|²p_z over the pixels is Σ p_z0·exp(−2k0∫κ ds) over the rays, to second order in the mesh at least.

    The order is fitted over three meshes; pixel by pixel it is 2 (above), and in the sum errors cancel. p_z is that of
    the local wave, by its phase: p = p0 + ∇ arg U/k0.
    """
    meshes, errors = (24, 36, 54), []
    for n in meshes:
        volume = leaving(n, 0.04, 4.0, absorber)
        face, fidelity = volume.grid.extent[0] / 2, Fidelity("rays", interpolation="cubic")
        # no phase wraps from pixel to pixel
        field = ray_field(volume, 1.0, DIRECTIONS, face, fidelity)
        steps = [(field.roll(-1, axis) * field.roll(1, axis).conj()).angle() for axis in (1, 2)]
        p = DIRECTIONS[:, None, None] + torch.stack(steps, -1) / (2 * 2 * math.pi * volume.grid.spacing[1])
        out = (field.abs().square() * axial_momentum(volume.background, p)).mean((1, 2))
        start = launch(volume.grid, DIRECTIONS, volume.background, face)
        absorbed = deviation(volume, start, fidelity).absorbed
        share = 1.0 if absorbed is None else torch.exp(-4 * math.pi * absorbed).mean((1, 2))
        errors.append((out / axial_momentum(volume.background, DIRECTIONS) - share).abs())
        # what moves is much more than the error
        assert float((field.abs().square().amax((1, 2))).min()) > 1.1 or absorber
    assert float(errors[-1].max()) < 2e-4
    x = torch.tensor(meshes, dtype=torch.float64).log()
    slope = ((x - x.mean())[:, None] * torch.stack(errors).log()).sum(0) / (x - x.mean()).square().sum()
    assert float(slope.max()) < -1.8


def test_flux_through_a_face_behind_a_focus_is_the_incoming_one(monkeypatch):
    """Σ A²p_z over the pixels' branches, without interference, in a plane that caustics cross.

    A caustic is as bright as 1/√distance: its sum over pixels of width h errs by h^½ at most.
    """
    # A² instead of A·exp(ikW), and p_z/p_z0 divided out: 1/|det| is A²p_z/p_z0. On the face nothing is extended.
    monkeypatch.setattr(torch, "polar", lambda amplitude, phase: torch.complex(amplitude.square(), 0 * phase))
    monkeypatch.setattr(landing, "axial_momentum", lambda n0, p: torch.ones_like(p[..., 0]))
    momentum = torch.tensor([[0.0, 0.0], [0.12, -0.16]], dtype=torch.float64)
    for n in (30, 60, 90):
        volume = leaving(n, 0.11, 7.0)
        field = ray_field(volume, 1.0, momentum, volume.grid.extent[0] / 2, Fidelity("rays"))
        assert float(field.real.amax()) > 5
        assert float((field.real.mean((1, 2)) - 1).abs().max()) < 0.03 * math.sqrt(30 / n)


@pytest.mark.parametrize("delta", [0.0, 0.05])
@pytest.mark.parametrize("kappa", [0.0, 0.02])
def test_slab_absorbs_along_the_oblique_path_that_light_takes_in_it(propagation, delta, kappa):
    """|U|² = exp(−2∫κ k0 ds), ds = dz·n/p_z, longer by 1/cosθ in the slab's own index; steeper light is darker.

    The wave equation has Im √((n + iκ)² − |p0|²) there: n·κ/p_z to first order in κ, and its excess of order κ³.
    """
    grid = Grid((6, 8, 9), (0.3, 0.2, 0.2))
    absorption = torch.full(grid.shape, kappa, dtype=torch.float64)
    volume = Volume(grid, torch.full(grid.shape, delta, dtype=torch.float64), N0, absorption)
    for order in (1, 2):
        spectrum = propagate(volume, WAVELENGTH, DIRECTIONS, 0.0, Fidelity(propagation, order=order))
        found = spectrum[:, 0, 0].abs().square()
        n, thickness = N0 + delta, 1.8
        p2 = DIRECTIONS.square().sum(1).tolist()
        pz = [math.sqrt(n**2 - p) for p in p2]
        path = torch.tensor([math.exp(-2 * K0 * kappa * thickness * n / z) for z in pz], dtype=torch.float64)
        exact = path
        if propagation == "wave":
            waves = [cmath.sqrt(complex(n, kappa) ** 2 - p).imag for p in p2]
            exact = torch.tensor([math.exp(-2 * K0 * thickness * w) for w in waves], dtype=torch.float64)
        torch.testing.assert_close(found, exact, rtol=1e-12, atol=0)
        # k0·T·κ³/n² of the wave, at most
        torch.testing.assert_close(found, path, rtol=2 * K0 * thickness * kappa**3 + 1e-12, atol=0)
        if kappa:
            assert bool((found[1:] < 0.99 * found[0]).all())


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_weak_absorber_of_any_shape_takes_its_cross_section(propagation, interpolation):
    """To first order in κ the flux lost is 2k0·n0·∫κ dV/(p_z0·area), whatever the shape: the optical theorem."""
    grid = Grid((20, 48, 44), (0.35, 0.25, 0.25))
    balls = GaussianBall(0.7, 1e-5, N0, (0.3, -0.8, 0.5)), GaussianBall(0.5, 2e-5, N0, (-0.6, 0.9, -0.4))
    kappa = sum(ball.delta(grid, torch.float64) for ball in balls)
    volume = Volume(grid, torch.zeros_like(kappa), N0, kappa)
    lost = 1 - flux(
        propagate(volume, WAVELENGTH, DIRECTIONS, 0.0, Fidelity(propagation, interpolation=interpolation)), volume
    )
    mean = float(kappa.sum(0).mean()) * grid.spacing[0]
    expected = 2 * K0 * N0 * mean / axial_momentum(volume.background, DIRECTIONS)
    # the second order in κ is k0·∫κ ds, 4e-4
    torch.testing.assert_close(lost, expected, rtol=1e-3, atol=0)


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
def test_prisms_two_outputs_share_all_light_in_any_focus(smooth_field, propagation):
    """Without a pupil, bias b and bias b + π add up to the bright field, and no focus plane gains or loses light."""
    grid = Grid((4, 15, 18), (0.4, 0.2, 0.21))
    volume = Volume(grid, smooth_field(grid, 0.02), N0)
    prisms = [None, Prism((0.1, -0.25), 0.8), Prism((0.1, -0.25), 0.8 + math.pi)]
    images = image(
        volume,
        Microscope(WAVELENGTH, None, Condenser(0.5)),
        Acquisition(prisms, [-3.0, 0.0, 1.7]),
        Fidelity(propagation, sources=6),
    )
    total = images.mean((-1, -2))
    torch.testing.assert_close(total[1] + total[2], total[0], rtol=1e-12, atol=0)
    torch.testing.assert_close(total, total[:, :1].expand_as(total), rtol=1e-12, atol=0)
    assert float((images[:, 0] - images[:, 2]).abs().max()) > 0.01
