"""The command line: `main` runs what the user typed after `torchdic`."""

import os

# This must come before torch is imported. Between operations the threads of torch (GNU's OpenMP) wait by spinning, by
# default for so long that on a machine with other work they keep each other from running. Here they spin for
# microseconds and then sleep. Without any spinning they would have to be woken for each operation, which takes longer
# than many operations do (benchmarks/threads.py).
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from recon.cli.commands import main

__all__ = ["main"]
