"""run.json: for each command that has written into a folder, what was typed, how long it took, and with what."""

import json
import os
import platform
import sys
import time
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from torchdic import __version__
from torchdic.files.whole import write_json

RECORD = "run.json"

# Packages whose versions a result may depend on.
PACKAGES = ("torch", "numpy", "scipy", "scikit-image", "tifffile", "torchdiffeq")


class Record:
    """What a command takes, from when this is made."""

    def __init__(self) -> None:
        self._began, self._worked = time.perf_counter(), time.process_time()

    def leave(self, out: Path, command: str, typed: str, device: torch.device | None) -> None:
        """Write what the command has taken into a folder, in place of what an earlier one of its name took.

        A file of that name that isn't torchdic's stays as it is.
        command: its name. typed: as a shell takes it. device: on which it computed; None for the CPU.
        Raises WriteError.
        """
        earlier = _earlier(out / RECORD)
        if earlier is not None:
            write_json(out / RECORD, {**earlier, command: self._taken(typed, device or torch.device("cpu"))})

    def _taken(self, typed: str, device: torch.device) -> dict[str, Any]:
        on_gpu = device.type == "cuda"
        return {
            "command": typed,
            "finished": datetime.now().astimezone().isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - self._began, 3),
            "processor_seconds": round(time.process_time() - self._worked, 3),
            "peak_bytes": _peak(),
            "gpu_peak_bytes": torch.cuda.max_memory_allocated(device) if on_gpu else None,
            "device": torch.cuda.get_device_name(device) if on_gpu else _cpu(),
            "versions": {
                "torchdic": __version__,
                "Python": platform.python_version(),
                **{name: metadata.version(name) for name in PACKAGES},
                platform.system(): platform.release(),
            },
        }


def recorded_in(out: Path) -> set[str]:
    """The commands whose records a folder holds."""
    return set(_earlier(out / RECORD) or {})


def _earlier(path: Path) -> dict[str, Any] | None:
    """The records of commands that are there; None where the file isn't of such."""
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    ours = isinstance(found, dict) and all(isinstance(one, dict) and "command" in one for one in found.values())
    return found if ours else None


def _peak() -> int | None:
    """The most bytes of memory that this process has held; None where the system doesn't tell."""
    try:
        import resource
    except ImportError:  # as on Windows
        return None
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return held if sys.platform == "darwin" else 1024 * held  # elsewhere it is in KiB


def _cpu() -> str:
    return f"cpu ({platform.machine()}, {torch.get_num_threads()} of {os.cpu_count()} processors)"
