"""Processes that a command starts itself, and that compute with it: what `--processes` asks for."""

import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch

from recon.cli.exit_codes import BAD_INPUT, FAILED, INTERRUPTED
from recon.cli.processes.together import take_part
from recon.cli.processes.torchrun import ProcessPlace, fail
from torchdic.ranks.signals import ignore_signals

# Seconds that the others have to end in once this process has ended its part.
PATIENCE = 10.0

# By which gloo finds the processes of one machine: a machine's name need not lead to it.
NETWORK, LOOPBACK = "GLOO_SOCKET_IFNAME", {"linux": "lo", "darwin": "lo0"}


def by_several(processes: int, command: Callable[[], int]) -> int:
    """Run a command as the first of so many processes on this machine; returns its exit code.

    The others are started, compute what the command hands out, and end with it. The machine's threads are shared out
    among all of them.
    """
    cores = os.cpu_count() or 1
    if processes > cores:
        words = f"--processes {processes}: this machine has {cores} processors; more processes than these only wait"
        print(f"torchdic: warning: {words}", file=sys.stderr)
    if sys.platform in LOOPBACK:
        os.environ.setdefault(NETWORK, LOOPBACK[sys.platform])
    try:
        folder = tempfile.mkdtemp(prefix="torchdic-")
    except OSError as error:
        fail(f"--processes {processes}: there is no folder for temporary files: {error}")
        return BAD_INPUT
    try:
        with _threads_of_one(processes):
            return _led(processes, command, Path(folder))
    except KeyboardInterrupt:  # before the command has begun, which answers to it itself
        fail("interrupted")
        return INTERRUPTED
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _led(processes: int, command: Callable[[], int], folder: Path) -> int:
    """See `by_several`. folder: by which the processes find each other."""
    method, begun = f"{folder.as_uri()}/store", threading.Event()

    def begin() -> int:
        begun.set()
        return command()

    with _others(processes, method) as others:
        for number, (_, ready) in enumerate(others, 1):
            try:
                ready.recv()
            except EOFError:
                fail(_ended(number, processes))
                return FAILED
        threading.Thread(target=_watch, args=([one for one, _ in others], begun, folder), daemon=True).start()
        return take_part(ProcessPlace(0, processes, 0, processes), begin, method)


def _watch(others: Sequence[BaseProcess], begun: threading.Event, folder: Path) -> None:
    """End all where one of the others ends while they look for each other: the wait for it has no end by itself."""
    gone = wait([one.sentinel for one in others])
    if begun.is_set():  # from then on a lost process is noticed where they compute
        return
    fail(_ended(next(n for n, one in enumerate(others, 1) if one.sentinel in gone), len(others) + 1))
    for one in others:
        one.kill()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(FAILED)


def _ended(number: int, processes: int) -> str:
    return f"--processes {processes}: process {number} ended before it could compute"


@contextmanager
def _threads_of_one(processes: int) -> Iterator[None]:
    """Within this block the process has its share of the machine's threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, before // processes))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _others(processes: int, method: str) -> Iterator[list[tuple[BaseProcess, Connection]]]:
    """Within this block all processes but the first run, each of which says through its connection when it is ready."""
    spawn = multiprocessing.get_context("spawn")
    started: list[tuple[BaseProcess, Connection]] = []
    threads = torch.get_num_threads()
    try:
        with _interrupts_later():
            for number in range(1, processes):
                receiver, sender = spawn.Pipe(duplex=False)
                place = ProcessPlace(number, processes, number, processes)
                one = spawn.Process(target=_compute, args=(place, method, threads, sender), daemon=True)
                one.start()
                sender.close()  # so that the connection ends with the process
                started.append((one, receiver))
        yield started
        for one, _ in started:
            one.join(PATIENCE)
    finally:
        for one, _ in started:
            one.kill()


def _compute(place: ProcessPlace, method: str, threads: int, ready: Connection) -> None:
    """What each of the others does."""
    ignore_signals()  # the terminal sends Ctrl-C to all: the first answers to it
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    torch.set_num_threads(threads)
    ready.send(True)
    sys.exit(take_part(place, _nothing, method))


def _nothing() -> int:
    return 0


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """A Ctrl-C within this block is handled at its end, and not at all by what is started in it, see `_compute`."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # multiprocessing's own, which else is started below and lets signals through
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
