"""A device that this machine hasn't got, to see what one such as a GPU would refuse or wait for.

A distant tensor is computed with on the CPU and claims to be elsewhere. As on a GPU, tensors of the two can't meet,
but for 0-d ones of the CPU, and whoever reads a value, or copies one there, waits for all that was asked for before.
"""

import os
import sys
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

# every build of torch knows it, and autograd looks for no streams there
DISTANT = torch.device("meta")
AUTHORS = tuple(f"{Path(__file__).parents[1] / name}{os.sep}" for name in ("torchdic", "recon"))
# a size or a value that only the device knows, and the CPU asks for
READERS = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "_unique2"}
MAKERS = (torch.tensor, torch.as_tensor, torch.Tensor.new_tensor)
aten = torch.ops.aten
# Below a dispatch mode no one resolves a tensor's lazy conjugation or sign.
NOT_LAZY = {aten._conj.default: aten.conj_physical.default, aten._neg_view.default: aten.neg.default}


class Distant(Tensor):
    """A tensor on the distant device; `held` is what it would hold there."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> "Distant":
        return torch.Tensor._make_wrapper_subclass(
            cls, held.shape, strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            device=DISTANT,
        )  # fmt: skip

    def __init__(self, held: Tensor) -> None:
        self.held = held

    def __repr__(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return f"Distant({self.held})"

    def tolist(self) -> list:
        return self.to("cpu").tolist()

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):  # pyright: ignore[reportIncompatibleMethodOverride]
        raise RuntimeError(f"{func} of a distant tensor outside Device")


class Device:
    """While it is entered, distant tensors work.

    room: bytes that it holds at once, beyond which torch.OutOfMemoryError is raised as on a GPU; None is no limit.
    waits: how often the CPU waited for the device, by what and where. most: bytes that were held at once.
    """

    def __init__(self, room: int | None = None) -> None:
        self.waits: Counter[str] = Counter()
        self.room, self.most = room, 0
        self._known: dict[int, int] = {}
        self._within = ExitStack()

    def __enter__(self) -> "Device":
        self._within.enter_context(_Functions())
        self._within.enter_context(_Kernels(self))
        return self

    def __exit__(self, *failure: object) -> None:
        self._within.close()

    def take(self, held: Tensor) -> None:
        """Count the bytes of what a distant tensor holds until they are freed; torch's error where there is no room."""
        storage = held.untyped_storage()
        key = storage._cdata
        if key in self._known:
            return
        now = sum(self._known.values()) + storage.nbytes()
        if self.room is not None and now > self.room:
            raise torch.OutOfMemoryError(f"CUDA out of memory. Tried to allocate {storage.nbytes() / 1024:.2f} KiB. …")
        self._known[key], self.most = storage.nbytes(), max(self.most, now)
        weakref.finalize(storage, self._known.pop, key)

    def wait(self, what: str) -> None:
        """Count one, and whose it is."""
        frame = sys._getframe()
        while frame is not None and not frame.f_code.co_filename.startswith(AUTHORS):
            frame = frame.f_back
        place = f"{Path(frame.f_code.co_filename).stem}.{frame.f_code.co_name}" if frame else "the caller"
        self.waits[f"{what} in {place}"] += 1


class _Functions(TorchFunctionMode):
    """What comes before kernels: values are made tensors."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func not in MAKERS:
            return func(*args, **kwargs)
        device = kwargs.pop("device", None)
        *like, value = args
        for tensor in like:  # of new_tensor
            device = device or tensor.device
            kwargs.setdefault("dtype", tensor.dtype)
        if isinstance(value, Tensor):
            return value.to(device or value.device, kwargs.get("dtype") or value.dtype)
        made = torch.tensor(value, **kwargs)
        return made if device is None else made.to(device)


class _Kernels(TorchDispatchMode):
    """Every kernel: run on what distant tensors hold."""

    def __init__(self, device: Device) -> None:
        super().__init__()
        self._device = device

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name = func._schema.name.removeprefix("aten::")
        tensors = [leaf for leaf in _leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        distant = [t for t in tensors if isinstance(t, Distant)]
        asked = kwargs.get("device")
        to_distant = bool(distant) if asked is None else torch.device(asked) == DISTANT
        if asked is not None:
            kwargs["device"] = torch.device("cpu")
        crosses = name == "_to_copy" and to_distant != bool(distant)
        if crosses or (name == "copy_" and 0 < len(distant) < len(tensors)):
            self._device.wait("copy")
        elif distant and any(t.ndim > 0 for t in tensors if not isinstance(t, Distant)):
            shapes = ", ".join(f"{tuple(t.shape)} on {t.device}" for t in tensors)
            raise RuntimeError(f"{name}: tensors on two devices: {shapes}")
        elif distant and (name in READERS or _counts(name, args, kwargs)):
            self._device.wait(name)
        ours = {id(t.held): t for t in distant}

        def wrapped(leaf: object) -> object:
            if not (isinstance(leaf, Tensor) and to_distant):
                return leaf
            if id(leaf) in ours:
                return ours[id(leaf)]
            self._device.take(leaf)
            return Distant(leaf)

        held_args, held_kwargs = _mapped(_held, (args, kwargs))
        if distant:  # and not a number, whose conjugate is asked for too
            func = NOT_LAZY.get(func, func)
        return _mapped(wrapped, func(*held_args, **held_kwargs))


def _counts(name: str, args: tuple, kwargs: dict) -> bool:
    """Whether the result's size depends on values."""
    if name == "repeat_interleave":
        return kwargs.get("output_size") is None
    return name == "index" and any(isinstance(i, Tensor) and i.dtype == torch.bool for i in args[1])


# torch's own trees know far more kinds of containers, and take longer than the kernels
def _leaves(tree: object) -> Iterator[object]:
    if isinstance(tree, tuple | list):
        for branch in tree:
            yield from _leaves(branch)
    elif isinstance(tree, dict):
        yield from _leaves(tuple(tree.values()))
    else:
        yield tree


def _mapped(function: Callable[[object], object], tree: object) -> object:
    if isinstance(tree, tuple | list):
        return type(tree)([_mapped(function, branch) for branch in tree])
    if isinstance(tree, dict):
        return {key: _mapped(function, branch) for key, branch in tree.items()}
    return function(tree)


def _held(leaf: object) -> object:
    return leaf.held if isinstance(leaf, Distant) else leaf


def send(value: Tensor) -> Tensor:
    """The tensor, on the distant device, a leaf that requires grad if it did."""
    return Distant(value.detach().clone()).requires_grad_(value.requires_grad)


def bring(value: Tensor) -> Tensor:
    """What a distant tensor holds."""
    assert isinstance(value, Distant)
    return value.held.detach()
