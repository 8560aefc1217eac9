"""The thin phase object: the optical path length of each focus section, alone.

Each plane of a stack is taken as the image in focus of a thin phase φ(y, x) = 2π·OPL/λ. Its images give the differences
Δ = φ(x + s/2) − φ(x − s/2) along each shear, see `recon.earlier.phase_difference`. φ is then the least of
    Σ_shears |Δ − difference of φ|²/variance + weight·Σ |∇²φ|² + (noise/σ²)·Σ_border |φ|².
A plain sum of Δ along the shear leaves a streak behind each pixel's noise, because the frequencies across the shear are
not measured at all. A second shear axis measures them. Where there is none, the smoothness and the medium's border,
whose phase is 0, decide. The prior is on the curvature: beside the differences, whose weight grows as f², one on the
slope would reduce the contrast of all frequencies alike.

C. Preza, J. Opt. Soc. Am. A 17, 415 (2000), for several shear axes; M. R. Arnison, K. G. Larkin, C. J. R. Sheppard,
N. I. Smith and C. J. Cogswell, J. Microsc. 214, 7 (2004), for linear phase retrieval from two of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float
from torch import Tensor

from recon.earlier.data import check_images, noise_of_prisms
from recon.earlier.phase_difference import PhaseDifference, phase_differences
from recon.earlier.weight import Components, Rule, choose_weight
from recon.fit.setup import Setup
from torchdic import Grid
from torchdic.scalar import number

# Standard deviations σ in rad of the phase at the border of the field, where the medium alone is expected. The problem
# is solved with one after the other, so that a border on which the specimen lies shows before it is held to 0.
_BORDER_PHASES = (1.0, 0.3, 0.1, 0.03)

# Part of a side that counts as border, on each side.
_BORDER = 1 / 32

# The border's least weight relative to the mean weight of the differences: it fixes what they don't measure.
_LEAST_BORDER = 1e-4

# Steps of conjugate gradients, and the residual relative to the right-hand side at which they end.
_STEPS, _SOLVED = 200, 1e-6


@dataclass(frozen=True, eq=False)
class PathLength:
    """Optical path lengths by the thin phase object.

    opl: (focus, y, x) in µm, relative to the border of each section, in the order of the acquisition's focus.
    delta: Δn (z, y, x), see `spread`. Both have the data's dtype.
    weight: of Σ|∇²φ|², µm⁴, with φ in rad and the variances those of images with a noise of 1. rule: how it was chosen.
    """

    opl: Float[Tensor, "focus y x"]
    delta: Float[Tensor, "z y x"]
    weight: float
    rule: Rule


@torch.no_grad()
def path_length(
    data: Float[Tensor, "prism focus y x"], setup: Setup, noise: float | Sequence[float] | None
) -> PathLength:
    """The optical path length of each section, and a Δn made from it.

    data: (prism, focus, y, x), relative to the empty bright field, on the volume's pixels.
    setup: the volume gives the grid alone.
    noise: standard deviation of the noise in the unit of the data, one for all prisms or one for each; None where it
    is unknown. Its mean square sets the weight, by the counted discrepancy of `recon.earlier.weight`; one
    weight serves all sections.

    The model knows of the microscope the wavelength and the prisms alone: neither the light of other sections, nor the
    pupil, the condenser and the polarisers. The arrays are periodic.

    Raises ValueError for data of another shape than the setup's, for camera pixels other than voxels, and as
    `recon.earlier.phase_difference.phase_differences`.
    """
    check_images(data, setup)
    volume, microscope, acquisition = setup.volume, setup.microscope, setup.acquisition
    levels = noise_of_prisms(noise, len(data))
    variance = None if levels is None else sum(n**2 for n in levels) / len(levels)
    problem = Integration(volume.grid, phase_differences(data, acquisition.prisms))
    components = problem.components()
    weight, rule = choose_weight(components, variance, counted=True)
    if math.isinf(weight):
        phase = torch.zeros_like(problem.differences[0].phase)
    else:
        # the same as the given variance, where the weight is the counted discrepancy's
        phase = problem.solved(weight, components.noise(weight))
    opl = phase * microscope.wavelength / (2 * math.pi)
    delta = spread(opl, [number(focus) for focus in acquisition.focus], volume.grid)
    return PathLength(opl.to(data.dtype), delta.to(data.dtype), weight, rule)


class Integration:
    """The least-squares problem of the phase behind phase differences, for all sections at once.

    grid: its number of slices plays no part. differences: at least one.
    Raises ValueError where no frequency of the grid has a difference.
    """

    def __init__(self, grid: Grid, differences: Sequence[PhaseDifference]) -> None:
        self.differences = differences
        frequencies = grid.frequencies(dtype=torch.float64, device=differences[0].phase.device)
        # at the frequency of 0 a difference shows its bias's error alone
        self.spectra = [torch.fft.fft2(d.phase) for d in differences]
        for spectrum in self.spectra:
            spectrum[..., 0, 0] = 0
        self.transfers = [_difference(frequencies, d.shear) for d in differences]
        squares = [t.abs().square() / d.variance for t, d in zip(self.transfers, differences, strict=True)]
        self.seen = torch.stack(squares).sum(0)
        if float(self.seen.max()) <= torch.finfo(torch.float64).eps:
            shears = ", ".join(f"({y:g}, {x:g})" for y, x in (d.shear for d in differences))
            ny, nx = grid.shape[1:]
            raise ValueError(
                f"shear {shears} µm shows no phase in a field of {ny} × {nx} pixels: all are alike along it"
            )
        self.curvature = (2 * math.pi) ** 4 * frequencies.square().sum(0).square()

    def components(self) -> Components:
        """The problem without its border, with the variable k²φ."""
        sections, ny, nx = self.spectra[0].shape
        safe = torch.where(self.curvature > 0, self.curvature, 1)
        values = torch.where(self.curvature > 0, self.seen / safe, 0)
        right = self.right().abs().square() / safe / (ny * nx)
        least = torch.finfo(torch.float64).eps * values.amax()
        energies = torch.where(values > least, right / torch.where(values > least, values, 1), 0)
        total = sum(
            float(spectrum.abs().square().sum()) / (ny * nx * d.variance)
            for spectrum, d in zip(self.spectra, self.differences, strict=True)
        )
        freedom = len(self.differences) * sections * (ny * nx - 1)
        return Components.of(values, energies, torch.ones_like(values), total, freedom)

    def right(self) -> Complex[Tensor, "focus y x"]:
        """The right-hand side's spectrum, Σ conj(D)·F{Δ}/variance."""
        parts = [
            t.conj() * spectrum / d.variance
            for t, spectrum, d in zip(self.transfers, self.spectra, self.differences, strict=True)
        ]
        return torch.stack(parts).sum(0)

    def solved(self, weight: float, noise: float) -> Float[Tensor, "focus y x"]:
        """The phase in rad, relative to its median at the border.

        noise: variance of an image's noise. Where the specimen reaches the border, the weight of the border falls by
        Cauchy's 1/(1 + (φ/σ)²).
        """
        plain = self.seen + weight * self.curvature
        right = torch.fft.ifft2(self.right()).real
        border = _border(right)
        phase, share = torch.zeros_like(right), border.to(right).expand_as(right)
        for sigma in _BORDER_PHASES:
            pull = max(noise / sigma**2, _LEAST_BORDER * float(self.seen.mean()))
            phase = _conjugate_gradients(plain, pull * share, right, phase)
            phase = phase - phase[:, border].quantile(0.5, -1)[:, None, None]
            share = border / (1 + (phase / sigma).square())
        return phase


def _difference(frequencies: Float[Tensor, "2 y x"], shear: tuple[float, float]) -> Complex[Tensor, "y x"]:
    """The transfer 2i·sin(πf·s) of a difference along the shear, by Fourier interpolation.

    At the highest frequency of an even number of pixels only the part that keeps a real phase real is left.
    """
    transfer = 2j * torch.sin(math.pi * (frequencies[0] * shear[0] + frequencies[1] * shear[1]))
    return (transfer + transfer.flip((0, 1)).roll((1, 1), (0, 1)).conj()) / 2


def _border(sections: Float[Tensor, "focus y x"]) -> Tensor:
    """True at the pixels (y, x) that count as border."""
    ny, nx = sections.shape[1:]
    wide, high = (max(1, int(n * _BORDER)) for n in (nx, ny))
    border = torch.ones(ny, nx, dtype=torch.bool, device=sections.device)
    border[high : ny - high, wide : nx - wide] = False
    return border


def _conjugate_gradients(
    plain: Float[Tensor, "y x"], pull: Float[Tensor, "focus y x"], right: Tensor, start: Tensor
) -> Float[Tensor, "focus y x"]:
    """The solution of F⁻¹{plain·F{φ}} + pull·φ = right of each section, from a start.

    The preconditioner is the same operator with the pull's mean everywhere.
    """

    def filtered(field: Tensor, factor: Tensor) -> Tensor:
        return torch.fft.ifft2(factor * torch.fft.fft2(field)).real

    def inner(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum((1, 2), keepdim=True)

    near = 1 / (plain + pull.mean((1, 2), keepdim=True))
    solution, left = start, right - filtered(start, plain) - pull * start
    enough = _SOLVED**2 * inner(right, right)
    ahead = towards = filtered(left, near)
    slope = inner(left, towards)
    for _ in range(_STEPS):
        if bool((inner(left, left) <= enough).all()):
            break
        turned = filtered(ahead, plain) + pull * ahead
        # a section that is solved exactly has nowhere to go
        step = slope / inner(ahead, turned).clamp_min(torch.finfo(slope.dtype).tiny)
        solution, left = solution + step * ahead, left - step * turned
        towards = filtered(left, near)
        before, slope = slope, inner(left, towards)
        ahead = towards + slope / before.clamp_min(torch.finfo(slope.dtype).tiny) * ahead
    return solution


def spread(opl: Float[Tensor, "focus y x"], depths: Sequence[float], grid: Grid) -> Float[Tensor, "z y x"]:
    """A Δn (z, y, x) from the optical path lengths of sections, each as if it were the whole volume's.

    opl: µm. depths: of the sections in µm, in any order. Δn(z) is the path length, interpolated linearly between the
    sections and constant beyond them, over the depth of the volume. So ∫Δn dz is the mean path length of the sections.

    A section in focus shows the path through the whole specimen, and fine detail alone fades with the distance from it.
    So Δn over the depth of field λn/NA², a fraction of a cell's thickness, would be as many times too large.
    """
    order = sorted(range(len(depths)), key=depths.__getitem__)
    place = np.array([depths[i] for i in order])
    z = grid.coordinates(0, dtype=torch.float64).numpy()
    # the interpolation of a section that is 1 where all others are 0
    shares = np.stack([np.interp(z, place, one) for one in np.eye(len(order))[np.argsort(order)]], 1)
    return torch.einsum("zf,fyx->zyx", torch.from_numpy(shares / grid.extent[0]).to(opl), opl)
