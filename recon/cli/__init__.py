"""The command line: `main` runs what the user typed after `torchdic`."""

import os
import sys
from collections.abc import Sequence

# This must come before torch is imported. Between operations the threads of torch (GNU's OpenMP) wait by spinning, by
# default for so long that on a machine with other work they keep each other from running. Here they spin for
# microseconds and then sleep. Without any spinning they would have to be woken for each operation, which takes longer
# than many operations do (benchmarks/threads.py).
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

INTERRUPTED = 130


def main(typed: Sequence[str] | None = None) -> int:
    """Run a command; see `recon.cli.commands.main`.

    typed: the words after `torchdic`; None takes them from the command line. Returns the exit code.
    """
    try:
        # torch takes seconds, in which the user may already want to stop
        from recon.cli.commands import main as run
    except KeyboardInterrupt:
        print("torchdic: error: interrupted", file=sys.stderr)
        return INTERRUPTED
    return run(typed)
