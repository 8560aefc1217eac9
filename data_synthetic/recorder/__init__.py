"""Stacks as a camera stores them, with the faults of real ones: specimen, lamp, stage, camera, file, and what is told.

They stand on torchdic's own images, of finer voxels and more directions than a fit uses. So they judge what is done
with a stack, not the model of light: for that the exact fields of `data_synthetic.exact` are.
"""
