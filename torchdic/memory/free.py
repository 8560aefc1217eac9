"""How much memory a device has free, and whether a computation fits into it."""

import math
from pathlib import Path

import torch

from torchdic.errors import ShortOfMemoryError
from torchdic.grid import Grid

GIB = 1 << 30
LESS = "fewer voxels, prism settings, focus planes or steps, less padding or another propagation need less"


def check_room(wanted: int, free: int | None, what: str) -> None:
    """Raise ShortOfMemoryError if a computation needs more bytes than are free.

    wanted: bytes that it needs.
    free: bytes that are free. None means unknown, and then nothing is refused.
    what: the computation, as the message names it.
    """
    if free is not None and wanted > free:
        raise ShortOfMemoryError(
            f"{what} need at least {wanted / GIB:.3g} GiB of memory, {free / GIB:.3g} GiB are free; {LESS}"
        )


def check_volume(grid: Grid, copies: int, device: torch.device) -> None:
    """Raise ShortOfMemoryError if so many float32 arrays of a grid would not fit into the device's free memory."""
    wanted = copies * math.prod(grid.shape) * torch.float32.itemsize
    check_room(wanted, free_bytes(device), f"{copies} arrays of {'×'.join(map(str, grid.shape))} voxels")


def free_bytes(device: torch.device) -> int | None:
    """Bytes that a device has free for tensors; None if that isn't known.

    On the CPU this is the memory that Linux counts as available, or what the process's control groups, or its own limit
    (`ulimit -v`), leave if that is less. On CUDA it is what the device has free, and what torch's allocator holds
    unused.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    if device.type != "cpu":
        return None
    known = [available(), left_by_limit(), *left_by_groups()]
    return min((n for n in known if n is not None), default=None)


def spared(memory: int, device: torch.device) -> int:
    """Bytes of a budget that are there, where as many again are left for what is made of them."""
    free = free_bytes(device)
    return memory if free is None else min(memory, free // 2)


def available(table: Path = Path("/proc/meminfo")) -> int | None:
    """Bytes that can be had without swapping, by Linux's own estimate; None if it can't be read."""
    try:
        lines = table.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return found[0] << 10 if found else None


def left_by_limit(sizes: Path = Path("/proc/self/statm")) -> int | None:
    """Bytes that the process's limit on its address space leaves; None without a limit, or where it isn't known."""
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        pages = int(sizes.read_text(encoding="ascii").split()[0])
    except (ImportError, OSError):  # no Unix, no Linux
        return None
    return None if limit == resource.RLIM_INFINITY else max(0, limit - pages * resource.getpagesize())


def left_by_groups(root: Path = Path("/sys/fs/cgroup"), membership: Path = Path("/proc/self/cgroup")) -> list[int]:
    """Bytes that each of the process's control groups leaves of its limit.

    The groups are those of version 2, or of version 1's memory controller.
    """
    try:
        lines = membership.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    left = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            base, names = root, ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            base, names = root / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        group = base / path.strip("/")
        # inside a container its own group is the root, whatever its name outside
        for folder in {group, *group.parents, base}:
            if folder.is_relative_to(base):
                left += _left_by_group(folder, *names)
    return left


def _left_by_group(folder: Path, most: str, now: str, cached: str) -> list[int]:
    try:
        limit, used = ((folder / name).read_text(encoding="ascii").strip() for name in (most, now))
        if limit == "max":
            return []
        lines = (folder / "memory.stat").read_text(encoding="ascii").splitlines()
    except OSError:
        return []
    # cached pages of files count as free: the system takes back those that were not used lately
    files = sum(int(line.split()[1]) for line in lines if line.split()[0] == cached)
    return [max(0, int(limit) - int(used) + files)]
