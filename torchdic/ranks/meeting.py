"""How ranks find each other, also where torchrun has started them again.

torchrun keeps one store for all of its attempts, in which the addresses of an earlier attempt's dead processes are
still written. So rank 0 first names the attempt anew, and the ranks assure each other that all of them mean that name.
"""

import time
import uuid
from datetime import timedelta

from torch.distributed import PrefixStore, Store  # pyright: ignore[reportPrivateImportUsage]
from torch.distributed.rendezvous import rendezvous

# Seconds between two looks.
PAUSE = 0.05


def met(method: str, rank: int, ranks: int, patience: timedelta) -> Store:
    """A store that this attempt's ranks alone write to.

    method: "env://", as torchrun says, or another of `torch.distributed.init_process_group`. patience: how long to wait
    for a key.
    """
    store, *_ = next(iter(rendezvous(method, rank, ranks, timeout=patience)))
    name = _called(store, ranks) if rank == 0 else _answered(store, rank)
    return PrefixStore(name, store)


def _called(store: Store, ranks: int) -> str:
    """Name the attempt and wait for all others' answers."""
    name = uuid.uuid4().hex
    store.set("attempt", name)
    for other in range(1, ranks):
        store.set(f"{name}/heard/{other}", store.get(f"{name}/answer/{other}").decode())
    return name


def _answered(store: Store, rank: int) -> str:
    """Answer to the attempt's name until rank 0 has heard it: what is found at first may be an earlier attempt's."""
    mine, name = uuid.uuid4().hex, ""
    while True:
        latest = store.get("attempt").decode()
        if latest != name:
            name = latest
            store.set(f"{name}/answer/{rank}", mine)
        heard = f"{name}/heard/{rank}"
        if store.check([heard]) and store.get(heard).decode() == mine:
            return name
        time.sleep(PAUSE)
