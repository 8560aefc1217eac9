"""`python -m recon`, as torchrun and machines without scripts on their path start it: the command torchdic."""

import sys

from recon.cli import main

if __name__ == "__main__":
    sys.exit(main())
