"""What decides how much memory a computation holds: the kinds and shapes of its arguments, not their values."""

from collections.abc import Hashable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


def signature(part: object) -> Hashable:
    """A key of a number, tensor, dataclass, sequence or mapping.

    For a tensor the key holds the shape, the dtype and whether the tensor is learned. Computations whose arguments have
    the same signature hold the same memory.
    """
    if isinstance(part, Tensor):
        return tuple(part.shape), part.dtype, part.requires_grad
    if isinstance(part, Mapping):
        return tuple((key, signature(value)) for key, value in part.items())
    if isinstance(part, list | tuple):
        return tuple(map(signature, part))
    if is_dataclass(part):
        return type(part).__name__, tuple(signature(getattr(part, field.name)) for field in fields(part))
    assert isinstance(part, Hashable)
    return part


def is_learned(part: object) -> bool:
    """Whether a gradient is wanted to a tensor anywhere in a dataclass, sequence or mapping."""
    if isinstance(part, Tensor):
        return part.requires_grad and torch.is_grad_enabled()
    if isinstance(part, Mapping):
        return any(map(is_learned, part.values()))
    if isinstance(part, list | tuple):
        return any(map(is_learned, part))
    if is_dataclass(part):
        return any(is_learned(getattr(part, field.name)) for field in fields(part))
    return False


def stand_in(part: T) -> T:
    """A copy on the CPU whose tensors are leaves of their own, so that its gradients don't reach the original."""
    if isinstance(part, Tensor):
        return part.detach().cpu().clone().requires_grad_(part.requires_grad)  # pyright: ignore[reportReturnType]
    if isinstance(part, Mapping):
        return {key: stand_in(value) for key, value in part.items()}  # pyright: ignore[reportReturnType]
    if isinstance(part, list | tuple):
        return type(part)(map(stand_in, part))
    if is_dataclass(part) and not isinstance(part, type):
        values = {field.name: getattr(part, field.name) for field in fields(part) if field.init}
        return replace(part, **{name: stand_in(value) for name, value in values.items()})
    return part
