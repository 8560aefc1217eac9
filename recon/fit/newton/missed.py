"""What few condenser directions miss of a weak specimen's images, to first order in Δn.

A `Correction` holds for one volume. A step changes the volume, and what few directions don't see of that change, or see
though no light shows it, the noise of a dim stack fills: at lateral frequencies to which few directions respond more
than many do, the fit makes noise a part of the specimen. For a weak specimen the difference is linear, and known: that
of the transfer functions (`torchdic.linear`). How far a specimen is weak, its images tell: a share is believed, that
by which the linear difference comes nearest to the true one.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.fit.newton.weak_hessian import weak_responses
from recon.fit.setup import Setup
from torchdic import Fidelity


class MissedResponse:
    """The images of many directions minus those of few, of a weak specimen.

    setup: of which the weak specimen is one; its volume's Δn plays no part. draft, careful: the fidelities with few and
    many directions. The rest of them is alike.
    """

    def __init__(self, setup: Setup, draft: Fidelity, careful: Fidelity) -> None:
        like = setup.volume.delta
        many, few = (weak_responses(setup, replace(draft, sources=f.sources), like) for f in (careful, draft))
        prisms, planes, _, ny, half = many.shape
        # one matrix for each lateral frequency, (image, slice)
        self._matrix = (many - few).permute(3, 4, 0, 1, 2).reshape(ny, half, prisms * planes, -1).contiguous()
        self._images = prisms, planes

    @staticmethod
    def bytes_for(setup: Setup, element: int) -> int:
        """Bytes that it takes while it is made. element: those of a real number."""
        prisms, planes = len(setup.acquisition.prisms), len(setup.acquisition.focus)
        nz, ny, nx = setup.volume.grid.shape
        return 2 * 3 * element * prisms * planes * nz * ny * nx

    def __call__(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "prism focus y x"]:
        """The difference of the images, relative to the empty bright field, on the volume's pixels; differentiable."""
        waves = torch.fft.rfft2(delta).permute(1, 2, 0)[..., None]
        images = (self._matrix @ waves)[..., 0].permute(2, 0, 1)
        return torch.fft.irfft2(images, s=delta.shape[1:]).unflatten(0, self._images)


def share_of(linear: Tensor, true: Tensor) -> float:
    """The share of a linear difference that comes nearest to the true one by least squares, from 0 to 1."""
    power = float(linear.square().sum())
    return min(max(float((linear * true).sum()) / power, 0.0), 1.0) if power > 0 else 0.0
