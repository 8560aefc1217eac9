"""The inverse of torchdic: refractive-index volumes fitted to DIC stacks.

`recon.descend.descend` is the descent itself, a generator of steps; `recon.run.reconstruct.reconstruct` takes a
configuration and leaves a folder of results. This package never sees the truth: `data_synthetic` is imported by its
command line alone.
"""
