"""What the earlier models ask of a stack and of its noise."""

import math
from collections.abc import Sequence

from torch import Tensor

from recon.fit.setup import Setup


def check_images(data: Tensor, setup: Setup) -> None:
    """Raise ValueError where the data aren't the setup's images, one value per voxel column, or the setup has more."""
    acquisition, microscope = setup.acquisition, setup.microscope
    for name, value in (("brightness", setup.brightness), ("drift", setup.drift), ("margin", setup.margin or None)):
        if value is not None:
            raise ValueError(f"the setup has a {name}, of which the earlier models know nothing")
    expected = (len(acquisition.prisms), len(acquisition.focus), *setup.volume.grid.shape[1:])
    if tuple(data.shape) != expected:
        raise ValueError(f"the data have shape {tuple(data.shape)}, the acquisition and grid ask for {expected}")
    if microscope.camera is not None and microscope.camera.pixel_size is not None:
        raise ValueError(
            f"camera.pixel_size {microscope.camera.pixel_size} µm: the model's pixels are its volume's voxels"
        )


def noise_of_prisms(noise: float | Sequence[float] | None, prisms: int) -> list[float] | None:
    """The noise's standard deviation in each prism's images; None where it is unknown.

    noise: one for all, or one for each. Raises ValueError where there are more or fewer than prisms, or one is below 0
    or not finite.
    """
    if noise is None:
        return None
    each = [float(noise)] * prisms if isinstance(noise, int | float) else [float(n) for n in noise]
    if len(each) != prisms:
        raise ValueError(f"noise has {len(each)} values for {prisms} prisms: it must be one for all or one for each")
    for value in each:
        if not (0 <= value < math.inf):
            raise ValueError(f"noise {value} must be a standard deviation of at least 0")
    return each
