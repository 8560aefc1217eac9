"""Where an allocation fails although there seemed to be room: how that is known, what is said, and a second try."""

import errno
import re
import traceback
import warnings
from collections.abc import Callable
from typing import TypeVar

import torch

from torchdic.errors import ShortageWarning, ShortOfMemoryError
from torchdic.memory.batches import are_halved, halved_batches
from torchdic.memory.free import GIB, LESS, free_bytes

T = TypeVar("T")

# How torch and NumPy say what they asked for.
_ASKED = re.compile(r"allocate ([\d.]+) (\w+)")

# What Python says where its own code has found no room for an exception, and bytes that are free then at most.
_NOTHING_SAID, _NOTHING_FREE = "without exception set", 64 << 20


def is_shortage(error: BaseException) -> bool:
    """Whether an error says that memory ran out: Python's, NumPy's, or torch's, which on the CPU is a RuntimeError.

    torch loads some of its libraries when they are first used: where there is no room for one, that is an ImportError,
    and where there is none to look for it, the system's. With next to nothing free Python may not even say what failed.
    """
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return True
    if isinstance(error, ImportError):
        return "failed to map segment" in str(error)
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    if isinstance(error, SystemError):
        free = free_bytes(torch.device("cpu"))
        return _NOTHING_SAID in str(error) and free is not None and free < _NOTHING_FREE
    return isinstance(error, RuntimeError) and "can't allocate memory" in str(error)


def as_shortage(error: Exception) -> Exception:
    """An error as it is told: if memory ran out, ShortOfMemoryError of one line with what helps; else the error itself.

    The arrays that its traceback holds are let go, so that there is room to save what has been computed.
    """
    if not is_shortage(error):
        return error
    traceback.clear_frames(error.__traceback__)
    if isinstance(error, ShortOfMemoryError):
        return error
    told = ShortOfMemoryError(f"the memory ran out{_asked(error)}; {LESS}, and so does a smaller fidelity.memory")
    told.__cause__ = error
    return told


def _asked(error: Exception) -> str:
    """How much was asked for, where the error says so."""
    found = _ASKED.search(str(error))
    if found is None:
        return ""
    number, unit = found.groups()
    size = f"{int(number) / GIB:.3g} GiB" if unit == "bytes" else f"{number} {unit}"
    return f": another {size} were asked for"


def halved_once(compute: Callable[[], T], device: torch.device) -> T:
    """compute(), and where a GPU's memory runs out, once more with batches of half the sources, which is warned of.

    Beside the CPU's memory there is no second try: it is shared, and the system ends a process rather than refusing.
    """
    try:
        return compute()
    except (MemoryError, RuntimeError) as error:
        if not may_be_halved(error, device):
            raise
        announce_halving(error, device)
    with halved_batches():
        return compute()


def may_be_halved(error: Exception, device: torch.device) -> bool:
    """Whether smaller batches, which have not been tried yet, may help."""
    foreseen = isinstance(error, ShortOfMemoryError)  # for the smallest batches
    return device.type != "cpu" and is_shortage(error) and not foreseen and not are_halved()


def announce_halving(error: Exception, device: torch.device) -> None:
    """Warn that batches are halved, and let go what the failed computation held."""
    told = str(as_shortage(error)).partition(";")[0]
    warnings.warn(f"{device}: {told}; it goes on with half as many sources in a batch", ShortageWarning, stacklevel=3)
    torch.cuda.empty_cache()
