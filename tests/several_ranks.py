"""Several ranks for a test: processes that are forked from it, which costs no imports."""

import faulthandler
import multiprocessing
import os
import sys
import traceback

import torch

from torchdic.ranks.group import Group, joined
from torchdic.ranks.shared import follow, leading

# Seconds after which ranks that wait for each other for ever end, with where they are.
LIMIT = 120


def led(body, ranks, folder):
    """What body() returns on rank 0 of so many, or an assertion that it fails; the others follow.

    folder: for what the ranks leave.
    """
    receiver, sender = multiprocessing.Pipe(duplex=False)

    def run(rank):
        with joined(Group(rank, ranks, rank, ranks), f"file://{folder}/store"):
            if rank > 0:
                follow()
                return
            with leading():
                try:
                    told = True, body()
                except BaseException:
                    told = False, traceback.format_exc()
            sender.send(told)

    codes = forked(run, ranks, folder)
    assert receiver.poll(), (codes, [(folder / f"{rank}.txt").read_text() for rank in range(ranks)])
    fine, told = receiver.recv()
    assert fine, told
    return told


def forked(run, ranks, folder):
    """The exit codes of processes that run(rank), and leave in the folder what they print, in RANK.txt."""

    def process(rank):
        torch.set_num_threads(1)
        with open(folder / f"{rank}.txt", "w") as printed:
            for stream in (1, 2):
                os.dup2(printed.fileno(), stream)
        faulthandler.dump_traceback_later(LIMIT, exit=True, file=sys.__stderr__)
        sys.exit(run(rank))

    fork = multiprocessing.get_context("fork")
    processes = [fork.Process(target=process, args=(rank,)) for rank in range(ranks)]
    for one in processes:
        one.start()
    for one in processes:
        one.join()
    return [one.exitcode for one in processes]
