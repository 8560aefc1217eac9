"""A folder that results are to be written into."""

import os
import warnings
from pathlib import Path

from recon.config.schema import ConfigError
from recon.run.checkpoint import UnsavedWarning
from recon.run.folder.lock import held_folder, hold, is_lost
from torchdic.files.extras.ome_zarr import is_zarr
from torchdic.files.whole import written_whole


def check_folder(out: Path) -> None:
    """Raise ConfigError where `out` can't become a folder of results, as where it is a file. Nothing is touched."""
    there = next(folder for folder in (out, *out.absolute().parents) if os.path.lexists(folder))
    if not os.path.exists(there):
        raise ConfigError(f"{out}: can't be written to: {there} is a link to {os.readlink(there)}, which isn't there")
    if not there.is_dir():
        raise ConfigError(f"{out}: can't be written to: {there} is a file, not a folder")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"{out}: can't be written to: no permission to write in {there}")
    image = next((folder for folder in (there, *there.absolute().parents) if is_zarr(folder)), None)
    if image is not None:
        raise ConfigError(f"{out}: can't be written to: {image} is an OME-Zarr, which holds images alone")


def prepare_folder(out: Path) -> None:
    """Make sure that `out` is a folder that can be written to, and that no other run writes into it.

    Raises ConfigError where it can't, and FolderInUseError where another run does.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        with written_whole(out / ".writable"):
            pass
        (out / ".writable").unlink()
    except OSError as error:
        raise ConfigError(f"{out}: can't be written to: {error.strerror or error}") from error
    hold(out)


def keep_folder(out: Path) -> None:
    """Make the folder of a run, or one in it, anew where it was removed during the run, and warn UnsavedWarning of it.

    Where it can't be made, nothing is said: what is written next will say so. Raises FolderInUseError where another run
    has made it.
    """
    run = held_folder(out)
    lost = is_lost(run)
    if out.is_dir() and not lost:
        return
    try:
        if lost or run == out:
            prepare_folder(run)
        out.mkdir(parents=True, exist_ok=True)
    except (ConfigError, OSError):
        return
    warnings.warn(
        f"{run if lost else out}: the folder was removed during the run; it is made anew", UnsavedWarning, stacklevel=2
    )
