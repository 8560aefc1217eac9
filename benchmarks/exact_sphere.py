"""The three propagations against the exact field of a sharp bead: tests/data/exact_sphere_dic.npz.

    python benchmarks/exact_sphere.py

A 10 µm bead of index 1.59 in 1.56, 37 condenser directions, NA 0.9; the error is the rms difference over the image's
standard deviation, at each focus plane. The reference was made on a periodic array of 256 × 256 pixels and cropped, so
the model is run on the same and cropped too (`padding`).
"""

import time
from pathlib import Path

import numpy as np
import torch

from data_synthetic import Bead
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

REFERENCE = Path(__file__).parents[1] / "tests" / "data" / "exact_sphere_dic.npz"


def main() -> None:
    """Print a row for each propagation."""
    with np.load(REFERENCE) as file:
        reference = {key: file[key] for key in file.files}
    exact, n0 = torch.from_numpy(reference["images"]), float(reference["n_medium"])
    points = torch.from_numpy(reference["source_yx"]) * n0
    microscope = Microscope(
        float(reference["wavelength"]),
        Objective(float(reference["na_objective"])),
        Condenser(float(points.norm(dim=1).max()), points),
    )
    prisms = [Prism(tuple(s), float(b)) for s, b in zip(reference["shear_yx"], reference["bias"], strict=True)]
    focus = [float(f) for f in reference["focus"]]
    bead = Bead(float(reference["radius"]), float(reference["n_sphere"]) - n0, n0)
    dx = float(reference["spacing"])
    print("propagation   slab/µm   " + "  ".join(f"z={f:+.0f} µm" for f in focus) + "   seconds")
    for fidelity, slices in (
        (Fidelity("projection", padding=64), 80),
        (Fidelity("rays", padding=64), 80),
        (Fidelity("wave", padding=64), 40),
        (Fidelity("wave", padding=64), 80),
        (Fidelity("wave", padding=64), 160),
    ):
        grid = Grid((slices, 128, 128), (2 * bead.radius / slices, dx, dx))
        volume = Volume(grid, bead.delta(grid, dtype=torch.float32), n0)
        start = time.perf_counter()
        with torch.no_grad():
            images = image(volume, microscope, Acquisition(prisms, focus), fidelity)
        seconds = time.perf_counter() - start
        errors = ((images - exact).square().mean((2, 3)).sqrt() / exact.std((2, 3))).amax(0)
        row = "  ".join(f"{e:8.4f}" for e in errors.tolist())
        print(f"{fidelity.propagation:<14}{grid.spacing[0]:<10.4g}{row}   {seconds:7.1f}", flush=True)


if __name__ == "__main__":
    main()
