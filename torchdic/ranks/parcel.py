"""Objects on their way from rank 0 to the others: their tensors travel by themselves, between GPUs too."""

import io
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from torchdic.ranks.group import own_device, rank


class _Packer(pickle.Pickler):
    """Puts tensors aside and their numbers in their places."""

    def __init__(self, file: io.BytesIO) -> None:
        super().__init__(file)
        self.tensors: list[Tensor] = []
        self._numbers: dict[int, int] = {}

    def persistent_id(self, obj: Any) -> int | None:
        if not isinstance(obj, Tensor):
            return None
        if id(obj) not in self._numbers:
            self._numbers[id(obj)] = len(self.tensors)
            self.tensors.append(obj)
        return self._numbers[id(obj)]


class _Unpacker(pickle.Unpickler):
    def __init__(self, content: bytes, tensors: Sequence[Tensor]) -> None:
        super().__init__(io.BytesIO(content))
        self._tensors = tensors

    def persistent_load(self, pid: Any) -> Tensor:
        return self._tensors[pid]


@dataclass(frozen=True, eq=False)
class Parcel:
    """An object in pieces.

    content: the object without its tensors. tensors: each once, as the object holds them. is_learned: whether a
    gradient is wanted to each.
    """

    content: bytes
    tensors: list[Tensor]
    is_learned: list[bool]

    @property
    def learned(self) -> list[Tensor]:
        """The tensors to which a gradient is wanted."""
        return [t for t, learned in zip(self.tensors, self.is_learned, strict=True) if learned]

    @classmethod
    def of(cls, value: object) -> "Parcel":
        """The pieces of an object."""
        file = io.BytesIO()
        packer = _Packer(file)
        packer.dump(value)
        tensors = packer.tensors
        return cls(file.getvalue(), tensors, [t.requires_grad and torch.is_grad_enabled() for t in tensors])

    def opened(self, tensors: Sequence[Tensor]) -> Any:
        """A copy of the object, with other tensors in the places of its own."""
        return _Unpacker(self.content, tensors).load()


def broadcast(parcel: Parcel | None) -> Parcel:
    """Rank 0's parcel, on every rank. parcel: None on the others."""
    told: list[Any] = [None]
    if parcel is not None:
        kinds = [(t.shape, t.dtype, t.device.type) for t in parcel.tensors]
        told = [(parcel.content, kinds, parcel.is_learned)]
    dist.broadcast_object_list(told, src=0)
    content, kinds, is_learned = told[0]
    if parcel is None:
        empty = [torch.empty(shape, dtype=dtype, device=own_device(kind)) for shape, dtype, kind in kinds]
        parcel = Parcel(content, empty, is_learned)
    for tensor in parcel.tensors:
        # not changed on rank 0, whose tensors may be parts of others
        dist.broadcast(_plain(tensor.detach().contiguous() if rank() == 0 else tensor), src=0)
    return parcel


def add_up(tensor: Tensor) -> None:
    """Put the sum over all ranks into a contiguous tensor; on all of them."""
    dist.all_reduce(_plain(tensor))


def _plain(tensor: Tensor) -> Tensor:
    """The same memory as numbers that any backend carries."""
    if tensor.is_complex():
        return torch.view_as_real(tensor)
    return tensor.view(torch.uint8) if tensor.dtype == torch.bool else tensor
