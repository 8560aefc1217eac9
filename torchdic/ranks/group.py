"""The processes that compute together: the first one, rank 0, leads, and the others follow it.

Rank 0 runs the program as a single process would. What can be shared out it hands to all ranks
(`torchdic.ranks.shared`). The others hold no state of the program, so that no two of them can come to differ.
They talk through torch.distributed: by gloo between CPUs, by NCCL between GPUs.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch.distributed import Store  # pyright: ignore[reportPrivateImportUsage]

from torchdic.ranks.meeting import met

# A rank waits for the others as long as that. One that dies closes its connections, which ends the wait at once.
PATIENCE = timedelta(days=30)
# Seconds in which the first rank that is left hears of a loss. torchrun leaves ranks 30 s to end.
OTHERS_HEAR = 8.0


@dataclass(frozen=True)
class Group:
    """The ranks, as one of them sees them.

    rank: this one's number, from 0. ranks: how many there are. local: this one's number on its machine. here: how many
    are on its machine.
    """

    rank: int
    ranks: int
    local: int
    here: int

    @property
    def backend(self) -> str:
        """How tensors travel. Where ranks share a GPU, which NCCL forbids, gloo carries a GPU's tensors too."""
        own_gpu = torch.cuda.is_available() and self.here <= torch.cuda.device_count()
        return "cpu:gloo,cuda:nccl" if own_gpu else "gloo"

    def device(self, kind: str) -> torch.device:
        """The device of a kind, such as "cuda", that is this rank's own."""
        return torch.device(kind, self.local % torch.cuda.device_count()) if kind == "cuda" else torch.device(kind)


_group: Group | None = None
_store: Store | None = None
_complete = True
_alone: ContextVar[bool] = ContextVar("alone", default=False)


@contextmanager
def joined(group: Group, method: str = "env://") -> Iterator[None]:
    """Within this block the process is one of the ranks, all of which must enter it.

    method: how they find each other, see `torch.distributed.init_process_group`; "env://" is as torchrun says.
    """
    global _group, _store, _complete
    if torch.cuda.is_available():
        torch.cuda.set_device(group.device("cuda"))
    store = met(method, group.rank, group.ranks, PATIENCE)
    dist.init_process_group(group.backend, store=store, timeout=PATIENCE, rank=group.rank, world_size=group.ranks)
    _group, _store, _complete = group, store, True
    try:
        yield
    finally:
        _group = _store = None
        dist.destroy_process_group()


def rank() -> int:
    """The number of this process among the ranks; 0 where it computes by itself."""
    return 0 if _group is None else _group.rank


def ranks() -> int:
    """The number of ranks; 1 where the process computes by itself."""
    return 1 if _group is None else _group.ranks


def note_loss() -> None:
    """Remember that a rank is lost, and let the others know that this one has heard of it."""
    global _complete
    _complete = False
    if _store is not None:
        with suppress(RuntimeError):  # the store is lost too
            _store.set(f"heard/{rank()}", "")


def is_complete() -> bool:
    """Whether no rank is known to be lost."""
    return _complete


def tells_of_loss() -> bool:
    """Whether this rank is the one that says that a rank is lost: the first of those that are left, where it is known.

    The first one may be computing: it is waited for.
    """
    if _store is None or rank() == 0:
        return True
    until = time.monotonic() + OTHERS_HEAR
    with suppress(RuntimeError):
        while time.monotonic() < until:
            if any(_store.check([f"heard/{other}"]) for other in range(rank())):
                return False
            time.sleep(0.1)
        return True
    return False


def ranks_here() -> int:
    """The number of ranks on this machine."""
    return 1 if _group is None else _group.here


def own_device(kind: str) -> torch.device:
    """The device of a kind that is this rank's own."""
    return torch.device(kind) if _group is None else _group.device(kind)


@contextmanager
def alone() -> Iterator[None]:
    """Within this block nothing is shared out: the process computes by itself."""
    token = _alone.set(True)
    try:
        yield
    finally:
        _alone.reset(token)


def shares_out() -> bool:
    """Whether what is computed now is shared out."""
    return ranks() > 1 and not _alone.get()
