"""One grey image in a PNG, which has no sizes."""

from pathlib import Path

import imagecodecs
import numpy as np

from torchdic.files.arrangement.grey import coloured
from torchdic.files.format import Format, Stack


def _read(path: Path) -> Stack:
    """The image as a stack of one plane. Colours that are all grey are one; transparency is left aside."""
    image = np.asarray(imagecodecs.png_decode(path.read_bytes()))
    if image.ndim == 3:
        colours = image[..., : 1 if image.shape[2] == 2 else 3]  # two samples are grey and its transparency
        if (colours != colours[..., :1]).any():
            raise coloured(path, image.shape[2])
        image = np.ascontiguousarray(colours[..., 0])
    return Stack(image[None, None], source=str(path))


PNG = Format("PNG", (".png",), _read)
