"""The start of a reconstruction: the weak specimen whose linear image explains the data."""

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit.base import spatial_variance
from torchdic import Acquisition, Fidelity, Grid, Microscope, Volume
from torchdic.linear import linear_image, transfer_functions

# Tikhonov weight relative to the mean response.
DAMPING = 0.03


@torch.no_grad()
def linear_start(
    data: Float[Tensor, "prism focus y x"],
    grid: Grid,
    background: float | Tensor,
    microscope: Microscope,
    acquisition: Acquisition,
    sources: int = 24,
) -> Float[Tensor, "z y x"]:
    """Δn whose image, to first order in Δn, is closest to the data; 0 where there is no first order, as with bias 0.

    For each lateral frequency a damped least-squares problem with one unknown per slice is solved, with the wave's
    transfer function.
    data: (prism, focus, y, x), relative to the empty bright field. grid: of the volume. background: index of the
    medium. sources: condenser directions of the transfer function.
    """
    fidelity = Fidelity("wave", sources=sources)
    empty = Volume(grid, data.new_zeros(grid.shape), background)
    weights = spatial_variance(data).rsqrt()[:, None, None, None]
    transfer = transfer_functions(
        grid, microscope, acquisition, background, fidelity, dtype=data.dtype, device=data.device
    )
    H = (weights[..., None] * transfer).flatten(0, 1).permute(2, 3, 0, 1)  # (y, x, prism·focus, z)
    deviation = data - linear_image(empty, microscope, acquisition, fidelity)
    d = torch.fft.fft2(weights * deviation).flatten(0, 1).permute(1, 2, 0)[..., None]
    normal = H.mH @ H
    scale = normal.diagonal(dim1=-2, dim2=-1).real.mean().clamp_min(torch.finfo(data.dtype).tiny)
    damped = normal / scale + DAMPING * torch.eye(grid.shape[0], dtype=data.dtype, device=data.device)
    spectrum = torch.linalg.solve(damped, H.mH @ d / scale)[..., 0]
    return torch.fft.ifft2(spectrum.movedim(-1, 0)).real
