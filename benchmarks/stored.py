"""The images with a known answer in tests/data, as scenes on which the model can be run."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from comparison import contrast_errors
from data_synthetic import Bead, GaussianBall
from torchdic import Acquisition, Condenser, Grid, Microscope, Objective, Prism, Volume

DATA = Path(__file__).parents[1] / "tests" / "data"
# The solid specimens' images were made on periodic arrays of 256 × 256 pixels and cropped to 128.
PADDING = 64


@dataclass(frozen=True, eq=False)
class Scene:
    """The exact images (prism, focus, y, x) of a specimen, its depth in µm, and how the images were taken."""

    images: Tensor
    specimen: GaussianBall | Bead
    depth: float
    spacing: float
    microscope: Microscope
    acquisition: Acquisition

    def volume(self, slices: int) -> Volume:
        """The specimen in float32, cut into `slices` slices along its depth."""
        ny, nx = self.images.shape[2:]
        grid = Grid((slices, ny, nx), (self.depth / slices, self.spacing, self.spacing))
        return Volume(grid, self.specimen.delta(grid, dtype=torch.float32), self.specimen.background)

    def errors(self, images: Tensor) -> list[float]:
        """The largest error over the prisms at each focus plane."""
        return contrast_errors(images, self.images)


def smooth_ball() -> Scene:
    """A Gaussian ball, σ 2 µm, Δn 0.03 in 1.36; 21 directions."""
    data = load("exact_ball_dic")
    ball = GaussianBall(float(data["sigma"]), float(data["delta_peak"]), float(data["n_medium"]))
    return _solid(data, ball, 18.0)


def sharp_bead() -> Scene:
    """A bead of 10 µm, Δn 0.03 in 1.56; 37 directions."""
    data = load("exact_sphere_dic")
    n0, radius = float(data["n_medium"]), float(data["radius"])
    return _solid(data, Bead(radius, float(data["n_sphere"]) - n0, n0), 2 * radius)


def microscope(data: dict, points: Tensor) -> Microscope:
    """The microscope that took the images, lit from directions of n·sinθ (y, x)."""
    condenser = Condenser(float(points.norm(dim=1).max()), points)
    return Microscope(float(data["wavelength"]), Objective(float(data["na_objective"])), condenser)


def load(name: str) -> dict:
    """The file's arrays by name."""
    with np.load(DATA / f"{name}.npz") as file:
        return {key: file[key] for key in file.files}


def _solid(data: dict, specimen: GaussianBall | Bead, depth: float) -> Scene:
    # the files hold direction cosines
    points = torch.from_numpy(data["source_yx"]) * specimen.background
    prisms = [Prism((float(s[0]), float(s[1])), float(b)) for s, b in zip(data["shear_yx"], data["bias"], strict=True)]
    return Scene(
        torch.from_numpy(data["images"]),
        specimen,
        depth,
        float(data["spacing"]),
        microscope(data, points),
        Acquisition(prisms, [float(f) for f in data["focus"]]),
    )
