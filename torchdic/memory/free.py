"""Memory that a device has left, and whether there is room."""

import math
from pathlib import Path

import torch

from torchdic.errors import ShortOfMemoryError
from torchdic.grid import Grid

GIB = 1 << 30


def check_room(wanted: int, free: int | None, what: str) -> None:
    """Raise ShortOfMemoryError where a computation wants more bytes than are free; None: nobody knows what is."""
    if free is not None and wanted > free:
        raise ShortOfMemoryError(
            f"{what} want at least {wanted / GIB:.3g} GiB of memory, {free / GIB:.3g} GiB are free; fewer voxels, "
            "prism settings, focus planes or steps, less padding or another propagation want less"
        )


def check_volume(grid: Grid, copies: int, device: torch.device) -> None:
    """Raise ShortOfMemoryError where so many float32 arrays of a grid, not made yet, would have no room."""
    wanted = copies * math.prod(grid.shape) * torch.float32.itemsize
    check_room(wanted, free_bytes(device), f"{copies} arrays of {'×'.join(map(str, grid.shape))} voxels")


def free_bytes(device: torch.device) -> int | None:
    """Bytes that a device has left for tensors; None where that isn't known.

    On the CPU what Linux counts as available, and what this process's control groups leave of their limits; on CUDA
    what the device has left, and what torch's allocator holds of it unused.
    """
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    if device.type != "cpu":
        return None
    known = [available(), *left_by_groups()]
    return min((n for n in known if n is not None), default=None)


def available(table: Path = Path("/proc/meminfo")) -> int | None:
    """Linux's own estimate of what can be had without swapping."""
    try:
        lines = table.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    return found[0] << 10 if found else None


def left_by_groups(root: Path = Path("/sys/fs/cgroup"), membership: Path = Path("/proc/self/cgroup")) -> list[int]:
    """What each of the process's control groups (version 2, or 1's memory controller) leaves of its limit."""
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
        # a container sees its own group as the root, whatever its name outside
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
    # files' pages that no one has used of late are given back first
    files = sum(int(line.split()[1]) for line in lines if line.split()[0] == cached)
    return [max(0, int(limit) - int(used) + files)]
