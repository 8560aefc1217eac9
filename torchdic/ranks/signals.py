"""Signals wait while the ranks compute together, or rank 0 would leave the others in the middle of it."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from torchdic.errors import LostRankError

STOPPING = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def signals_later() -> Iterator[None]:
    """SIGINT and SIGTERM that come within this block are handled at its end.

    Where a rank is lost they are ignored from then on: torchrun sends them to the rest, which ends by itself.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = {number: signal.signal(number, lambda *what: came.append(what)) for number in STOPPING}
    try:
        yield
    except LostRankError:
        ignore_signals()
        raise
    except BaseException:
        _put_back(before, came)
        raise
    _put_back(before, came)


@contextmanager
def signals_raised() -> Iterator[None]:
    """Within this block a rank that ignores signals is interrupted by them, as rank 0 is."""
    before = {number: signal.getsignal(number) for number in STOPPING}
    for number in (number for number, handler in before.items() if handler is signal.SIG_IGN):
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_signals() -> None:
    """Ignore SIGINT and SIGTERM from now on."""
    if threading.current_thread() is threading.main_thread():
        for number in STOPPING:
            signal.signal(number, signal.SIG_IGN)


def _put_back(handlers: dict[signal.Signals, Any], came: list[tuple[int, FrameType | None]]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)
    for number, _ in came:
        os.kill(os.getpid(), number)
