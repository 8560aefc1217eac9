"""Limits on memory: sources in batches, and intermediate values that are computed again instead of kept."""

import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import wraps
from itertools import pairwise
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchdic.errors import BatchWarning

T = TypeVar("T")

# Bytes of an array that a core's second cache holds for the next operation. Half and twice as many were no faster.
IN_CACHE = 1 << 20


def recompute(function: Callable[..., T], *arguments: object, when: bool) -> T:
    """function(*arguments).

    when: whether the backward pass computes the function's intermediate values again, so that they need not be kept.
    """
    if not (when and torch.is_grad_enabled()):
        return function(*arguments)
    return checkpoint(  # pyright: ignore[reportReturnType]
        function,
        *arguments,
        use_reentrant=False,
        preserve_rng_state=False,
        context_fn=lambda: (nullcontext(), _quietly()),
    )


def replay(function: Callable[..., Tensor], *tensors: Tensor, when: bool) -> Tensor:
    """Like `recompute`, for a function of tensors only. No graph is built before the backward pass.

    function: must depend on no learned tensor besides `tensors`.
    A graph's nodes are small and lie between large temporary arrays, whose memory glibc (2.36) then hardly uses again:
    a gradient that held 1 GiB took 8 GiB from the system.
    """
    if not (when and torch.is_grad_enabled()):
        return function(*tensors)
    return _Replayed.apply(function, *tensors)  # pyright: ignore[reportReturnType]


def once(backward: Callable[..., T]) -> Callable[..., T]:
    """A backward pass that has no derivative of its own: it raises RuntimeError where a second derivative is wanted.

    torch's `once_differentiable` raises in some cases only, and in others leaves its part out of the second derivative.
    """

    @wraps(backward)
    def first(ctx: Any, *bars: Tensor) -> T:
        if torch.is_grad_enabled():
            raise RuntimeError("this derivative is written out and has no second one: leave create_graph at False")
        return backward(ctx, *bars)

    return first


class _Replayed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
        ctx.function = function
        ctx.save_for_backward(*tensors)
        return function(*tensors)

    @staticmethod
    @once
    def backward(ctx: Any, result_bar: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        tensors = [t.detach().requires_grad_(t.requires_grad) for t in ctx.saved_tensors]
        with torch.enable_grad():
            result = ctx.function(*tensors)
        learned = [t for t in tensors if t.requires_grad]
        bars = iter(torch.autograd.grad(result, learned, result_bar, allow_unused=True))
        return (None, *(next(bars) if t.requires_grad else None for t in tensors))


def slabs(steps: int, *, split: bool) -> Iterator[tuple[int, int]]:
    """Steps 0 … steps as consecutive ranges (first, last): about √steps ranges if `split`, else a single one."""
    if steps == 0:
        return
    count = math.isqrt(steps - 1) + 1 if split else 1
    edges = [i * steps // count for i in range(count + 1)]
    yield from pairwise(edges)


def in_cache(array: Tensor) -> list[slice]:
    """Equal parts of an array's first axis, each of which a CPU's caches hold. Elsewhere it is a single part."""
    count = len(array)
    if array.device.type != "cpu":
        return [slice(0, count)]
    held = max(1, IN_CACHE * torch.get_num_threads() * count // (array.numel() * array.element_size()))
    parts = math.ceil(count / held)
    edges = [i * count // parts for i in range(parts + 1)]
    return [slice(first, last) for first, last in pairwise(edges)]


# Whether batches have half as many sources as they are said to.
_halved: ContextVar[bool] = ContextVar("halved", default=False)


@contextmanager
def halved_batches() -> Iterator[None]:
    """Within this block batches have half as many sources: the memory that was foreseen for them wasn't there."""
    token = _halved.set(True)
    try:
        yield
    finally:
        _halved.reset(token)


def are_halved() -> bool:
    """Whether this is within `halved_batches`."""
    return _halved.get()


def sum_over_sources(function: Callable[..., Tensor], per_source: tuple[Tensor, ...], size: int) -> Tensor:
    """The sum of function(batch of each tensor) over batches of `size` sources.

    per_source: tensors whose first axis is the source.
    If there are several batches, the backward pass computes each of them again.
    """
    if are_halved():
        size = math.ceil(min(size, len(per_source[0])) / 2)
    if size >= len(per_source[0]):
        return function(*per_source)
    batches = zip(*(t.split(size) for t in per_source), strict=True)
    with worst_of_each_kind():
        total = recompute(function, *next(batches), when=True)
        for batch in batches:
            total = total + recompute(function, *batch, when=True)
    return total


@contextmanager
def worst_of_each_kind() -> Iterator[None]:
    """Of each kind of BatchWarning give only the worst, at the end. Other warnings pass through."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield
    worst: dict[type[Warning], warnings.WarningMessage] = {}
    for one in caught:
        message = one.message
        if not isinstance(message, BatchWarning):
            warnings.warn_explicit(message, one.category, one.filename, one.lineno)
            continue
        other = worst.setdefault(one.category, one).message
        assert isinstance(other, BatchWarning)
        if message.severity > other.severity:
            worst[one.category] = one
    for one in worst.values():
        warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)


@contextmanager
def _quietly() -> Iterator[None]:
    """Ignore every BatchWarning: a second computation would repeat those of the first."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", BatchWarning)
        yield
