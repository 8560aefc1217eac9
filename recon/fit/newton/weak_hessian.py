"""The misfit's curvature as a weak specimen has it: one matrix of depths for each lateral frequency.

To first order in Δn an image is Σ_z F⁻¹[T(f; z_f − z)·F{Δn(z)}] (`torchdic.linear`), so that with a weight c for each
image the Hessian of the misfit is, for each frequency f, the matrix A(z, z') = Σ c·conj(T(z))·T(z'). It is kept for
cosines along z instead of slices (the DCT-II), for two reasons. Light sees no faster change along z than the difference
of its axial frequencies, so a matrix of the lowest cosines holds all of A but its noise. And the differences along z,
which the priors need, are diagonal in cosines.

A camera's pixels that aren't voxels pass sinc(f·side) of each wave along y and x. Pixels coarser than half a wave also
mix waves that look alike on them, which the matrices leave out: a descent's secants and its true gradient hold that.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from recon.fit.setup import Setup
from torchdic import Acquisition, Fidelity, Microscope
from torchdic.linear import transfer_functions
from torchdic.scalar import number

# Added to the diagonal: this share of its mean. It holds what no image shows.
DAMPING = 0.01

# Cosines beyond the band limit that are kept: the volume's faces make every wave a little wider.
BEYOND = 3

# Planes of focus whose responses are made at once. Each alone would ask for the phases of all slices again; more are no
# faster.
AT_ONCE = 8
# Arrays of a response's size that are held while it is made.
ARRAYS = 4

# Amplitude of the empty field, relative to the brightest, below which a prism is dark.
DARK = 1e-4

# An inverse: the matrices of the lowest cosines, and the reciprocals of the others' diagonals.
Inverse = tuple[Complex[Tensor, "y half low low"], Float[Tensor, "y half high"]]


def weak_responses(setup: Setup, fidelity: Fidelity, like: Tensor) -> Complex[Tensor, "prism focus z y half"]:
    """The images' responses on voxels to each slice of a weak specimen, at the frequencies of a real FFT.

    setup: of which the weak specimen is one; its volume's Δn plays no part. like: gives the dtype and the device.
    """
    volume, microscope = setup.volume, replace(setup.microscope, camera=None)
    given = {"dtype": like.dtype, "device": like.device}
    T = transfer_functions(volume.grid, microscope, setup.acquisition, number(volume.background), fidelity, **given)
    return T[..., : volume.grid.shape[2] // 2 + 1]


def weak_curvature(
    setup: Setup, weights: Float[Tensor, "prism focus"], fidelity: Fidelity, kept: int, memory: int
) -> tuple[Complex[Tensor, "y half low low"], Float[Tensor, "y half high"]]:
    """Σ weight·conj(T)·T over the images: matrices of the lowest cosines along z, and the others' diagonals.

    setup, fidelity: as for `weak_responses`; a camera's pixels count. weights: of each image. kept: number of cosines
    that share a matrix. memory: bytes that responses may hold, if those of one plane hold no more.
    """
    grid, acquisition = setup.volume.grid, setup.acquisition
    along_z = cosines(grid.shape[0]).to(weights)
    matrix = weights.new_zeros(grid.shape[1], grid.shape[2] // 2 + 1, kept, kept).to(weights.dtype.to_complex())
    beyond = weights.new_zeros(*matrix.shape[:2], grid.shape[0] - kept)
    each = ARRAYS * weights.element_size() * 2 * len(acquisition.prisms) * math.prod(grid.shape)
    planes = max(1, min(AT_ONCE, memory // each))
    for first in range(0, len(acquisition.focus), planes):
        few = Acquisition(acquisition.prisms, acquisition.focus[first : first + planes])
        T = weak_responses(replace(setup, acquisition=few, brightness=None, drift=None), fidelity, weights)
        T = T * weights[:, first : first + planes].sqrt()[..., None, None, None]
        camera = setup.microscope.camera
        if camera is not None and not setup.sees_voxels:
            T = T * camera.passed(grid.shape[1:], grid.spacing[1:], weights.dtype).to(weights.device)
        T = T.flatten(0, 1).permute(2, 3, 0, 1) @ along_z.mT.to(T.dtype)
        low = T[..., :kept]
        matrix += low.mH @ low
        beyond += T[..., kept:].abs().square().sum(2)
    return matrix, beyond


class WeakHessian:
    """The Hessian of a misfit times the number of voxels, for the means that the priors are.

    setup: of which the weak specimen is one; its volume's Δn plays no part. weights: of each image (prism, focus), the
    misfit's curvature by one of its pixels times the number of voxels. fidelity: its sources and steps count, and
    should be those of the images, because others respond otherwise. memory: bytes that the matrices may take; with less
    than all take, fewer cosines share a matrix, and the others keep their diagonal.
    """

    def __init__(self, setup: Setup, weights: Float[Tensor, "prism focus"], fidelity: Fidelity, memory: int) -> None:
        grid = setup.volume.grid
        self._sides = grid.shape[1:]
        self._cosines = cosines(grid.shape[0]).to(weights)
        frequencies = grid.shape[1] * (grid.shape[2] // 2 + 1)
        each = 3 * frequencies * weights.element_size() * 2  # a matrix's entry, its inverse, and one to invert it
        self.kept = max(1, min(grid.shape[0], axial_band(setup), math.isqrt(memory // each)))
        matrix, beyond = weak_curvature(setup, weights, fidelity, self.kept, memory)
        power = matrix.diagonal(dim1=-2, dim2=-1).real.sum() + beyond.sum()
        # of a field so small that it holds no frequency that passes, any curvature will do: no image moves it
        self.mean = float(power) / (frequencies * grid.shape[0]) or 1.0
        self._matrix, self._beyond = matrix, beyond + DAMPING * self.mean
        matrix.diagonal(dim1=-2, dim2=-1).add_(DAMPING * self.mean)
        self._differences = squared_differences(grid.shape, grid.spacing[2] / grid.spacing[0]).to(weights)

    def spectrum(self, delta: Float[Tensor, "z y x"]) -> Complex[Tensor, "y half cosine"]:
        """Δn in cosines along z and waves along y and x; orthonormal."""
        waves = torch.fft.rfft2(torch.tensordot(self._cosines, delta, 1), norm="ortho")
        return waves.permute(1, 2, 0).contiguous()

    def volume(self, spectrum: Complex[Tensor, "y half cosine"]) -> Float[Tensor, "z y x"]:
        """The inverse of `spectrum`."""
        waves = torch.fft.irfft2(spectrum.permute(2, 0, 1), s=self._sides, norm="ortho")
        return torch.tensordot(self._cosines.mT, waves, 1)

    def __call__(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """The Hessian times a volume."""
        return self._times((self._matrix, self._beyond), delta)

    def inverse(self, differences: float, constant: float) -> Inverse:
        """The inverse of the Hessian + differences·DᵀD + constant, for `solved`; D are the `forward_differences`."""
        more = differences * self._differences + constant
        matrix = self._matrix.clone()
        matrix.diagonal(dim1=-2, dim2=-1).add_(more[..., : self.kept])
        return torch.linalg.inv(matrix), 1 / (self._beyond + more[..., self.kept :])

    def solved(self, inverse: Inverse, right: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """An inverse times a volume."""
        return self._times(inverse, right)

    def _times(self, operator: Inverse, delta: Tensor) -> Tensor:
        S = self.spectrum(delta)
        low = (operator[0] @ S[..., : self.kept, None])[..., 0]
        return self.volume(torch.cat([low, operator[1] * S[..., self.kept :]], -1))


def check_linear_response(microscope: Microscope, acquisition: Acquisition) -> None:
    """Raise ValueError where the images have no response to a weak specimen, or none of which a Hessian is made."""
    lacking = lacks_of_linear_response(microscope, acquisition)
    if lacking is not None:
        raise ValueError(f"Newton's method needs {lacking}; use method 'adam'")


def lacks_of_linear_response(microscope: Microscope, acquisition: Acquisition, *, dark: bool = False) -> str | None:
    """What the images lack of a weak specimen's response that a transfer function describes, in words; None: nothing.

    dark: whether it may be 0, as with empty fields that are all dark.
    """
    prisms = [prism for prism in acquisition.prisms if prism is not None]
    if prisms and not microscope.condenser_prism:
        return "a condenser prism, microscope.condenser_prism is false"
    if microscope.lenses is not None:
        return "a linear transfer, which can't hold microscope.polarisation.pupil"
    if not dark and not responds_linearly(microscope, acquisition):
        biases = ", ".join(f"{number(prism.bias):g}" for prism in prisms)
        return f"a linear response, acquisition.prisms have biases {biases}"
    return None


def responds_linearly(microscope: Microscope, acquisition: Acquisition) -> bool:
    """Whether an image changes with a weak specimen to first order: not where its empty field is dark."""
    return microscope.polarisers is not None or any(
        prism is None or abs(math.sin(number(prism.bias) / 2)) > DARK for prism in acquisition.prisms
    )


def axial_band(setup: Setup) -> int:
    """Number of cosines along z that light can tell apart.

    A pair of waves at angles up to the larger aperture beats along z with (p_z(0) − p_z(NA))/λ at most, and cosine k
    has the frequency k/(2·depth).
    """
    microscope, background = setup.microscope, number(setup.volume.background)
    objective, condenser = microscope.objective, microscope.condenser
    na = background
    if objective is not None:
        na = max(objective.reach(background), 0.0 if condenser is None else min(condenser.na, background))
    highest = (background - math.sqrt(max(background**2 - na**2, 0.0))) / microscope.wavelength
    return math.ceil(2 * setup.volume.grid.extent[0] * highest) + BEYOND


def cosines(number: int) -> Float[Tensor, "cosine z"]:
    """The orthonormal DCT-II as a matrix, float64."""
    k, z = torch.arange(number, dtype=torch.float64)[:, None], torch.arange(number, dtype=torch.float64)
    matrix = torch.cos(math.pi * k * (z + 0.5) / number) * math.sqrt(2 / number)
    matrix[0] /= math.sqrt(2)
    return matrix


def waves_of_columns(nx: int) -> Float[Tensor, " half"]:
    """How many waves each column of a real FFT of nx pixels stands for: itself and its complex conjugate, but for the
    first and, of an even number, the last; float64.
    """
    counts = torch.full((nx // 2 + 1,), 2.0, dtype=torch.float64)
    counts[0] = 1
    if nx % 2 == 0:
        counts[-1] = 1
    return counts


def squared_differences(shape: tuple[int, int, int], ratio: float) -> Float[Tensor, "y half cosine"]:
    """DᵀD of the `forward_differences`, which is diagonal in waves along y and x and cosines along z; float64."""
    nz, ny, nx = shape
    along_y, along_x = torch.fft.fftfreq(ny, dtype=torch.float64), torch.fft.rfftfreq(nx, dtype=torch.float64)
    along_z = torch.arange(nz, dtype=torch.float64) / (2 * nz)
    y, x, z = (2 - 2 * torch.cos(2 * math.pi * f) for f in (along_y, along_x, along_z))
    return y[:, None, None] + x[:, None] + ratio**2 * z
