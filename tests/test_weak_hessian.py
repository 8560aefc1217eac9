"""The curvature of a weak specimen's misfit."""

import math
from dataclasses import replace

import pytest
import torch
from distant import DISTANT, Device, bring, send

from data_synthetic import GaussianBall
from recon.fit.newton.differences import adjoint_differences, forward_differences
from recon.fit.newton.weak_hessian import WeakHessian, axial_band, weak_curvature
from recon.fit.setup import Setup, empty_medium
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

BACKGROUND = 1.5
GRID = Grid((6, 12, 14), (0.5, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.2), None], [-0.8, 0.0, 0.9])
FIDELITY = Fidelity(sources=6)
AMPLE = 1 << 30
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")


def setup_of(acquisition=ACQUISITION, microscope=MICROSCOPE, grid=GRID, dtype=torch.float64):
    return Setup(empty_medium(grid, BACKGROUND, torch.zeros((), dtype=dtype)), microscope, acquisition)


def weights_of(acquisition=ACQUISITION, dtype=torch.float64):
    return torch.linspace(1, 2, len(acquisition.prisms) * len(acquisition.focus), dtype=dtype).reshape(
        len(acquisition.prisms), -1
    )


def made(setup, memory=AMPLE, fidelity=FIDELITY):
    """The whole Hessian: with all cosines in the matrices, as `kept` is only what light tells apart."""
    return WeakHessian(setup, weights_of(setup.acquisition), fidelity, memory)


def ball(grid=GRID):
    return GaussianBall(0.5, 1.0, BACKGROUND, (0.2, -0.3, 0.3)).delta(grid, dtype=torch.float64)


def images_along(setup, direction, fidelity=FIDELITY, step=1e-6):
    """What a small Δn changes the images of the wave by, per Δn: central differences."""

    def seen(sign):
        volume = Volume(setup.volume.grid, sign * step * direction, BACKGROUND)
        return image(volume, setup.microscope, setup.acquisition, fidelity)

    return (seen(1) - seen(-1)) / (2 * step)


def curved(setup, direction, fidelity=FIDELITY):
    """Second difference of the weighted squares of the images along a direction."""
    squares = images_along(setup, direction, fidelity).square().sum((2, 3))
    return float((weights_of(setup.acquisition) * squares).sum())


CASES = {
    "prisms and bright field": (ACQUISITION, MICROSCOPE),
    "one image": (Acquisition([Prism((0.1, 0.2), 1.0)], [0.3]), MICROSCOPE),
    "bright field": (Acquisition([None], [-1.0, 0.5]), MICROSCOPE),
    "no objective": (Acquisition([Prism((0.0, 0.24), 1.5)], [0.0]), replace(MICROSCOPE, objective=None)),
    "no condenser": (Acquisition([Prism((0.0, 0.24), 1.5)], [0.4, 0.0]), replace(MICROSCOPE, condenser=None)),
    "wider condenser": (
        Acquisition([Prism((0.0, 0.24), 1.5)], [0.4, 0.0]),
        replace(MICROSCOPE, objective=Objective(0.4)),
    ),
}
each = pytest.mark.parametrize(("acquisition", "microscope"), CASES.values(), ids=CASES)


@each
@pytest.mark.parametrize("kind", ["random", "smooth"])
def test_it_is_the_second_difference_of_the_misfit_at_the_empty_volume(acquisition, microscope, kind):
    """But for the damping that it adds; cosines that share no matrix aren't in smooth directions."""
    setup = setup_of(acquisition, microscope)
    hessian = made(setup)
    direction = torch.randn(GRID.shape, dtype=torch.float64) if kind == "random" else ball()
    found = float((direction * hessian(direction)).sum()) - 0.01 * hessian.mean * float(direction.square().sum())
    expected = curved(setup, direction)
    # random ones are as high along z as the grid goes, and then only the diagonal is kept
    assert found == pytest.approx(expected, rel=1e-5 if hessian.kept == 6 else 0.03)


@each
def test_planes_of_focus_at_once_or_one_by_one_give_the_same(acquisition, microscope):
    """With little memory the responses are made plane by plane."""
    setup, weights = setup_of(acquisition, microscope), weights_of(acquisition)
    together, alone = (weak_curvature(setup, weights, FIDELITY, 3, memory) for memory in (AMPLE, 1))
    for found, expected in zip(together, alone, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12 * float(expected.abs().max()))


def test_it_follows_the_slabs_and_the_directions_of_the_images():
    setup, direction = setup_of(), ball()
    for fidelity in (Fidelity(sources=2), Fidelity(sources=6, steps=3)):
        hessian = made(setup, fidelity=fidelity)
        found = float((direction * hessian(direction)).sum()) - 0.01 * hessian.mean * float(direction.square().sum())
        assert found == pytest.approx(curved(setup, direction, fidelity), rel=1e-3)


@each
def test_it_is_symmetric_and_positive(acquisition, microscope):
    hessian = made(setup_of(acquisition, microscope))
    a, b = torch.randn(2, *GRID.shape, dtype=torch.float64)
    torch.testing.assert_close((a * hessian(b)).sum(), (b * hessian(a)).sum(), rtol=1e-11, atol=0)
    for direction in (a, b, ball(), torch.ones_like(a)):
        least = 0.01 * hessian.mean * float(direction.square().sum())
        assert float((direction * hessian(direction)).sum()) >= least * (1 - 1e-9)


def test_its_mean_is_that_of_its_diagonal():
    """Waves of a real volume are counted once each, so the mean is that over half of them, not over the volume."""
    hessian = made(setup_of())
    diagonal = torch.stack([d * hessian(d) for d in torch.eye(math.prod(GRID.shape), dtype=torch.float64).reshape(
        -1, *GRID.shape)[::37]]).sum((1, 2, 3))  # fmt: skip
    assert float(diagonal.mean()) == pytest.approx(1.01 * hessian.mean, rel=0.3)


@pytest.mark.parametrize(("shape", "memory"), [((6, 12, 14), AMPLE), ((5, 9, 7), AMPLE), ((6, 12, 14), 1 << 16)])
def test_the_inverse_solves(shape, memory):
    grid = replace(GRID, shape=shape)
    hessian = made(setup_of(grid=grid), memory)
    x = torch.randn(shape, dtype=torch.float64)
    edges, constant, ratio = 0.7 * hessian.mean, 0.2 * hessian.mean, 0.4
    right = hessian(x) + constant * x + edges * adjoint_differences(forward_differences(x, ratio), ratio)
    torch.testing.assert_close(hessian.solved(hessian.inverse(edges, constant), right), x, rtol=1e-9, atol=1e-9)


def test_the_spectrum_is_orthonormal_and_has_an_inverse():
    hessian, x = made(setup_of()), torch.randn(GRID.shape, dtype=torch.float64)
    S = hessian.spectrum(x)
    torch.testing.assert_close(hessian.volume(S), x, rtol=0, atol=1e-12)
    twice = torch.ones(S.shape[1], dtype=torch.float64) * 2
    twice[0] = twice[-1] = 1
    energy = (S.abs().square() * twice[:, None]).sum()
    torch.testing.assert_close(energy, x.square().sum(), rtol=1e-12, atol=0)


def test_cosines_that_light_cannot_tell_apart_need_no_matrix():
    """A thick volume of thin slices: a smooth volume is curved alike, and H x is off by what couples to the others."""
    grid = Grid((24, 10, 12), (0.15, 0.2, 0.2))
    setup = setup_of(grid=grid)
    few = made(setup)
    assert few.kept == axial_band(setup) < 24
    x = ball(grid)
    expected = _by_images(setup, x)
    found = few(x) - 0.01 * few.mean * x
    assert float((x * found).sum()) == pytest.approx(float((x * expected).sum()), rel=1e-4)
    assert float((found - expected).norm() / expected.norm()) < 0.02


def _by_images(setup, x):
    """H x as the gradient of ½ Σ weights·(images along x)², by the linear images' adjoint."""
    x = x.clone().requires_grad_()
    step = 1e-5
    volumes = [Volume(setup.volume.grid, sign * step * x, BACKGROUND) for sign in (1, -1)]
    up, down = (image(v, setup.microscope, setup.acquisition, FIDELITY) for v in volumes)
    along = (up - down) / (2 * step)
    energy = (weights_of(setup.acquisition)[..., None, None] * along.square()).sum() / 2
    return torch.autograd.grad(energy, x)[0]


def test_the_matrices_take_no_more_memory_than_they_may():
    grid = Grid((24, 10, 12), (0.15, 0.2, 0.2))
    for memory in (1, 1 << 16, 1 << 18, AMPLE):
        hessian = made(setup_of(grid=grid), memory)
        assert hessian.kept >= 1
        matrices, _ = hessian.inverse(0.0, 1.0)
        taken = 3 * matrices.numel() * matrices.element_size()
        assert hessian.kept == 1 or taken <= memory
    assert hessian.kept > 1


@pytest.mark.parametrize(("dtype", "matrix"), [(torch.float64, torch.complex128), (torch.float32, torch.complex64)])
def test_it_keeps_the_dtype(dtype, matrix):
    setup = setup_of(dtype=dtype)
    hessian = WeakHessian(setup, weights_of(dtype=dtype), FIDELITY, AMPLE)
    x = torch.randn(GRID.shape, dtype=dtype)
    inverse = hessian.inverse(1.0, 1.0)
    assert hessian(x).dtype == dtype
    assert inverse[0].dtype == matrix
    assert hessian.solved(inverse, x).dtype == dtype


def test_single_and_double_precision_agree():
    x = ball()
    single = WeakHessian(setup_of(dtype=torch.float32), weights_of(dtype=torch.float32), FIDELITY, AMPLE)(x.float())
    double = made(setup_of())(x)
    assert float((single.double() - double).norm() / double.norm()) < 1e-5


def test_cosines_fill_the_band_of_the_larger_aperture():
    """The deepest beat of two waves is between 0 and the aperture's edge: (n − √(n² − NA²))/λ."""
    setup = setup_of(grid=Grid((40, 8, 8), (0.1, 0.2, 0.2)))
    beat = (1.5 - math.sqrt(1.5**2 - 0.8**2)) / 0.546
    assert axial_band(setup) == math.ceil(2 * 4.0 * beat) + 3
    oil = replace(setup, microscope=replace(MICROSCOPE, objective=Objective(1.49), condenser=None))
    assert axial_band(oil) > axial_band(setup)


@pytest.mark.parametrize(("pixel", "kind"), [(0.4, "smooth"), (0.2, "smooth"), (0.2, "random"), (0.1, "smooth")])
def test_a_cameras_pixels_pass_less_of_a_wave_the_shorter_it_is(pixel, kind):
    """Second differences of the camera's images, a pixel for as many voxels as it covers.

    Coarse pixels mix waves of a random volume that look alike on them, which the Hessian leaves out.
    """
    setup = setup_of(microscope=replace(MICROSCOPE, camera=Camera(pixel_size=pixel)))
    hessian = made(setup)
    direction = torch.randn(GRID.shape, dtype=torch.float64) if kind == "random" else ball()
    found = float((direction * hessian(direction)).sum()) - 0.01 * hessian.mean * float(direction.square().sum())
    voxels_a_pixel = (pixel / 0.2) ** 2
    assert found == pytest.approx(voxels_a_pixel * curved(setup, direction), rel=0.03 if kind == "random" else 2e-3)


def test_it_stays_on_its_device():
    with Device():
        setup = Setup(
            empty_medium(GRID, BACKGROUND, send(torch.zeros((), dtype=torch.float64))), MICROSCOPE, ACQUISITION
        )
        hessian = WeakHessian(setup, send(weights_of()), FIDELITY, AMPLE)
        x = send(ball())
        seen, solved = hessian(x), hessian.solved(hessian.inverse(1.0, 1.0), x)
        assert seen.device == solved.device == DISTANT
        there = bring(seen), bring(solved)
    here = made(setup_of())
    torch.testing.assert_close(there[0], here(ball()))
    torch.testing.assert_close(there[1], here.solved(here.inverse(1.0, 1.0), ball()))
