"""The differences that Newton's method inverts: those of the priors, but periodic along y and x."""

import pytest
import torch

from recon.fit.newton.differences import adjoint_differences, at_corner, forward_differences, from_corner
from recon.fit.newton.weak_hessian import cosines, squared_differences
from recon.prior.edges import CORNERS, SMOOTHING, gradient_length

SHAPES = [(4, 6, 8), (5, 7, 9), (3, 8, 5), (1, 6, 7), (4, 1, 6), (4, 6, 1), (2, 2, 2), (1, 1, 1)]
each = pytest.mark.parametrize("shape", SHAPES)


def drawn(*shape):
    return torch.randn(shape, dtype=torch.float64)


@each
@pytest.mark.parametrize("ratio", [1.0, 0.4, 3.0])
def test_the_adjoint_is_one(shape, ratio):
    x, v = drawn(*shape), drawn(3, *shape)
    left = (forward_differences(x, ratio) * v).sum()
    torch.testing.assert_close(left, (x * adjoint_differences(v, ratio)).sum(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 6, 8), (5, 7, 9), (1, 6, 5)])
def test_within_the_volume_they_are_the_priors(shape):
    """Within a frame of medium, as the priors' aren't periodic."""
    x = torch.zeros(shape, dtype=torch.float64)
    x[:, 1:-1, 1:-1] = drawn(shape[0], shape[1] - 2, shape[2] - 2)
    onward = forward_differences(x, 0.4)
    ours = torch.stack([at_corner(onward, corner).square().sum(0).sqrt() for corner in CORNERS])
    torch.testing.assert_close(ours, gradient_length(x, (0.5, 0.2, 0.2)), rtol=1e-9, atol=2 * SMOOTHING)


@each
@pytest.mark.parametrize("corner", CORNERS)
def test_the_adjoint_at_a_corner_is_one_and_the_inverse(shape, corner):
    u, v = drawn(3, *shape), drawn(3, *shape)
    left = (at_corner(u, corner) * v).sum()
    torch.testing.assert_close(left, (u * from_corner(v, corner)).sum(), rtol=1e-12, atol=1e-12)
    assert torch.equal(from_corner(at_corner(u, corner), corner), u)


def test_one_slice_has_no_difference_along_z_and_one_row_none_along_y():
    assert float(forward_differences(drawn(1, 5, 6), 0.4)[0].abs().max()) == 0
    assert float(forward_differences(drawn(3, 1, 6), 0.4)[1].abs().max()) == 0


@each
@pytest.mark.parametrize("ratio", [1.0, 0.4])
def test_their_square_is_diagonal_in_cosines_and_waves(shape, ratio):
    x = drawn(*shape)
    C = cosines(shape[0])
    spectrum = torch.fft.rfft2(torch.tensordot(C, x, 1)).permute(1, 2, 0) * squared_differences(shape, ratio)
    back = torch.tensordot(C.mT, torch.fft.irfft2(spectrum.permute(2, 0, 1), s=shape[1:]), 1)
    expected = adjoint_differences(forward_differences(x, ratio), ratio)
    torch.testing.assert_close(back, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("number", [1, 2, 5, 8])
def test_cosines_are_orthonormal(number):
    C = cosines(number)
    torch.testing.assert_close(C @ C.mT, torch.eye(number, dtype=torch.float64), rtol=0, atol=1e-13)


def test_what_is_given_stays_as_it_was():
    x, v = drawn(3, 4, 5), drawn(3, 3, 4, 5)
    before = x.clone(), v.clone()
    forward_differences(x, 0.4)
    adjoint_differences(v, 0.4)
    assert torch.equal(x, before[0])
    assert torch.equal(v, before[1])
