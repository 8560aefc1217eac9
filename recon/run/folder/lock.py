"""One run at a time in a folder: two would write over each other's checkpoints and results.

The system's lock on a file in the folder ends with the process that holds it, however that ends.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from recon.config.schema import ConfigError
from torchdic.files.whole import remove_partial

LOCK = ".lock"


@dataclass(frozen=True)
class _Command:
    """The command that is running. ending: what ends with it. held: of each folder that it holds the lock's inode."""

    ending: ExitStack
    held: dict[Path, int] = field(default_factory=dict)


# None outside any.
_command: ContextVar[_Command | None] = ContextVar("command", default=None)


class FolderInUseError(ValueError):
    """Another run is writing into a folder: one line with the ways out."""


@contextmanager
def folders_released() -> Iterator[None]:
    """Within this block, `hold` holds folders; at its end they are released."""
    with ExitStack() as stack:
        token = _command.set(_Command(stack))
        try:
            yield
        finally:
            _command.reset(token)


def hold(folder: Path) -> None:
    """Keep other runs out of a folder, which exists, until the command ends; outside a command nothing is held.

    What runs that were killed have left half written there is removed. A command may hold a folder several times, and
    holds it anew where it was removed in between. Raises FolderInUseError where another run holds it, ConfigError where
    no file can be made there.
    """
    command = _command.get()
    if command is None:
        return
    lock = FileLock(folder / LOCK, timeout=0, is_singleton=True)
    try:
        if is_lost(folder):
            lock.release(force=True)
        lock.acquire()
        command.held[folder] = Path(lock.lock_file).stat().st_ino
        remove_partial(folder)
    except Timeout:
        told = f"{folder}: another run is writing into it; wait for its end, or name another folder"
        raise FolderInUseError(told) from None
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written to: {error.strerror or error}") from error
    command.ending.callback(_release, lock)


def is_lost(folder: Path) -> bool:
    """Whether a folder that the command holds was removed since; another run may have made it anew."""
    command = _command.get()
    if command is None or folder not in command.held:
        return False
    try:
        return (folder / LOCK).stat().st_ino != command.held[folder]  # the lock's inode is taken while it is held
    except OSError:
        return True


def held_folder(folder: Path) -> Path:
    """The folder that the command holds and in which a folder is; itself where there is none."""
    command = _command.get()
    held = {} if command is None else command.held
    return next((above for above in (folder, *folder.parents) if above in held), folder)


def when_done(last: Callable[[], None]) -> None:
    """Do something when the command ends without an error, with its folders still held; outside a command at once."""
    command = _command.get()
    if command is None:
        last()
        return

    def leave(kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            last()

    command.ending.push(leave)


def _release(lock: BaseFileLock) -> None:
    if lock.lock_counter == 1:
        with suppress(OSError):  # some systems don't remove a file that is open
            Path(lock.lock_file).unlink()
    lock.release()
