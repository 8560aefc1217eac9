"""torchdic, while the clock jumps: every look at it finds it a year later or two years earlier than the one before.

python with_jumping_clock.py WORDS…
"""

import itertools
import sys
import time

YEAR = 365.25 * 86400
jumps = itertools.accumulate(itertools.cycle((YEAR, -2 * YEAR)))
now, now_ns = time.time, time.time_ns


if __name__ == "__main__":
    # before anything imports them
    time.time = lambda: now() + next(jumps)
    time.time_ns = lambda: now_ns() + int(next(jumps) * 1e9)
    from recon.cli import main

    sys.exit(main(sys.argv[1:]))
