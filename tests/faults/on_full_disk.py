"""torchdic, on a disk that is full from the moment on at which a file is to be written for the nth time.

    python on_full_disk.py NAME N WORDS…

The disk is the one that the file's folder is on, and really is full: what a process writes to it fails in the system.
It is filled by a file at its root.
"""

import itertools
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

from recon.cli import main
from torchdic.files import whole

BALLAST = "ballast"


def fill(folder: Path) -> None:
    """Leave no byte on a folder's disk."""
    root = next(above for above in (folder, *folder.parents) if above.is_mount())
    with suppress(OSError), (root / BALLAST).open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 16))


def fill_before(name: str, time: int) -> None:
    """Fill the disk when a file of this name is about to be written for this time."""
    moved_there, times = whole._moved_there, itertools.count(1)

    @contextmanager
    def filling(path: Path):
        if path.name == name and next(times) == time:
            fill(path.absolute().parent)
        with moved_there(path) as partial:
            yield partial

    whole._moved_there = filling

    def opened(event: str, arguments: tuple) -> None:
        if event == "open" and isinstance(arguments[0], str) and arguments[0].endswith(f"/{name}"):
            fill(Path(arguments[0]).absolute().parent)

    if name == "log.csv":  # it isn't written whole, but as the steps are taken
        sys.addaudithook(opened)


if __name__ == "__main__":
    fill_before(sys.argv[1], int(sys.argv[2]))
    sys.exit(main(sys.argv[3:]))
