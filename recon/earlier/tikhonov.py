"""The weak specimen: Δn from a stack by the linear transfer function and a quadratic prior.

To first order in Δn an image is the empty field's plus Σ_z F⁻¹[T·F{Δn(z)}], see `torchdic.linear`. So for each lateral
frequency the least of
    Σ |data − linear image|²/variance + weight·Σ |Δn|²
is the solution of a system with one unknown per slice: the 3-D deconvolution of DIC by its transfer function.

C. Preza, D. L. Snyder and J.-A. Conchello, J. Opt. Soc. Am. A 16, 2185 (1999); T. J. Holmes and W. J. Levy, Appl. Opt.
26, 3929 (1987); A. N. Tikhonov, Soviet Math. Dokl. 4, 1035 (1963).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from recon.earlier.data import check_images, noise_of_prisms
from recon.earlier.weight import Components, Rule, choose_weight
from recon.fit.bounds import Bounds
from recon.fit.newton.weak_hessian import waves_of_columns
from recon.fit.setup import Setup, empty_medium
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Fidelity, Grid
from torchdic.linear import linear_image, transfer_functions
from torchdic.scalar import number

# Bytes that the transfer's sources may take at once. The systems of some rows of frequencies may take a quarter of it.
MEMORY = 1 << 30

# Of the cross-validation. A strong specimen with little noise needs it: there the plain one's Δn is without limit.
_ROBUSTNESS = 0.3

# Steps of the projected gradient, and the change relative to Δn below which it ends.
_STEPS, _STILL = 300, 1e-4

FREE = Bounds(None, None)


@dataclass(frozen=True, eq=False)
class Tikhonov:
    """Δn by the linear transfer.

    delta: Δn (z, y, x), in the data's dtype. weight: of Σ|Δn|². rule: how it was chosen. misfit: of the linear images
    of delta, see `recon.misfit.gaussian.GaussianMisfit`.
    """

    delta: Float[Tensor, "z y x"]
    weight: float
    rule: Rule
    misfit: float


class LinearModel:
    """The linear images of Δn, each divided by its prism's spatial standard deviation, and without the empty field.

    grid: of the volume. transfer: (prism·focus, z, y, x/2 + 1), the frequencies of a real FFT. The other half of them
    is the complex conjugate. memory: bytes that the blocks of some rows of frequencies may take at once.
    """

    def __init__(self, grid: Grid, transfer: Complex[Tensor, "image z y half"], memory: int = MEMORY // 4) -> None:
        self.grid, self.transfer, self.memory = grid, transfer, memory

    def images(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "image y x"]:
        """A·Δn."""
        spectrum = torch.einsum("mzyx,zyx->myx", self.transfer, torch.fft.rfft2(delta))
        return torch.fft.irfft2(spectrum, s=self.grid.shape[1:])

    def adjoint(self, images: Float[Tensor, "image y x"]) -> Float[Tensor, "z y x"]:
        """Aᵀ·images."""
        spectrum = torch.einsum("mzyx,myx->zyx", self.transfer.conj(), torch.fft.rfft2(images))
        return torch.fft.irfft2(spectrum, s=self.grid.shape[1:])

    def counts(self) -> Float[Tensor, " half"]:
        """How many frequencies each column stands for."""
        return waves_of_columns(self.grid.shape[2]).to(self.transfer.device)

    def blocks(
        self, images: Float[Tensor, "image y x"]
    ) -> Iterator[tuple[slice, Complex[Tensor, "y half z z"], Complex[Tensor, "y half z"]]]:
        """AᴴA and Aᴴd of some rows of frequencies after another, complex128: (rows, (y, x/2 + 1, z, z), (…, z))."""
        m, nz, ny, half = self.transfer.shape
        spectrum = torch.fft.rfft2(images.double())
        # A twice, and the products with their eigenvectors and workspace
        each = 16 * half * (2 * m * nz + 4 * nz * nz)
        rows = max(1, self.memory // each)
        for first in range(0, ny, rows):
            part = slice(first, min(first + rows, ny))
            A = self.transfer[:, :, part].permute(2, 3, 0, 1).to(torch.complex128)
            d = spectrum[:, part].permute(1, 2, 0)
            yield part, A.mH @ A, (A.mH @ d[..., None])[..., 0]


@torch.no_grad()
def tikhonov(
    data: Float[Tensor, "prism focus y x"],
    setup: Setup,
    noise: float | Sequence[float] | None,
    bounds: Bounds = FREE,
    sources: int = 40,
    memory: int = MEMORY,
) -> Tikhonov:
    """Δn whose linear images explain the data as closely as the noise allows, with the least Σ|Δn|².

    data: (prism, focus, y, x), relative to the empty bright field, on the volume's pixels.
    setup: the volume gives the grid and the medium; its Δn plays no part.
    noise: standard deviation of the noise in the unit of the data, one for all prisms or one for each; None where it
    is unknown. It sets the weight, see `recon.earlier.weight`.
    bounds: of Δn. The weight is that of the free Δn, and the same sum is then lowered within the bounds, where
    the misfit is higher.
    sources: condenser directions of the transfer function. memory: bytes that its batches of sources may take at once,
    and its systems a quarter of it.

    The images see nothing of each slice's mean: it is 0 where there are no bounds. The transfer function is held
    whole, (prism·focus, z, y, x/2 + 1) complex numbers of the data's precision; the systems are made in parts.

    Raises ValueError for data of another shape than the setup's, camera pixels other than voxels, a prism without a
    linear response (a bias of 0), and as `torchdic.linear.transfer_functions` where none exists.
    """
    volume, microscope, acquisition = setup.volume, setup.microscope, setup.acquisition
    check_images(data, setup)
    misfit = GaussianMisfit(data)
    levels = noise_of_prisms(noise, len(data))
    fidelity = Fidelity("wave", sources=sources, memory=memory)
    scale = misfit.variance.rsqrt()
    model = LinearModel(volume.grid, _weighted_transfer(setup, fidelity, scale), memory // 4)
    empty = linear_image(empty_medium(volume.grid, number(volume.background), data), microscope, acquisition, fidelity)
    d = (scale * (data - empty)).flatten(0, 1)
    components = _components(model, d)
    target = None if levels is None else misfit.of_noise(levels)
    weight, rule = choose_weight(components, target, robustness=_ROBUSTNESS)
    delta = _solved(model, d, weight)
    if bounds != FREE:
        steepest = float(components.values.max())
        delta = _within(model, d, weight, delta, bounds, steepest)
    left = float((model.images(delta) - d).double().square().mean())
    return Tikhonov(delta, weight, rule, left)


def _weighted_transfer(setup: Setup, fidelity: Fidelity, scale: Tensor) -> Complex[Tensor, "image z y half"]:
    """The transfer of every image times its prism's scale, for the frequencies of a real FFT."""
    volume, microscope, acquisition = setup.volume, setup.microscope, setup.acquisition
    grid = volume.grid
    transfer = transfer_functions(
        grid, microscope, acquisition, number(volume.background), fidelity, dtype=scale.dtype, device=scale.device
    )
    # a slice scatters k0·dz per Δn at most, before the prism
    rounding = 8 * torch.finfo(scale.dtype).eps * 2 * math.pi / microscope.wavelength * grid.spacing[0]
    for i, strongest in enumerate(transfer.abs().amax((1, 2, 3, 4)).tolist()):
        if strongest <= rounding:
            prism = acquisition.prisms[i]
            which = "bright field" if prism is None else f"bias {number(prism.bias):g}"
            raise ValueError(
                f"prism {i + 1} ({which}) has no linear response: its images don't change to first order in Δn, as "
                "without bias; leave them out"
            )
    transfer.mul_(scale[..., None])
    return transfer[..., : grid.shape[2] // 2 + 1].flatten(0, 1)


def _components(model: LinearModel, d: Float[Tensor, "image y x"]) -> Components:
    """The problem's components, of every lateral frequency and every eigenvector along z."""
    values, energies = [], []
    for _, normal, right in model.blocks(d):
        s, V = torch.linalg.eigh(normal)
        c = (V.mH @ right[..., None])[..., 0]
        least = torch.finfo(torch.float64).eps * s.amax(-1, keepdim=True) * s.shape[-1]
        values.append(torch.where(s > least, s, 0))
        energies.append(torch.where(s > least, (c.real.square() + c.imag.square()) / torch.where(s > least, s, 1), 0))
    counts = model.counts()[:, None]
    pixels = d[0].numel()
    # Parseval: sums over frequencies are `pixels` times those over pixels
    total = float(d.double().square().sum())
    return Components.of(torch.cat(values), torch.cat(energies) / pixels, counts, total, d.numel())


def _solved(model: LinearModel, d: Float[Tensor, "image y x"], weight: float) -> Float[Tensor, "z y x"]:
    """The least of the sum without bounds."""
    if math.isinf(weight):
        return d.new_zeros(model.grid.shape)
    nz, ny, nx = model.grid.shape
    spectrum = torch.empty(nz, ny, nx // 2 + 1, dtype=torch.complex128, device=d.device)
    for rows, normal, right in model.blocks(d):
        normal.diagonal(dim1=-2, dim2=-1).add_(weight)
        factor = torch.linalg.cholesky(normal)
        spectrum[:, rows] = torch.cholesky_solve(right[..., None], factor)[..., 0].movedim(-1, 0)
    return torch.fft.irfft2(spectrum, s=(ny, nx)).to(d.dtype)


def _within(
    model: LinearModel, d: Tensor, weight: float, start: Float[Tensor, "z y x"], bounds: Bounds, steepest: float
) -> Float[Tensor, "z y x"]:
    """The least of the sum within bounds, by the accelerated projected gradient, begun anew where it turns uphill.

    steepest: greatest eigenvalue of AᵀA. A. Beck and M. Teboulle, SIAM J. Imaging Sci. 2, 183 (2009); B. O'Donoghue
    and E. Candès, Found. Comput. Math. 15, 715 (2015), for beginning anew.
    """
    x = bounds.clamped(start)
    if math.isinf(weight):
        return x
    ahead, momentum = x, 1.0
    for _ in range(_STEPS):
        gradient = model.adjoint(model.images(ahead) - d) + weight * ahead
        moved = bounds.clamped(ahead - gradient / (steepest + weight))
        if float(((ahead - moved) * (moved - x)).sum()) > 0:
            momentum = 1.0
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        change = moved - x
        ahead, x, momentum = moved + (momentum - 1) / following * change, moved, following
        if float(change.norm()) <= _STILL * float(x.norm()):
            break
    return x
