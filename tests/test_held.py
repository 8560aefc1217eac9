"""What a computation holds is counted as it runs, and that of many parts is told by those of two and three."""

import gc

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchdic.memory.held import Allocation, Growth, Held, aligned, course_of, crowded, most
from torchdic.memory.signature import is_learned, signature, stand_in
from torchdic.planning.work_precision import peak_bytes

SIZE = 64 * 64 * 4


def chain(parts: int):
    """Work with stages of several kinds: shared, for all parts at once, and for each part in turn."""
    shared = torch.rand(64, 64)
    together = torch.rand(parts, 64, 64).requires_grad_()
    each = [(shared * i).sin().cumsum(0)[:8].clone() for i in range(parts)]
    kept = (together * shared).sin().exp()
    images = torch.stack([kept.sum(0) * i for i in range(5)])
    (images.sum() + torch.stack(each).sum()).backward()


def test_bytes_in_use_are_counted_until_they_are_freed():
    with Held() as held:
        x = torch.zeros(64, 64)
        assert held.bytes == SIZE
        view = x[3:].T
        y = x + 1
        assert held.bytes == 2 * SIZE
        del x
        gc.collect()
        assert held.bytes == 2 * SIZE  # the view holds it
        del view
        y.mul_(2)
        assert held.bytes == SIZE
        y = y.exp()
        assert held.bytes == SIZE
    assert most(held.course) == 2 * SIZE


def test_what_was_there_before_does_not_count():
    x = torch.rand(64, 64)
    assert course_of(lambda: x.view(-1)) == []
    assert [step.held for step in course_of(lambda: x * 2)] == [SIZE]


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_count_is_the_profilers(parts):
    chain(parts)
    assert most(course_of(lambda: chain(parts))) == pytest.approx(peak_bytes(lambda: chain(parts))[1], rel=0.05)


@pytest.mark.parametrize("parts", [2, 3, 5, 20])
def test_two_and_three_parts_tell_what_many_hold(parts):
    """Whichever stage holds most, and though there is a stage for each part in turn."""
    two, three = (course_of(lambda n=n: chain(n)) for n in (2, 3))
    assert len(three) > len(two)
    found, expected = Growth.of(two, three).at(parts), most(course_of(lambda: chain(parts)))
    assert found == pytest.approx(expected, rel=0.05)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 100), st.integers(0, 100)), min_size=1, max_size=20), st.integers(2, 50))
def test_stages_are_lines_and_the_largest_counts(stages, count):
    runs = [[Allocation(f"{i}", a + b * n) for i, (a, b) in enumerate(stages)] for n in (2, 3)]
    assert Growth.of(*runs).at(count) == max(a + b * count for a, b in stages)


def test_runs_are_compared_where_they_do_the_same():
    """Further parts' allocations are passed over; one that only the first run makes is, too."""
    names = ("make", *["loop", "sort"] * 2, *"abcdefghij")
    longer = ("make", *["loop", "sort"] * 3, *"abcdefghij")
    one, other = ([Allocation(name, i) for i, name in enumerate(run)] for run in (names, longer))
    assert [names[a] for a, _ in aligned(one, other)] == list(names)
    assert all(names[a] == longer[b] for a, b in aligned(one, other))
    odd = [*one[:7], Allocation("odd", 99), *one[7:]]
    assert 99 not in dict(aligned(odd, other))


def test_steps_are_crowded_by_what_the_first_of_them_keeps():
    x = torch.rand(64, 64, requires_grad=True)

    def step():
        return x.sin().exp()  # exp keeps its result, sin its argument, which was there before

    assert not crowded(step, 10, 10 * SIZE)
    assert crowded(step, 10, 10 * SIZE - 1)


def test_a_signature_is_of_shapes_and_numbers():
    one, other = torch.rand(3, 4), torch.rand(3, 4)
    assert signature({"a": (one, 2.0)}) == signature({"a": (other, 2.0)})
    assert signature(one) != signature(other.requires_grad_())
    assert signature(one) != signature(one.double())
    assert signature((one, 2.0)) != signature((one, 3.0))


def test_a_stand_in_takes_the_gradient_alone():
    one = torch.rand(3, requires_grad=True)
    parts = {"a": [one * 2, 3.0]}
    copy = stand_in(parts)
    assert is_learned(parts)
    assert is_learned(copy)
    copy["a"][0].sum().backward()
    assert one.grad is None
    with torch.no_grad():
        assert not is_learned(parts)
