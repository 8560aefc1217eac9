"""Newton's model: a parabola and priors with corners, within bounds."""

import pytest
import torch
from skimage.restoration import denoise_tv_chambolle

from recon.fit.bounds import Bounds
from recon.fit.newton.differences import at_corner, forward_differences
from recon.fit.newton.proximal import Penalties, Split, minimised
from recon.fit.newton.weak_hessian import cosines, squared_differences
from recon.prior.base import Majorant
from recon.prior.edges import CORNERS

FREE = Bounds(None, None)


def identity_solver(shape, ratio, penalties, majorant, curvature=1.0):
    """(curvature + (edges + rough)·DᵀD + copy)⁻¹."""
    diagonal = curvature + penalties.copy + (penalties.edges + majorant.rough) * squared_differences(shape, ratio)
    C = cosines(shape[0])

    def solve(right):
        spectrum = torch.fft.rfft2(torch.tensordot(C.to(right), right, 1)).permute(1, 2, 0) / diagonal.to(right)
        return torch.tensordot(C.mT.to(right), torch.fft.irfft2(spectrum.permute(2, 0, 1), s=shape[1:]), 1)

    return solve


def solved(right, majorant, bounds=FREE, penalties=None, times=1, ratio=1.0, curvature=1.0):
    """Denoised: the minimum of curvature·½|x|² − right·x + priors, warm-started so many times."""
    penalties = penalties or Penalties(1.0, 1.0)
    solve = identity_solver(right.shape, ratio, penalties, majorant, curvature)
    split = Split.at(torch.zeros_like(right))
    delta = split.free
    for _ in range(times):
        delta, split = minimised(solve, right, majorant, bounds, split, penalties, ratio)
    return delta, split


def objective(x, right, majorant, ratio=1.0, curvature=1.0):
    onward = forward_differences(x, ratio)
    length = torch.stack([at_corner(onward, corner).square().sum(0).sqrt() for corner in CORNERS])
    gradients = (majorant.edges * length + majorant.rough / 2 * length.square()).mean(0)
    corners = (gradients + majorant.sparse * x.abs()).sum()
    return float(curvature * x.square().sum() / 2 - (right * x).sum() + corners)


@pytest.fixture
def noisy():
    """A block in noise."""
    x = torch.zeros(4, 12, 14, dtype=torch.float64)
    x[1:3, 3:8, 4:10] = 1.0
    return x + 0.2 * torch.randn_like(x)


def test_without_priors_it_is_the_linear_solution(noisy):
    found, _ = solved(noisy, Majorant(), curvature=2.0, times=20)
    torch.testing.assert_close(found, noisy / 2, rtol=0, atol=1e-6)


def test_a_diagonal_model_with_sparseness_is_the_soft_threshold(noisy):
    found, _ = solved(noisy, Majorant(sparse=0.3), times=20)
    expected = noisy.sign() * (noisy.abs() - 0.3).clamp_min(0)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    assert torch.equal(found == 0, expected == 0)


@pytest.mark.parametrize("bounds", [Bounds(0.0, None), Bounds(None, 0.0), Bounds(-0.1, 0.5), Bounds(0.2, 0.5)], ids=str)
def test_bounds_are_exact_and_so_is_what_lies_between(noisy, bounds):
    found, _ = solved(noisy, Majorant(sparse=0.3), bounds=bounds, times=20)
    expected = bounds.clamped(noisy.sign() * (noisy.abs() - 0.3).clamp_min(0))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)
    rough, _ = solved(noisy, Majorant(edges=0.3), bounds=bounds)
    assert torch.equal(rough, bounds.clamped(rough))


def test_a_step_loses_a_known_part_of_its_height():
    """In one dimension, total variation of weight w takes 2·w/length off a block and gives it to the ground."""
    step = torch.zeros(1, 1, 20, dtype=torch.float64)
    step[..., 5:13] = 1.0
    found, _ = solved(step, Majorant(edges=0.4), times=20)
    expected = torch.full_like(step, 2 * 0.4 / 12)
    expected[..., 5:13] = 1 - 2 * 0.4 / 8
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


def test_along_z_the_faces_are_free():
    """A step to the last slice has one edge."""
    step = torch.zeros(12, 1, 1, dtype=torch.float64)
    step[8:] = 1.0
    found, _ = solved(step, Majorant(edges=0.4), times=20)
    expected = torch.full_like(step, 0.4 / 8)
    expected[8:] = 1 - 0.4 / 4
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


def test_total_variation_is_scikit_images(noisy):
    """Chambolle's algorithm of the same objective on a line, with ends of medium as that one isn't periodic."""
    padded = torch.nn.functional.pad(noisy[1:2, 5:6], (100, 100))
    found, _ = solved(padded, Majorant(edges=0.3), times=100)
    theirs = denoise_tv_chambolle(padded[0, 0].numpy(), weight=0.3, eps=1e-12, max_num_iter=5000)
    torch.testing.assert_close(found[0, 0], torch.from_numpy(theirs), rtol=0, atol=2e-3)


def test_a_volume_has_no_preferred_diagonal(noisy):
    """scikit-image's gradient, at one corner of the voxels, turns with its corner; the sum over corners hardly does."""
    padded = torch.nn.functional.pad(noisy, (6, 6, 6, 6))
    found, _ = solved(padded, Majorant(edges=0.3), times=20)
    weight, many = 0.3, {"eps": 1e-9, "max_num_iter": 3000}
    corner = denoise_tv_chambolle(padded.numpy(), weight=weight, **many)
    opposite = denoise_tv_chambolle(padded.flip(0, 1, 2).numpy(), weight=weight, **many)[::-1, ::-1, ::-1]
    turned, _ = solved(padded.flip(0, 1, 2), Majorant(edges=0.3), times=20)
    theirs = torch.from_numpy(corner - opposite)
    assert float((turned.flip(0, 1, 2) - found).norm()) < 0.5 * float(theirs.norm())
    between = torch.from_numpy(corner + opposite) / 2
    torch.testing.assert_close(found, between, rtol=0, atol=0.1)


def test_roughness_is_a_linear_filter(noisy):
    majorant = Majorant(rough=2.0)
    found, _ = solved(noisy, majorant, ratio=0.5, times=3)
    no = Penalties(0.0, 0.0)
    expected = identity_solver(noisy.shape, 0.5, no, majorant)(noisy)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


MAJORANTS = {
    "edges": Majorant(edges=0.2),
    "edges and sparse": Majorant(edges=0.2, sparse=0.05),
    "everything": Majorant(edges=0.1, sparse=0.05, rough=0.5),
}


@pytest.mark.parametrize(
    ("bounds", "majorant"),
    [
        pytest.param(bounds, majorant, id=f"{limits}-{name}", marks=() if (limits, name) in fast else pytest.mark.slow)
        for fast in [{("not below 0", "everything")}]
        for limits, bounds in (("free", FREE), ("not below 0", Bounds()))
        for name, majorant in MAJORANTS.items()
    ],
)
def test_a_warm_start_is_within_one_per_cent_of_a_long_run(noisy, majorant, bounds):
    """As a descent has it: what is sought moves a little from one model to the next."""
    long_, _ = solved(noisy, majorant, bounds=bounds, times=100)
    least = objective(long_, noisy, majorant)
    _, split = solved(0.95 * noisy, majorant, bounds=bounds)
    solve = identity_solver(noisy.shape, 1.0, Penalties(1.0, 1.0), majorant)
    warm, _ = minimised(solve, noisy, majorant, bounds, split, Penalties(1.0, 1.0), 1.0)
    assert least <= objective(warm, noisy, majorant) + 1e-9
    assert objective(warm, noisy, majorant) - least < 0.01 * abs(least)


def test_a_weight_per_voxel_keeps_the_edges_that_weigh_nothing():
    step = torch.zeros(1, 1, 20, dtype=torch.float64)
    step[..., 5:13] = 1.0
    weight = torch.full_like(step, 0.4)
    weight[..., [4, 5, 12, 13]] = 0.0  # on both sides of each edge
    found, _ = solved(step, Majorant(edges=weight), times=20)
    torch.testing.assert_close(found, step, rtol=0, atol=1e-4)


def test_going_on_is_going_on(noisy):
    """Two models of 20 rounds are one of 40, so a warm start loses nothing."""
    one, split = solved(noisy, Majorant(edges=0.2, sparse=0.1))
    again, _ = solved(noisy, Majorant(edges=0.2, sparse=0.1), times=2)
    solve = identity_solver(noisy.shape, 1.0, Penalties(1.0, 1.0), Majorant(edges=0.2, sparse=0.1))
    on, _ = minimised(solve, noisy, Majorant(edges=0.2, sparse=0.1), FREE, split, Penalties(1.0, 1.0), 1.0)
    assert torch.equal(on, again)
    assert not torch.equal(one, again)


def test_it_changes_nothing_that_it_is_given(noisy):
    split = Split.at(torch.zeros_like(noisy))
    copies = [t.clone() for t in (noisy, split.free, split.edges, split.copy)]
    solve = identity_solver(noisy.shape, 1.0, Penalties(1.0, 1.0), Majorant())
    minimised(solve, noisy, Majorant(edges=0.2, sparse=0.1), Bounds(), split, Penalties(1.0, 1.0), 1.0)
    assert all(torch.equal(a, b) for a, b in zip((noisy, split.free, split.edges, split.copy), copies, strict=True))
