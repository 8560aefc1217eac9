"""The tiles of a run on disk: those that are fitted, so that an interrupted run goes on with the others."""

import json
import shutil
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from recon.run.checkpoint import Checkpoint, CheckpointError, load, save
from recon.run.recorded import CHECKPOINT
from recon.tiling.layout import Layout, Tile
from recon.tiling.visits import Visit
from torchdic.files.whole import PARTIAL, WriteError, remove_partial, write_json

TILES = "tiles"

# A tile's last step, without what a descent would need to go on.
FITTED = "fitted.pt"

# What all tiles are.
LAYOUT = "layout.json"


def folder_of(out: Path, visit: Visit) -> Path:
    """The folder of the log and the checkpoint of a tile's fit."""
    return out / TILES / str(visit).replace(" ", "-")


def prepared(folder: Path) -> None:
    """Make a tile's folder, without what a process that was killed left half written in it. Raises WriteError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_partial(folder)
    except OSError as error:
        raise WriteError.of(folder, error) from error


def identity_of(whole: str, layout: Layout, tile: Tile, steps: int, shared: str = "") -> str:
    """What a tile's fit depends on. whole: of the field. shared: of what other tiles' fits said."""
    rows, columns = tile.rows.pixels, tile.columns.pixels
    lines = [
        f"tile = rows {rows.start} to {rows.stop}, columns {columns.start} to {columns.stop}, margin {layout.margin}",
        f"reconstruction.steps = {steps}",  # a fitted tile can't go on
        f"taken over from other tiles = {shared or 'nothing'}",
    ]
    return "\n".join([whole, *lines])


def keep(folder: Path, ended: Checkpoint) -> None:
    """Keep a fitted tile; its checkpoint, many times as large, goes. Raises WriteError."""
    save(folder / FITTED, replace(ended, step=replace(ended.step, state={})))
    (folder / CHECKPOINT).unlink(missing_ok=True)


def is_kept(folder: Path) -> bool:
    """Whether a folder holds a fitted tile."""
    return (folder / FITTED).exists()


def kept(folder: Path, identity: str) -> Checkpoint | None:
    """A fitted tile; None where it has yet to be fitted. Raises CheckpointError where it is another run's."""
    return load(folder / FITTED, identity) if is_kept(folder) else None


def begun(folder: Path, identity: str) -> Checkpoint | None:
    """What a tile's interrupted descent goes on from; None begins it. Raises CheckpointError as `kept` does."""
    return load(folder / CHECKPOINT, identity) if (folder / CHECKPOINT).exists() else None


def remember_side(out: Path, side: int, memory: int) -> None:
    """Leave what the tiles of a run are, for another one to go on, in the folder of its tiles, which exists.

    side: as given. memory: of a tile's images. Raises WriteError, and CheckpointError as `remembered_side` does.
    """
    # once it is there, a disk that is full is told of by the file that has no room, not by this one
    if remembered_side(out) != (side, memory):
        write_json(out / TILES / LAYOUT, {"side": side, "memory": memory})


def remembered_side(out: Path) -> tuple[int, int] | None:
    """What `remember_side` left; None where no tile has been begun. Raises CheckpointError where it can't be read."""
    path = out / TILES / LAYOUT
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return int(found["side"]), int(found["memory"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path}: can't be read: {error}; begin anew with --restart") from error


def forget(out: Path) -> None:
    """Remove all tiles of a folder of results at once: a run that is killed meanwhile has all or none of them."""
    leaving = out / f"{PARTIAL}{TILES}"
    shutil.rmtree(leaving, ignore_errors=True)  # of a run that was killed
    with suppress(OSError):
        (out / TILES).rename(leaving)
    shutil.rmtree(leaving, ignore_errors=True)
