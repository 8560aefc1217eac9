"""Signals that stop a run: none of them is lost."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any


class InterruptedRunError(Exception):
    """The user stopped a descent; the message says how to go on."""


@contextmanager
def signals_kept() -> Iterator[Callable[[], None]]:
    """Within this block SIGINT and SIGTERM are remembered; yields a check that raises KeyboardInterrupt after one.

    The check is needed because Python ignores a KeyboardInterrupt that is raised in a destructor. The signals' handlers
    run as they did, and are put back at the end of the block.
    """
    received: list[int] = []

    def check() -> None:
        if received:
            raise KeyboardInterrupt

    def keeping(handler: Callable[[int, FrameType | None], Any]) -> Callable[[int, FrameType | None], None]:
        def keep(number: int, frame: FrameType | None) -> None:
            received.append(number)
            handler(number, frame)

        return keep

    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    main = threading.current_thread() is threading.main_thread()  # the only one that may set handlers
    handlers = {number: handler for number, handler in found.items() if main and callable(handler)}
    for number, handler in handlers.items():
        signal.signal(number, keeping(handler))
    try:
        yield check
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
