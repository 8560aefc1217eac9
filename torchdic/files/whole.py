"""Files that appear complete or not at all: an error or an interruption leaves no half a file."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# What a file's name begins with until it is complete; a process that is killed leaves such files.
PARTIAL = ".partial-"


class WriteError(OSError):
    """A file can't be written: one line with the file and the reason."""

    @classmethod
    def of(cls, path: Path, error: OSError) -> "WriteError":
        """The error for a file, made of one that names another file, or none."""
        # numpy and others tell no reason where a disk is full, only how many bytes they wrote
        return cls(error.errno, error.strerror or f"{error}; the disk may be full", str(path))

    def __str__(self) -> str:
        return f"{self.filename}: cannot be written: {self.strerror}"


@contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path beside `path` to write to, and move that file to `path` when the block ends.

    If the block raises, the temporary file is removed and `path` stays as it was. The temporary file has the suffix of
    `path`, because writers choose their format by it. Raises WriteError, which is an OSError, where the folder cannot
    be written to, or where the block raises an OSError, as it does where the disk is full.
    """
    path = Path(path)
    try:
        with _moved_there(path) as partial:
            yield partial
    except OSError as error:
        raise WriteError.of(path, error) from error


@contextmanager
def folder_written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """As `written_whole`, for a folder: give an empty one beside `path`, which takes its place when the block ends."""
    path = Path(path)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=PARTIAL, ignore_cleanup_errors=True) as beside:
            partial, earlier = Path(beside) / path.name, Path(beside) / "earlier"
            partial.mkdir()
            yield partial
            if path.exists():
                path.rename(earlier)
            try:
                partial.rename(path)
            except OSError:
                if earlier.exists():
                    earlier.rename(path)
                raise
    except OSError as error:
        raise WriteError.of(path, error) from error


@contextmanager
def _moved_there(path: Path) -> Iterator[Path]:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=PARTIAL, suffix=path.suffix)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o666 & ~_umask())  # mkstemp lets only the owner read its files
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove what processes that were killed have left half written in a folder. Raises OSError where it can't be."""
    for left in folder.glob(f"{PARTIAL}*"):
        if left.is_dir():
            shutil.rmtree(left)
        else:
            left.unlink()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8. An error leaves `path` as it was. Raises WriteError."""
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | os.PathLike[str], values: object) -> None:
    """Write values as JSON, indented by two spaces. An error leaves `path` as it was. Raises WriteError."""
    write_text(path, json.dumps(values, indent=2) + "\n")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
