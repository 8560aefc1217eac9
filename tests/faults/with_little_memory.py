"""torchdic in a process whose address space may grow by so many MiB.

python with_little_memory.py MIB WORDS…
"""

import resource
import sys
from importlib import import_module
from pathlib import Path

if __name__ == "__main__":
    # what is imported counts as there already
    for command in ("calibrate", "reconstruct", "simulate", "accuracy.plan", "running"):
        import_module(f"recon.cli.{command}")
    from recon.cli import main

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + (int(sys.argv[1]) << 20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    sys.exit(main(sys.argv[2:]))
