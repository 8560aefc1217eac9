"""Turned copies of a specimen: as likely as itself, with other parts of it where the images see less."""

import numpy as np
import torch
from jaxtyping import Float, Num
from scipy.ndimage import affine_transform, center_of_mass
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchdic import Grid

# The first copies are turned by a right angle about x, y and z, so that each axis comes to lie along each other one.
RIGHT = ("x", "y", "z")


def turn(number: int) -> Rotation:
    """A copy's rotation, of vectors (x, y, z): right angles first, then any at random. number: of the copy, from 0."""
    if number < len(RIGHT):
        return Rotation.from_euler(RIGHT[number], 90, degrees=True)
    return Rotation.from_quat(np.random.default_rng(number).normal(size=4))  # of equal chance in all directions


def middle(delta: Float[Tensor, "z y x"]) -> tuple[float, float, float]:
    """The |Δn|-weighted mean place of a volume, in voxels (z, y, x); the volume's centre where it is empty."""
    weight = delta.abs().double().cpu().numpy()
    z, y, x = np.array(center_of_mass(weight if weight.any() else np.ones_like(weight))).tolist()
    return z, y, x


def turned(
    values: Num[Tensor, "z y x"], grid: Grid, about: tuple[float, float, float], rotation: Rotation, order: int = 1
) -> Num[Tensor, "z y x"]:
    """A volume turned about a place, which comes to lie at the volume's centre; 0 where nothing was.

    about: in voxels (z, y, x). order: of the spline between voxels; 0 keeps labels as they are.
    """
    spacing = np.array(grid.spacing)
    matrix = np.diag(1 / spacing) @ rotation.as_matrix()[::-1, ::-1] @ np.diag(spacing)
    centre = (np.array(grid.shape) - 1) / 2
    offset = np.array(about) - matrix @ centre
    moved = affine_transform(values.cpu().numpy(), matrix, offset, order=order)
    return torch.from_numpy(moved).to(values)
