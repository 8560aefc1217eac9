"""What past steps tell of a Hessian."""

import pytest
import torch

from recon.fit.newton.secants import LEAST, Secants

SHAPE = (2, 3, 4)
N = 24


def volume(vector):
    return vector.reshape(SHAPE)


@pytest.fixture
def known():
    """A positive matrix to start from, the one to be found, and both as operators on volumes."""
    A, B = torch.randn(2, N, N, dtype=torch.float64)
    first, true = A @ A.T + N * torch.eye(N), B @ B.T + 2 * torch.eye(N)
    return first, true


def operator(matrix):
    return lambda delta: (matrix @ delta.flatten()).reshape(SHAPE)


def matrix_of(secants):
    unit = torch.eye(N, dtype=torch.float64)
    return torch.stack([secants(volume(row)).flatten() for row in unit])


def pairs_of(true, number):
    steps = torch.randn(number, *SHAPE, dtype=torch.float64)
    return [(step, operator(true)(step)) for step in steps]


def test_without_pairs_nothing_is_updated(known):
    first, _ = known
    secants = Secants(operator(first), [])
    assert float(matrix_of(secants).abs().max()) == 0
    solve = operator(torch.linalg.inv(first))
    assert secants.solved(solve) is solve


@pytest.mark.parametrize("number", [1, 3, 5])
def test_the_last_pair_is_obeyed(known, number):
    first, true = known
    pairs = pairs_of(true, number)
    updated = first + matrix_of(Secants(operator(first), pairs))
    step, change = pairs[-1]
    torch.testing.assert_close(updated @ step.flatten(), change.flatten(), rtol=1e-9, atol=1e-9)


def test_it_is_the_update_of_the_textbook(known):
    """Broyden, Fletcher, Goldfarb and Shanno's, one pair after another."""
    first, true = known
    pairs, B = pairs_of(true, 3), first.clone()
    for step, change in pairs:
        s, y = step.flatten(), change.flatten()
        B = B - torch.outer(B @ s, B @ s) / (s @ B @ s) + torch.outer(y, y) / (s @ y)
    torch.testing.assert_close(first + matrix_of(Secants(operator(first), pairs)), B, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("curvature", [1.0, 0.0, -3.0])
def test_the_update_is_symmetric_and_positive_even_where_the_misfit_bends_the_wrong_way(known, curvature):
    first, true = known
    pairs = [(step, curvature * change) for step, change in pairs_of(true, 4)]
    updated = first + matrix_of(Secants(operator(first), pairs))
    torch.testing.assert_close(updated, updated.T, rtol=1e-9, atol=1e-9)
    assert float(torch.linalg.eigvalsh(updated).min()) > 0


def test_a_step_that_bends_the_wrong_way_keeps_a_fifth_of_the_curvature(known):
    first, true = known
    ((step, change),) = pairs_of(true, 1)
    secants = Secants(operator(first), [(step, -change)])
    own = float((step * operator(first)(step)).sum())
    found = own + float((step * secants(step)).sum())
    assert found == pytest.approx(LEAST * own)


def test_a_step_of_nothing_is_no_pair(known):
    first, true = known
    pairs = pairs_of(true, 2)
    nothing = torch.zeros(SHAPE, dtype=torch.float64)
    with_it = matrix_of(Secants(operator(first), [pairs[0], (nothing, nothing), pairs[1]]))
    assert torch.equal(with_it, matrix_of(Secants(operator(first), pairs)))


@pytest.mark.parametrize("number", [1, 5])
def test_the_updated_inverse_times_the_updated_matrix_is_the_identity(known, number):
    """Also for a matrix that isn't the one that was updated, as Newton's method adds the priors to it."""
    first, true = known
    secants = Secants(operator(first), pairs_of(true, number))
    for matrix in (first, first + 3 * torch.eye(N, dtype=torch.float64)):
        solve = secants.solved(operator(torch.linalg.inv(matrix)))
        x = torch.randn(SHAPE, dtype=torch.float64)
        torch.testing.assert_close(solve(operator(matrix)(x) + secants(x)), x, rtol=1e-9, atol=1e-9)


def test_float32_stays_float32(known):
    first = known[0].float()
    secants = Secants(operator(first), [(torch.randn(SHAPE), torch.randn(SHAPE))])
    x = torch.randn(SHAPE)
    assert secants(x).dtype == torch.float32
    assert secants.solved(operator(torch.linalg.inv(first)))(x).dtype == torch.float32
