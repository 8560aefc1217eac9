"""The phase behind one DIC image whose optics are unknown."""

import math

from jaxtyping import Float
from torch import Tensor

from recon.earlier.path_length import path_length
from recon.fit.setup import Setup, empty_medium
from torchdic import Acquisition, Grid, Microscope, Prism

# A bias of a quarter wave, where an image is linear in the phase's difference. Another one scales the phase.
_BIAS = math.pi / 2


def phase_of_image(
    image: Float[Tensor, "y x"], direction: tuple[float, float], noise: float | None, aspect: float = 1.0
) -> Float[Tensor, "y x"]:
    """The phase of a thin object whose image this is, float64, on a scale that nobody knows.

    image: flattened, relative to its background. direction: of the shear, (y, x) in lengths, of any length above 0.
    noise: standard deviation of the image's; None is unknown. aspect: a pixel's side along y over that along x.

    Shear and bias scale the phase alone: it is that of a shear of one pixel and a bias of 90°. Its median at the border
    is 0. Along the shear the image is integrated; across it one image shows nothing but what smoothness allows, see
    `recon.earlier.path_length`. Raises ValueError for a direction of length 0.
    """
    length = math.hypot(*direction)
    if length == 0:
        raise ValueError("direction (0, 0) of the shear must have a length above 0")
    level = math.sin(_BIAS / 2) ** 2
    ny, nx = image.shape
    grid = Grid((1, ny, nx), (1.0, aspect, 1.0))
    prism = Prism((direction[0] / length, direction[1] / length), _BIAS)
    data = level * image.double()[None, None]
    # the wavelength is that of a path length of 2π rad
    setup = Setup(empty_medium(grid, 1.0, data), Microscope(2 * math.pi), Acquisition([prism], [0.0]))
    return path_length(data, setup, None if noise is None else level * noise).opl[0]
