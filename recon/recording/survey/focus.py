"""Which plane of a stack is the sharpest."""

import numpy as np
from jaxtyping import Float
from scipy import ndimage

# Pixels over which an image is smoothed before its edges are measured: less noise, and edges all the same.
_SMOOTH = 1.0


def sharpness(images: Float[np.ndarray, "prism focus y x"]) -> Float[np.ndarray, " focus"]:
    """How sharp each plane is: the energy of its edges, relative to that of the sharpest, from 0 to 1.

    images: flattened, of equal brightness, without stuck pixels.

    An edge's energy is its squared curvature (a Laplacian of Gaussian), which defocus lowers most. The energy of the
    noise is the same in all planes, and that of the least sharp plane is subtracted. A specimen of a higher index than
    its medium's gathers light: it is the sharpest some tenths of a µm behind its middle.
    """
    energy = np.array(
        [[float((ndimage.gaussian_laplace(image, _SMOOTH) ** 2).mean()) for image in planes] for planes in images]
    )
    energy = (energy - energy.min(1, keepdims=True)).sum(0)
    highest = float(energy.max())
    return energy / highest if highest > 0 else np.ones_like(energy)


def sharpest_plane(images: Float[np.ndarray, "prism focus y x"]) -> int:
    """The number of the sharpest plane, counted from 0."""
    return int(np.argmax(sharpness(images)))
