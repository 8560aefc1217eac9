"""Memory bounded without a change of result."""

import warnings

import pytest
import torch

from torchdic.errors import BatchWarning
from torchdic.memory import batches
from torchdic.memory.batches import in_cache, recompute, replay, slabs, sum_over_sources


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 10, 17, 100])
def test_slabs_follow_one_another_from_the_first_step_to_the_last(steps):
    assert list(slabs(steps, split=False)) == [(0, steps)]
    split = list(slabs(steps, split=True))
    assert [i for first, last in split for i in range(first, last)] == list(range(steps))
    assert all(last > first for first, last in split)
    # about √steps slabs of √steps each: the least that is kept at once
    assert max(len(split), max(last - first for first, last in split)) <= steps**0.5 + 1


def test_recomputed_values_are_not_kept():
    """Autograd holds what a function saves; recomputing, only its arguments."""
    saved = []
    x = torch.rand(1000, requires_grad=True)

    def chain(x):
        for _ in range(10):
            x = x.sin()
        return x

    with torch.autograd.graph.saved_tensors_hooks(lambda t: saved.append(t.numel()) or t, lambda t: t):
        kept = chain(x)
    assert sum(saved) >= 10_000
    calls = []

    def counted(x):
        calls.append(1)
        return chain(x)

    again = recompute(counted, x, when=True)
    assert torch.equal(again, kept)
    (gradient,) = torch.autograd.grad(again.sum(), x)
    (expected,) = torch.autograd.grad(kept.sum(), x)
    assert torch.equal(gradient, expected)
    assert len(calls) == 2
    with torch.no_grad():
        recompute(counted, x, when=True)
    assert len(calls) == 3
    recompute(counted, x, when=False).sum().backward()
    assert len(calls) == 4


def test_replayed_values_build_no_graph_and_leave_the_gradient_as_it_is():
    x, y = (torch.rand(7, dtype=torch.float64, requires_grad=True) for _ in range(2))
    fixed, unused = torch.rand(7, dtype=torch.float64), torch.rand(7, requires_grad=True)
    graphs = []

    def function(a, b, c, _):
        result = (a * b.sin() + c).exp()
        graphs.append(result.requires_grad)
        return result

    # y reaches the result along two ways, one of them through the first argument
    expected = torch.autograd.grad(function(x * y, y, fixed, unused).square().sum(), [x, y])
    found = replay(function, x * y, y, fixed, unused, when=True)
    gradient = torch.autograd.grad(found.square().sum(), [x, y, unused], allow_unused=True)
    assert gradient[2] is None
    assert all(torch.equal(a, b) for a, b in zip(gradient[:2], expected, strict=True))
    assert graphs == [True, False, True]
    with torch.no_grad():
        assert not replay(function, x, y, fixed, unused, when=True).requires_grad


@pytest.mark.parametrize("bytes_held", [1, 100, 250, 1000])
def test_parts_for_the_cache_are_even_and_follow_one_another(monkeypatch, bytes_held):
    monkeypatch.setattr(batches, "IN_CACHE", bytes_held // torch.get_num_threads())
    array = torch.zeros(7, 5, dtype=torch.complex64)  # 40 bytes each
    parts = in_cache(array)
    assert [i for part in parts for i in range(7)[part]] == list(range(7))
    sizes = [len(array[part]) for part in parts]
    assert max(sizes) <= max(1, bytes_held // 40)
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("size", [1, 6, 7])
def test_sum_over_sources_does_not_depend_on_the_batches(size):
    values = torch.arange(7, dtype=torch.float64, requires_grad=True)
    weights = torch.linspace(1, 2, 7, dtype=torch.float64)
    sizes = []

    def function(values, weights):
        sizes.append(len(values))
        return (values.square() * weights).sum()

    total = sum_over_sources(function, (values, weights), size)
    assert sum(sizes) == 7
    assert max(sizes) == size
    assert float(total.detach()) == pytest.approx(float((values.detach().square() * weights).sum()))
    total.backward()
    torch.testing.assert_close(values.grad, 2 * values.detach() * weights)


def test_of_a_warning_about_each_batch_the_worst_is_given_and_others_pass():
    def function(values):
        warnings.warn(BatchWarning(f"of {values.tolist()}", severity=float(values.max())), stacklevel=1)
        warnings.warn("another", RuntimeWarning, stacklevel=1)
        return values.sum()

    values = torch.tensor([1.0, 3.0, 2.0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert float(sum_over_sources(function, (values,), 1)) == 6
    assert [str(w.message) for w in caught] == ["another"] * 3 + ["of [3.0]"]
