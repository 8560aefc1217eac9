"""One run at a time in a folder: two would write over each other's checkpoints and results.

The system's lock on a file in the folder ends with the process that holds it, however that ends.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from recon.config.schema import ConfigError

LOCK = ".lock"

# What ends with the command that is running; None outside any.
_command: ContextVar[ExitStack | None] = ContextVar("command", default=None)


class FolderInUseError(ValueError):
    """Another run is writing into a folder: one line with the ways out."""


@contextmanager
def folders_released() -> Iterator[None]:
    """Within this block, `hold` holds folders; at its end they are released."""
    with ExitStack() as stack:
        token = _command.set(stack)
        try:
            yield
        finally:
            _command.reset(token)


def hold(folder: Path) -> None:
    """Keep other runs out of a folder, which exists, until the command ends; outside a command nothing is held.

    A command may hold a folder several times. Raises FolderInUseError where another run holds it, ConfigError where no
    file can be made there.
    """
    stack = _command.get()
    if stack is None:
        return
    lock = FileLock(folder / LOCK, timeout=0, is_singleton=True)
    try:
        lock.acquire()
    except Timeout:
        told = f"{folder}: another run is writing into it; wait for its end, or name another folder"
        raise FolderInUseError(told) from None
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written to: {error.strerror or error}") from error
    stack.callback(_release, lock)


def _release(lock: BaseFileLock) -> None:
    if lock.lock_counter == 1:
        with suppress(OSError):  # some systems don't remove a file that is open
            Path(lock.lock_file).unlink()
    lock.release()
