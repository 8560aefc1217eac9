"""What an installation holds: versions, devices, memory, extras, and whether a folder can be written to."""

import os
import platform
import re
import shutil
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import torch

from recon.config.schema import ConfigError
from recon.run.folder.prepared import check_folder
from torchdic import __version__
from torchdic.memory.free import GIB, free_bytes

# What each extra of the user's is for.
EXTRAS = {"zarr": "OME-Zarr", "bio": "ND2, CZI and LIF", "view": "torchdic view, and napari at the right scale"}

MISSING = "missing"

_REQUIREMENT = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)(?P<rest>[^;]*)(?:;\s*extra\s*==\s*['\"](?P<extra>\w+)['\"])?")


def lines(device: torch.device, folder: Path) -> Iterator[tuple[str, str]]:
    """What there is, a name and words each. folder: in which results would be written."""
    yield "torchdic", f"{__version__}, Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    for name, asked in packages():
        yield name, f"{_version(name)}{f' (asked for: {asked})' if asked else ''}"
    yield "devices", _devices()
    free, whole = free_bytes(device), _whole(device)
    if free is not None:
        yield "memory", f"{free / GIB:.1f} GiB{f' of {whole / GIB:.1f}' if whole else ''} free on {device}"
    for extra, what in EXTRAS.items():
        missing = [name for name, _ in packages(extra) if _version(name) == MISSING]
        way = f"missing, for {what}: pip install 'torchdic[{extra}]'" if missing else f"installed: {what}"
        yield f"[{extra}]", way
    try:
        check_folder(folder)
        yield "this folder", f"can be written to, {shutil.disk_usage(folder).free / GIB:.1f} GiB free"
    except ConfigError as error:
        yield "this folder", str(error)


def packages(extra: str | None = None) -> Iterator[tuple[str, str]]:
    """The packages that torchdic asks for, each with the versions that will do. extra: those of an extra."""
    for line in metadata.requires("torchdic") or ():
        found = _REQUIREMENT.match(line)
        if found is not None and found["extra"] == extra:
            yield found["name"], found["rest"].strip()


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return MISSING


def _devices() -> str:
    cpu = f"cpu ({torch.get_num_threads()} of {os.cpu_count()} processors)"
    if not torch.cuda.is_available():
        return f"{cpu}; PyTorch finds no GPU"
    found = (f"cuda:{i} ({torch.cuda.get_device_name(i)})" for i in range(torch.cuda.device_count()))
    return "; ".join([cpu, *found])


def _whole(device: torch.device) -> int | None:
    """Bytes of memory that a device has; None where it isn't known."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[1]
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # as on Windows
        return None
