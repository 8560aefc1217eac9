"""The model against images with a known answer, tests/data/*.npz.

    python benchmarks/references.py

- A thin object, imaged by microlith (Mehta & Oldenbourg 2014): largest error, in units of the empty bright field.
- A smooth ball and a sharp bead, whose exact fields are partial waves: rms difference over the image's standard
  deviation at each focus plane. These references were made on periodic arrays of 256 × 256 pixels and cropped to 128,
  so the model is run on as many (`padding`).
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from comparison import header, row, trial
from data_synthetic import Bead, GaussianBall
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image_field

DATA = Path(__file__).parents[1] / "tests" / "data"
PADDING = 64


def main() -> None:
    """Print the tables."""
    thin_object()
    ball = _read("exact_ball_dic")
    smooth = GaussianBall(float(ball["sigma"]), float(ball["delta_peak"]), float(ball["n_medium"]))
    print("\nsmooth ball, σ 2 µm, Δn 0.03 in 1.36, 21 directions to NA 0.6 (float32)\n")
    solid(ball, smooth, 18.0, [("projection", 120), ("rays", 120), ("wave", 18), ("wave", 120)])
    sphere = _read("exact_sphere_dic")
    n0 = float(sphere["n_medium"])
    sharp = Bead(float(sphere["radius"]), float(sphere["n_sphere"]) - n0, n0)
    print("\nsharp bead, 10 µm, Δn 0.03 in 1.56, 37 directions to NA 0.77 (float32)\n")
    solid(sphere, sharp, 10.0, [("projection", 80), ("rays", 80), ("wave", 40), ("wave", 80), ("wave", 160)])


def thin_object() -> None:
    """The largest error over both objects at focus 0, in DIC and in bright field."""
    reference = _read("thin_dic")
    points = torch.from_numpy(reference["source_na_yx"])
    microscope = _microscope(reference, points)
    (ny, nx), dx = reference["object_gauss"].shape, float(reference["spacing"])
    grid = Grid((1, ny, nx), (1.0, dx, dx))
    shear = tuple(float(s) for s in reference["shear_yx"])
    acquisition = Acquisition([Prism((shear[0], shear[1]), float(reference["bias"])), None])
    print("thin object, 437 directions, focus 0: largest error of the empty bright field")
    for name in ("gauss", "asym"):
        transmission = torch.from_numpy(reference[f"object_{name}"])
        dic, bright = image_field(transmission, grid, microscope, acquisition, background=float(reference["n_medium"]))
        at_focus = int(np.flatnonzero(reference["focus_paraxial"] == 0)[0])
        errors = [
            np.abs(ours[0].numpy() - reference[f"{kind}_{name}"][at_focus]).max()
            for kind, ours in (("dic", dic), ("brightfield", bright))
        ]
        print(f"  {name:<6} DIC {errors[0]:.1e}   bright field {errors[1]:.1e}")


def solid(reference: dict, specimen: Bead | GaussianBall, depth: float, trials: list) -> None:
    """A row for each (propagation, slices) through `depth` µm."""
    exact = torch.from_numpy(reference["images"])
    microscope = _microscope(reference, torch.from_numpy(reference["source_yx"]) * specimen.background)
    prisms = [
        Prism((float(s[0]), float(s[1])), float(b))
        for s, b in zip(reference["shear_yx"], reference["bias"], strict=True)
    ]
    focus = [float(f) for f in reference["focus"]]
    dx = float(reference["spacing"])
    print(header(("propagation", "slice"), focus))
    for propagation, slices in trials:
        grid = Grid((slices, exact.shape[2], exact.shape[3]), (depth / slices, dx, dx))
        volume = Volume(grid, specimen.delta(grid, dtype=torch.float32), specimen.background)
        fidelity = Fidelity(propagation, padding=PADDING)
        errors, seconds = trial(volume, microscope, Acquisition(prisms, focus), fidelity, exact)
        print(row((propagation, f"{grid.spacing[0]:.4g} µm"), errors, seconds), flush=True)


def _microscope(reference: dict, points: Tensor) -> Microscope:
    condenser = Condenser(float(points.norm(dim=1).max()), points)
    return Microscope(float(reference["wavelength"]), Objective(float(reference["na_objective"])), condenser)


def _read(name: str) -> dict:
    with np.load(DATA / f"{name}.npz") as file:
        return {key: file[key] for key in file.files}


if __name__ == "__main__":
    main()
