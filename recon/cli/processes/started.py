"""Processes that a command starts itself, and that compute with it: what `--processes` asks for."""

import multiprocessing
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

import torch

from recon.cli.exit_codes import FAILED, INTERRUPTED
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
    torch.set_num_threads(max(1, torch.get_num_threads() // processes))
    if sys.platform in LOOPBACK:
        os.environ.setdefault(NETWORK, LOOPBACK[sys.platform])
    try:
        with tempfile.TemporaryDirectory(prefix="torchdic-") as folder:
            method = f"{Path(folder).as_uri()}/store"
            with _others(processes, method) as ready:
                for number, told in enumerate(ready, 1):
                    try:
                        told.recv()
                    except EOFError:
                        fail(f"--processes {processes}: process {number} ended before it could compute")
                        return FAILED
                return take_part(ProcessPlace(0, processes, 0, processes), command, method)
    except KeyboardInterrupt:  # before the command has begun, which answers to it itself
        fail("interrupted")
        return INTERRUPTED


@contextmanager
def _others(processes: int, method: str) -> Iterator[list[Connection]]:
    """Within this block all processes but the first run, each of which says through its connection when it is ready."""
    spawn = multiprocessing.get_context("spawn")
    started: list[BaseProcess] = []
    ready: list[Connection] = []
    threads = torch.get_num_threads()
    try:
        with _interrupts_later():
            for number in range(1, processes):
                receiver, sender = spawn.Pipe(duplex=False)
                place = ProcessPlace(number, processes, number, processes)
                one = spawn.Process(target=_compute, args=(place, method, threads, sender), daemon=True)
                one.start()
                sender.close()  # so that the connection ends with the process
                started.append(one)
                ready.append(receiver)
        yield ready
        for one in started:
            one.join(PATIENCE)
    finally:
        for one in started:
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
