"""A folder of results whose every value is known, without a fit: for the tests of its report."""

import json

import numpy as np
import torch

from torchdic import Grid
from torchdic.files.stack import write_stack, write_volume

GRID = Grid((5, 12, 16), (0.5, 0.25, 0.2))
FOCUS, PRISMS = (-1.0, 0.0, 1.0), 2
NOISE = 0.01
VERDICT = {
    "ratio": 1.02,
    "white": 1.0,
    "explained": 0.99,
    "poor": False,
    "causes": [],
    "words": "misfit 0.1 is 1.020 × what noise leaves (0.098): the volume explains the stack; Δn's sign is free",
}
METRICS = {
    "method": "newton",
    "propagation": "wave",
    "misfit": 0.1,
    "noise_misfit": 0.098,
    "residual_rms": [0.01, 0.01],
    "steps": 2,
    "seconds": 75.0,
    "learned": {"brightness": [[1.0, 1.01, 1.02], [0.99, 1.0, 1.0]]},
    "prisms": [{"noise": NOISE, "background": 0.5, "flicker": 0.01, "unevenness": 0.0}] * 2,
    "verdict": VERDICT,
    "seen": {"share": 0.3, "lacks": None},
}
CONFIG = """
[volume]
background = 1.335
[microscope]
wavelength = 0.5
objective = { na = 0.9 }
condenser = { na = 0.6 }
[acquisition]
focus = [-1.0, 0.0, 1.0]
prisms = [{ shear = [0.0, 0.2], bias = 1.5707963267948966 }, "brightfield"]
"""
RUN = {
    "reconstruct": {"command": "torchdic reconstruct run.toml", "seconds": 80.0, "peak_bytes": 3.1e8, "device": "cpu"}
}


def volume() -> torch.Tensor:
    """Δn that differs at every voxel, and along every axis."""
    z, y, x = torch.meshgrid(*(torch.arange(n) for n in GRID.shape), indexing="ij")
    return (0.01 * z + 0.0005 * y + 0.00003 * x * x).float()


def images() -> tuple[np.ndarray, np.ndarray]:
    """Measured and modelled images (prism, focus, y, x), no two alike."""
    random = np.random.default_rng(0)
    p, f, y, x = np.meshgrid(*(np.arange(n) for n in (PRISMS, len(FOCUS), *GRID.shape[1:])), indexing="ij")
    modelled = (0.5 + 0.05 * p + 0.01 * f + 0.002 * y - 0.003 * x).astype(np.float32)
    return modelled + NOISE * random.standard_normal(modelled.shape).astype(np.float32), modelled


def leave_results(out) -> None:
    """Leave what a reconstruction leaves, with the values above."""
    write_volume(out / "volume.ome.tif", volume(), GRID)
    measured, modelled = images()
    pairs = np.stack([measured, modelled], 1).reshape(-1, *measured.shape[1:])
    write_stack(out / "images.ome.tif", pairs, GRID.spacing[1:], 1.0)
    for name, values in (("metrics.json", METRICS), ("run.json", RUN)):
        (out / name).write_text(json.dumps(values), encoding="utf-8")
    (out / "config.resolved.toml").write_text(CONFIG, encoding="utf-8")
    (out / "log.csv").write_text("step,misfit,loss,seconds\n1,1.0,1.1,0.5\n2,0.1,0.2,0.5\n", encoding="utf-8")
