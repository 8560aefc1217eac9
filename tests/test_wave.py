"""The split step against the Helmholtz equation's own laws: first Born, energy, orders, and the meaning of a slab."""

import cmath
import math
from itertools import pairwise

import pytest
import torch

from data_synthetic import GaussianBall
from torchdic import Fidelity, Grid, Volume
from torchdic.errors import SlabWarning, UnstableError
from torchdic.memory import batches
from torchdic.plane_waves import axial_difference, to_field, to_spectrum
from torchdic.propagation import split_step as split_module
from torchdic.propagation.slab import Slab, cross_slab
from torchdic.propagation.split_step import slab_mean, split_step

N0 = 1.36
WAVELENGTH = 0.546
K0 = 2 * math.pi / WAVELENGTH


def momentum(*points, dtype=torch.float64):
    return torch.tensor(points or [[0.0, 0.0]], dtype=dtype)


def axial(p2, n=N0):
    return math.sqrt(n**2 - p2)


@pytest.mark.parametrize("source", [(0.0, 0.0), (0.2, -0.5), (0.0, 0.8)], ids=str)
@pytest.mark.parametrize(("harmonic_y", "harmonic_x"), [(0, 2), (3, -1), (-2, -3)])
@pytest.mark.parametrize("order", [1, 2])
def test_weak_grating_scatters_as_first_born(source, harmonic_y, harmonic_x, order):
    """Δn = ε·cos(2πf·x) over a thickness T: Helmholtz's first order in ε, for any angle in and out, is

    S(f) = i·k0·n0·ε/(2 p_z)·∫exp(−ik0(p_z − p_z0)z) dz over −T/2 … T/2, times exp(ik0(p_z − p_z0)T/2) at the last face.
    """
    grid = Grid((40, 20, 22), (0.05, 0.3, 0.28))
    fy, fx = harmonic_y / (20 * 0.3), harmonic_x / (22 * 0.28)
    y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    epsilon, thickness = 1e-6, 2.0
    delta = (epsilon * torch.cos(2 * math.pi * (fy * y + fx * x))).expand(grid.shape).clone()
    spectrum = split_step(Volume(grid, delta, N0), WAVELENGTH, momentum(source), Fidelity("wave", order=order))[0]
    pz0 = axial(source[0] ** 2 + source[1] ** 2)
    for sign in (1, -1):
        p2 = (source[0] + sign * WAVELENGTH * fy) ** 2 + (source[1] + sign * WAVELENGTH * fx) ** 2
        pz = axial(p2)
        a = K0 * (pz - pz0) * thickness / 2
        born = K0 * N0 * epsilon * thickness / (2 * pz) * (math.sin(a) / a if a else 1.0)
        # the array's first pixel is at y, x of its centre, where the grating's phase is not 0
        place = 2 * math.pi * (fy * float(y[0, 0]) + fx * float(x[0, 0])) * sign
        expected = 1j * born * complex(math.cos(a), math.sin(a)) * complex(math.cos(place), math.sin(place))
        found = complex(spectrum[sign * harmonic_y, sign * harmonic_x])
        # midpoint rule over 40 slabs, and the next Born order, of size k0·ε·T
        assert abs(found - expected) < 1e-3 * abs(born) + K0 * epsilon * thickness * 1e-3


RINGS = momentum(
    *((r * math.sin(a + t), r * math.cos(a + t)) for r, t in ((0.2, 0.0), (0.5, 0.1)) for a in range(4)), (0.5, 0.0)
)


def test_sources_of_a_ring_share_their_screens(smooth_field):
    """Their spectra and gradients are those of each source alone."""
    grid = Grid((3, 8, 9), (0.5, 0.22, 0.2))
    counts = split_module._screens(RINGS, torch.tensor(N0))[1]
    assert counts == [4, 5]
    assert split_module._screens(RINGS[[0, 4, 1, 5]], torch.tensor(N0))[1] is None
    factors = torch.randn(9, 8, 9, dtype=torch.complex128)
    for order in (1, 2):
        delta = (smooth_field(grid, 0.03) + 0.01).requires_grad_()
        light = WAVELENGTH, RINGS, Fidelity(order=order)
        together = split_step(Volume(grid, delta, N0), *light)
        alone = torch.cat([split_step(Volume(grid, delta, N0), WAVELENGTH, p[None], light[2]) for p in RINGS])
        torch.testing.assert_close(together, alone, rtol=1e-12, atol=1e-14)
        one, other = (torch.autograd.grad((s * factors).real.sum(), delta)[0] for s in (together, alone))
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-12 * float(other.abs().max()))


# a screen for each source, for all or for some; together and one by one; without absorption and with
VARIANTS = [(False, [1, 2], "source by source"), (True, None, "at once"), (True, [3], "source by source")]


@pytest.mark.parametrize(
    ("order", "absorbs", "screens", "in_cache"),
    [
        pytest.param(
            order,
            absorbs,
            screens,
            1 if name == "source by source" else 1 << 20,
            id=f"{order}-{absorbs}-{screens}-{name}",
            marks=() if (absorbs, screens, name) in VARIANTS else pytest.mark.slow,
        )
        for order in (1, 2)
        for absorbs in (False, True)
        for screens in (None, [3], [1, 2])
        for name in ("source by source", "at once")
    ],
)
def test_derivative_of_a_slab_is_the_central_difference(monkeypatch, order, absorbs, screens, in_cache):
    """In each of its variables, whatever the parts in which sources are taken."""
    monkeypatch.setattr(batches, "IN_CACHE", in_cache)
    B = torch.rand(4, 3, dtype=torch.complex128 if absorbs else torch.float64)
    pz0 = 1 + torch.rand(len(screens or [1] * 3), 1, 1, dtype=torch.float64)
    variables = [B, pz0, *(torch.randn(3, 4, 3, dtype=torch.complex128) for _ in range(3))]
    for variable in variables:
        variable.requires_grad_()
    assert torch.autograd.gradcheck(lambda *v: cross_slab(Slab(order, 1.3, screens), *v), variables)


def test_second_derivative_of_a_wave_is_refused():
    """It isn't left out in silence."""
    delta = torch.full((2, 4, 4), 0.01, dtype=torch.float64, requires_grad=True)
    spectrum = split_step(Volume(Grid((2, 4, 4), (0.5, 0.3, 0.3)), delta, N0), WAVELENGTH, momentum(), Fidelity())
    with pytest.raises(RuntimeError, match="create_graph"):
        torch.autograd.grad(spectrum.abs().sum(), delta, create_graph=True)


def ball_volume(slices=24, contrast=0.05, dtype=torch.float64, n=36):
    grid = Grid((slices, n, n), (4.8 / slices, 0.18, 0.18))
    return Volume(grid, GaussianBall(0.7, contrast, N0, (0.1, -0.3, 0.2)).delta(grid, dtype), N0)


@pytest.mark.parametrize(("order", "slices", "contrast"), [(1, 256, 0.1), (2, 64, 0.05)])
def test_split_step_has_its_order_in_the_slab(order, slices, contrast):
    """Half the slab, 2^order less change. The 4-FFT form leaves out (φ(G² − 1))²: first order, but not seen here."""
    volume = ball_volume(slices, contrast, n=36 if order == 2 else 24)
    fields = [
        split_step(volume, WAVELENGTH, momentum([0.3, -0.4]), Fidelity("wave", order=order, steps=slices // n))
        for n in (4, 2, 1)
    ]
    change = [float((b - a).norm()) for a, b in pairwise(fields)]
    assert math.log2(change[0] / change[1]) == pytest.approx(order, abs=0.35)


def test_both_orders_converge_to_the_same_field():
    volume = ball_volume(slices=128)
    first, second = (split_step(volume, WAVELENGTH, momentum([0.3, -0.4]), Fidelity("wave", order=o)) for o in (1, 2))
    scattered = second.clone()
    scattered[0, 0, 0] -= 1
    assert float((first - second).norm()) < 0.02 * float(scattered.norm())


@pytest.mark.parametrize("source", [(0.0, 0.0), (0.5, -0.4)], ids=str)
def test_energy_is_conserved(source):
    """Σ p_z |S|² of a transparent specimen stays p_z0, to 1e-4 with slabs of 0.2 µm."""
    volume = ball_volume()
    spectrum = split_step(volume, WAVELENGTH, momentum(source), Fidelity("wave"))
    _, pz = axial_difference(volume.grid, WAVELENGTH, volume.background, momentum(source))
    assert float((pz * spectrum.abs().square()).sum()) == pytest.approx(
        axial(source[0] ** 2 + source[1] ** 2), rel=1e-4
    )
    assert float(spectrum[0].abs().square().sum()) - float(spectrum[0, 0, 0].abs() ** 2) > 0.01


@pytest.mark.parametrize("source", [(0.0, 0.0), (0.6, 0.2)], ids=str)
def test_scattering_is_reciprocal(source):
    """Helmholtz: p_z·S from p0 to p1 equals p_z·S from −p1 to −p0 through the specimen turned back to front."""
    grid = Grid((24, 30, 30), (0.2, 0.2, 0.2))
    y, x, z = 0.3, -0.4, 0.5
    step = WAVELENGTH / 6.0
    p0 = [round(source[0] / step) * step, round(source[1] / step) * step]
    p1 = [p0[0] - 3 * step, p0[1] + 2 * step]

    def scattered(centre, first, second):
        volume = Volume(grid, GaussianBall(0.5, 0.03, N0, centre).delta(grid), N0)
        spectrum = split_step(volume, WAVELENGTH, momentum(first), Fidelity("wave"))[0]
        jump = [round((b - a) / step) for a, b in zip(first, second, strict=True)]
        corner = grid.centre(1, 0) / WAVELENGTH
        phase = -2 * math.pi * corner * sum(b - a for a, b in zip(first, second, strict=True))
        last_face = K0 * 2.4 * (axial(second[0] ** 2 + second[1] ** 2) - axial(first[0] ** 2 + first[1] ** 2))
        amplitude = complex(spectrum[jump[0], jump[1]]) * axial(second[0] ** 2 + second[1] ** 2)
        total = phase - last_face
        return amplitude * complex(math.cos(total), math.sin(total))

    there = scattered((z, y, x), p0, p1)
    back = scattered((-z, y, x), [-p1[0], -p1[1]], [-p0[0], -p0[1]])
    assert abs(there) > 0.003
    assert abs(there - back) < 2e-3 * abs(there)


def test_propagation_difference_has_no_cancellation(dtype):
    """p_z(f + f_s) − p_z0 to a few roundings of itself; 0 and no nan where waves are evanescent."""
    grid = Grid((1, 32, 30), (1.0, 0.1, 0.12))
    source = momentum([0.3, -0.5], [0.0, 0.0])
    difference, pz = axial_difference(grid, WAVELENGTH, torch.tensor(N0, dtype=dtype), source.to(dtype))
    waves = source.to(dtype).double()[:, :, None, None] + WAVELENGTH * grid.frequencies(dtype=torch.float64)
    n0 = float(torch.tensor(N0, dtype=dtype))
    squared = n0**2 - waves.square().sum(1)
    exact = squared.clamp_min(0).sqrt()
    exact_difference = exact - exact[:, :1, :1]
    propagates = squared > 0.05
    eps = torch.finfo(dtype).eps
    error = (difference.double() - exact_difference).abs()[propagates]
    assert float((error / (exact_difference.abs()[propagates] + 0.1)).max()) < 40 * eps
    assert float(pz[squared < -0.05].abs().max()) == 0
    assert bool(difference.isfinite().all())
    assert float(difference[0, 0, 0]) == 0


def test_evanescent_waves_carry_no_gradient_of_nan():
    grid = Grid((2, 24, 24), (0.2, 0.08, 0.08))
    delta = (0.01 * torch.randn(grid.shape, dtype=torch.float64)).requires_grad_()
    background = torch.tensor(N0, dtype=torch.float64, requires_grad=True)
    spectrum = split_step(Volume(grid, delta, background), WAVELENGTH, momentum([0.3, 0.1]), Fidelity("wave"))
    spectrum.abs().square().sum().backward()
    assert bool(delta.grad.isfinite().all())
    assert math.isfinite(float(background.grad))
    evanescent = (grid.frequencies(dtype=torch.float64) * WAVELENGTH).square().sum(0) > (N0 + 0.4) ** 2
    assert float(spectrum.detach()[0][evanescent].abs().max()) == 0


def test_fewer_slabs_average_slices_and_more_repeat_them(smooth_field):
    grid = Grid((6, 11, 12), (0.3, 0.2, 0.2))
    delta = smooth_field(grid, 0.03)
    kappa = 0.01 * smooth_field(grid, seed=1).abs()

    def of(grid, delta, kappa, steps):
        return split_step(
            Volume(grid, delta, N0, kappa), WAVELENGTH, momentum([0.2, -0.3]), Fidelity("wave", steps=steps)
        )

    def means(field):
        return field.reshape(3, 2, 11, 12).mean(1)

    thick, thin = Grid((3, 11, 12), (0.6, 0.2, 0.2)), Grid((12, 11, 12), (0.15, 0.2, 0.2))
    torch.testing.assert_close(
        of(grid, delta, kappa, 3), of(thick, means(delta), means(kappa), None), rtol=0, atol=1e-14
    )
    repeated = (f.repeat_interleave(2, 0) for f in (delta, kappa))
    torch.testing.assert_close(of(grid, delta, kappa, 12), of(thin, *repeated, None), rtol=0, atol=1e-14)
    assert torch.equal(of(grid, delta, kappa, None), of(grid, delta, kappa, 6))


@pytest.mark.parametrize(("slices", "steps"), [(5, 3), (3, 5), (7, 7), (4, 1), (1, 6), (12, 5)])
def test_slabs_hold_what_the_slices_do(slices, steps):
    """The mean over the slabs is the mean over the slices; each slab lies between the least and the most of its own."""
    field = torch.randn(slices, 2, 3, dtype=torch.float64)
    slabs = torch.stack([slab_mean(field.unbind(0), i, steps) for i in range(steps)])
    torch.testing.assert_close(slabs.mean(0), field.mean(0), rtol=0, atol=1e-15)
    fine = field.repeat_interleave(steps, 0).reshape(steps, slices, 2, 3).mean(1)
    torch.testing.assert_close(slabs, fine, rtol=0, atol=1e-15)


def test_spectrum_and_field_are_inverse_and_a_constant_is_its_own_amplitude(dtype):
    field = torch.randn(2, 5, 6, dtype=torch.complex64 if dtype == torch.float32 else torch.complex128)
    torch.testing.assert_close(to_field(to_spectrum(field)), field)
    constant = to_spectrum(torch.full((4, 5), 2.5, dtype=dtype))
    assert float(constant[0, 0].real) == pytest.approx(2.5)
    assert float(constant.abs().sum()) == pytest.approx(2.5)


def test_slabs_that_make_energy_are_refused_and_thin_ones_are_not():
    """A vertical step of 0.5, in light that runs along it and across: 0.15 µm slabs make a million times the energy."""
    delta = torch.zeros(16, 48, 48, dtype=torch.float64)
    delta[:, :, 24:] = 0.5
    volume = Volume(Grid((16, 48, 48), (0.15, 0.15, 0.15)), delta, N0)
    sources = momentum((0.0, 0.0), (0.6, 0.0))
    with pytest.raises(
        UnstableError, match=r"slabs of 0.15 µm are too thick for Δn from 0 to 0.5: .* more than 16 steps"
    ):
        split_step(volume, WAVELENGTH, sources, Fidelity())
    assert bool(torch.isfinite(split_step(volume, WAVELENGTH, sources, Fidelity(steps=512)).abs()).all())


def test_slabs_that_lose_energy_are_warned_about():
    """A checkerboard scatters far beyond the light: to first order thick slabs lose most of it, to second none."""
    index = sum(torch.meshgrid(*map(torch.arange, (16, 48, 48)), indexing="ij"))
    volume = Volume(Grid((16, 48, 48), (0.4, 0.2, 0.2)), 0.05 * (1 - 2 * (index % 2)).double(), N0)
    with pytest.warns(SlabWarning, match=r"slabs of 0.4 µm are too thick .* nothing absorbs; use more than 16 steps"):
        split_step(volume, WAVELENGTH, momentum(), Fidelity(order=1))
    split_step(volume, WAVELENGTH, momentum(), Fidelity())


@pytest.mark.parametrize("index", [1.4, 1.36, 1.0, 0.9])
@pytest.mark.parametrize("kappa", [1e-6, 0.05])
def test_light_through_an_absorbing_layer_takes_its_complex_axial_momentum(index, kappa, dtype):
    """exp(ik0·T·(√((n + iκ)² − |p0|²) − p_z0)), also where the layer alone would turn the light back."""
    grid, p0 = Grid((4, 6, 8), (0.05, 0.3, 0.28)), 1.0
    n = torch.full(grid.shape, index - N0, dtype=dtype).requires_grad_()
    k = torch.full(grid.shape, kappa, dtype=dtype).requires_grad_()
    S = split_step(Volume(grid, n, N0, k), WAVELENGTH, momentum([0.0, p0], dtype=dtype), Fidelity("wave"))[0, 0, 0]
    axial_inside = cmath.sqrt(complex(index, kappa) ** 2 - p0**2)
    expected = cmath.exp(1j * K0 * 0.2 * (axial_inside - axial(p0**2)))
    eps = torch.finfo(dtype).eps
    # rounding of n² − |p0|² is magnified by its root
    assert abs(complex(S.detach()) - expected) < 64 * eps * abs(K0 * 0.2 / axial_inside)
    slope = torch.autograd.grad(S.real, [n, k])
    d = 1j * K0 * 0.2 * complex(index, kappa) / axial_inside * expected
    for found, exact in zip(slope, (d.real, (1j * d).real), strict=True):
        assert abs(float(found.sum()) - exact) < 2048 * eps * abs(d) / abs(axial_inside) ** 2
