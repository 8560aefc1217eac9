"""Parameters that are numbers or, where they are learned, 0-d tensors."""

import torch
from jaxtyping import Float
from torch import Tensor


def number(value: float | Tensor) -> float:
    """The value alone. One on another device is waited for."""
    return float(value.detach()) if isinstance(value, Tensor) else float(value)


def scalar(value: float | Tensor, like: Tensor) -> Float[Tensor, ""]:
    """The value with the dtype and on the device of `like`, learned if it was.

    A number is written there: a copy of it from the CPU would be waited for.
    """
    return value.to(like) if isinstance(value, Tensor) else torch.full((), value, dtype=like.dtype, device=like.device)
