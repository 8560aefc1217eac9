"""`python -m torchdic`: the command torchdic, which is recon's. Nothing else here knows of recon."""

import runpy

if __name__ == "__main__":
    runpy.run_module("recon", run_name="__main__")
