"""Where a reconstruction begins: the weak specimen that explains the data linearly."""

import torch
from jaxtyping import Float
from torch import Tensor

from recon.misfit import spatial_variance
from torchdic import Acquisition, Fidelity, Grid, Microscope, Volume, image

# Small enough that the image responds linearly, large enough for float32: 3e-4 · 0.4 µm is 1e-3 rad.
PROBE = 3e-4
# Tikhonov weight relative to the mean response.
DAMPING = 0.03


@torch.no_grad()
def linear_start(
    data: Float[Tensor, "prism focus y x"],
    grid: Grid,
    background: float,
    microscope: Microscope,
    acquisition: Acquisition,
    sources: int = 24,
) -> Float[Tensor, "z y x"]:
    """Δn that the model's own linear response at Δn = 0 finds behind the data.

    The response to one voxel of each slice is computed by the wave rung; then, frequency by frequency, a damped
    least-squares problem of the size of the number of slices is solved.
    """
    fidelity = Fidelity("wave", order=1, sources=sources)
    empty = torch.zeros(grid.shape, dtype=data.dtype, device=data.device)

    def response(delta: Tensor) -> Tensor:
        return image(Volume(grid, delta, background), microscope, acquisition, fidelity)

    background_image = response(empty)
    weights = spatial_variance(data).rsqrt()[:, None, None, None]
    transfers = []
    for z in range(grid.shape[0]):
        probe = empty.clone()
        probe[z, 0, 0] = PROBE
        transfers.append(torch.fft.fft2(weights * (response(probe) - background_image) / PROBE).flatten(0, 1))
    H = torch.stack(transfers, -1).permute(1, 2, 0, 3)  # (y, x, prism·focus, z)
    d = torch.fft.fft2(weights * (data - background_image)).flatten(0, 1).permute(1, 2, 0)[..., None]
    normal = H.mH @ H
    scale = normal.diagonal(dim1=-2, dim2=-1).real.mean()
    damped = normal + DAMPING * scale * torch.eye(grid.shape[0], dtype=data.dtype, device=data.device)
    spectrum = torch.linalg.solve(damped, H.mH @ d)[..., 0]
    return torch.fft.ifft2(spectrum.movedim(-1, 0)).real
