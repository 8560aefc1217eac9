"""A command by several processes: the first runs it, the others compute their parts of what it hands out."""

import os
import sys
import warnings
from collections.abc import Callable

from recon.cli.exit_codes import FAILED
from recon.cli.processes.torchrun import ProcessPlace, fail
from torchdic import LostRankError
from torchdic.ranks.group import Group, joined, tells_of_loss
from torchdic.ranks.shared import follow, leading
from torchdic.ranks.signals import ignore_signals


def take_part(place: ProcessPlace, command: Callable[[], int], method: str = "env://") -> int:
    """Run a command as the process in a place; returns the process's exit code.

    All but the first are silent, and end when the first one does. method: how they find each other, see
    `torchdic.ranks.group.joined`.
    """
    with joined(Group(*place), method):
        if place.rank == 0:
            with leading():
                return command()
        ignore_signals()
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  (until the process ends)
        warnings.simplefilter("ignore")
        try:
            follow()
        except LostRankError as error:
            if tells_of_loss():
                fail(f"{error}; what was saved is kept, go on with --resume")
            return FAILED
        return 0
