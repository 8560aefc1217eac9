"""Parameters that are numbers, or 0-d tensors if they are learned."""

import torch
from jaxtyping import Float
from torch import Tensor


def number(value: float | Tensor) -> float:
    """The value as a Python number. The program waits for a tensor on another device."""
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def scalar(value: float | Tensor, like: Tensor) -> Float[Tensor, ""]:
    """The value as a 0-d tensor with the dtype and device of `like`. A tensor keeps its gradient.

    A number is written directly on the device. The program would have to wait for a copy from the CPU.
    """
    return value.to(like) if isinstance(value, Tensor) else torch.full((), value, dtype=like.dtype, device=like.device)
