"""Two earlier models of DIC, limits of this one: Galbraith's thin phase object, and Holmes and Levy's linear transfer.

Linear transfer. Let a weak slice of index Δn and thickness dz lie at depth z. By the first Born approximation and
Weyl's expansion it scatters the wave of a source p0 into
    U1(f) = i·k0·dz·(n0/p_z)·F{Δn}(f)·exp(i k0 (z_f − z)(p_z − p_z0)),    p_z at the field's frequency f + f_s,
referred to the focus z_f. To first order in Δn, split-step propagation gives the same, in either of its orders. The
unscattered light is the pupil at f_s times the prism at f = 0. To first order in Δn the intensity changes by the sum of
both cross terms of scattered and unscattered light,
    F{δI}(f) = Σ_z T(f; z_f − z)·F{Δn(z)}(f),
    T = conj(D(0))·D(f)·M(f) + D(0)·conj(D(−f)·M(−f)),
    M(f; ζ) = Σ_s w_s·conj(P(f_s))·P(f + f_s)·i·k0·dz·(n0/p_z)·exp(i k0 ζ (p_z − p_z0)).
The prism is a factor. Without bias D(0) = 0, so DIC has no linear response at all. As a function of axial frequency, M
of a single source is its Ewald sphere, a delta function at (p_z − p_z0)/λ; as a function of depth it is smooth, so T is
computed for depths.

On rays what a slice scatters goes straight on along its source's direction p0 up to the reference plane z_r, and
spreads from there: z_f − z_r takes the place of z_f − z, p_z0 that of p_z in n0/p_z, and exp(2πi (z − z_r) f·p0/p_z0)
is a further factor. What bent rays do to the amplitude is left out.

T. J. Holmes and W. J. Levy, Appl. Opt. 26, 3929 (1987); M. Born and E. Wolf, Principles of Optics, 13.1;
N. Streibl, J. Opt. Soc. Am. A 2, 121 (1985) for the bright field.
"""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Complex, Float
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.forward.own_part import own_part
from torchdic.grid import Grid
from torchdic.imaging.pupil import Pupil, Waves
from torchdic.instrument.microscope import Acquisition, Microscope, in_medium
from torchdic.instrument.prism import Prism
from torchdic.memory.batches import sum_over_sources
from torchdic.memory.free import spared
from torchdic.plane_waves import exp_i, to_field, to_spectrum
from torchdic.propagation.base import propagation_of
from torchdic.propagation.presets import STANDARD
from torchdic.propagation.split_step import LOWEST_PZ
from torchdic.ranks.shared import shared
from torchdic.scalar import number, scalar
from torchdic.specimen.volume import Volume


def two_beam_image(phase: Float[Tensor, "y x"], grid: Grid, prism: Prism) -> Float[Tensor, "y x"]:
    """Galbraith's image of a thin phase object: sin²(½[φ(x + s/2) − φ(x − s/2)] + bias/2).

    Two beams of geometrical optics interfere: axial light, no pupil, the object in focus. Fourier interpolation shifts
    the phase, exactly where half the shear is a whole number of pixels. Relative to the empty bright field.

    phase: φ in rad (y, x) on the grid's pixels, periodic.
    grid: its number of slices plays no part.
    prism: shear and bias.

    Raises ValueError where the shape isn't the grid's.

    W. Galbraith and G. B. David, J. Microsc. 108, 147 (1976).
    """
    if tuple(phase.shape) != grid.shape[1:]:
        raise ValueError(f"phase has shape {tuple(phase.shape)}, the grid asks for {grid.shape[1:]} (y, x)")
    frequencies = grid.frequencies(dtype=phase.dtype, device=phase.device)
    sy, sx, bias = (scalar(v, phase) for v in (*prism.shear, prism.bias))
    shift = math.pi * (frequencies[0] * sy + frequencies[1] * sx)
    spectrum = to_spectrum(phase)
    ahead, behind = (to_field(spectrum * exp_i(sign * shift)).real for sign in (1, -1))
    return torch.sin((ahead - behind + bias) / 2).square()


def transfer_function(
    grid: Grid,
    microscope: Microscope,
    prism: Prism | None,
    background: float | Tensor,
    fidelity: Fidelity = STANDARD,
    *,
    focus: float | Tensor = 0.0,
    absorption: bool = False,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Complex[Tensor, "z y x"]:
    """The linear transfer T(f; z_f − z) of each slice z, shape (z, y, x), in the order of the FFT along (y, x).

    The image of a weak specimen is the empty field's + Σ_z F⁻¹[T·F{Δn(z)}].

    prism: None is bright field.
    background: refractive index of the medium.
    fidelity: only `propagation`, `sources`, `steps` (of the wave), `reference_plane` (of rays) and `memory` matter.
    focus: depth z_f in µm.
    absorption: whether T is per unit of κ instead of Δn.
    dtype, device: of the real numbers; those of `background` where it is a tensor and none are given.

    Differentiable in the prism, the focus, the background and the aberrations. Raises ValueError as `image` does, where
    lenses act on polarisation, and for a prism where the microscope has no condenser prism: the prism's factor would
    then differ between sources.
    """
    acquisition = Acquisition((prism,), (focus,))
    return transfer_functions(
        grid, microscope, acquisition, background, fidelity, absorption=absorption, dtype=dtype, device=device
    )[0, 0]


def transfer_functions(
    grid: Grid,
    microscope: Microscope,
    acquisition: Acquisition,
    background: float | Tensor,
    fidelity: Fidelity = STANDARD,
    *,
    absorption: bool = False,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Complex[Tensor, "prism focus z y x"]:
    """The linear transfer of every prism and focus; arguments and errors as of `transfer_function`.

    The sources are summed once for all prisms.
    """
    n0, dtype, device = _medium(background, dtype, device)
    M, _ = _kernel(grid, microscope, acquisition, n0, fidelity)
    if absorption:
        M = 1j * M
    transfers = []
    for prism in acquisition.prisms:
        if prism is None:
            transfers.append(M + _reversed(M).conj())
        else:
            D0D = _two_beams(prism, microscope, grid.frequencies(dtype=dtype, device=device))
            transfers.append(D0D * M + _reversed(D0D * M).conj())
    return torch.stack(transfers)


def linear_image(
    volume: Volume, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity = STANDARD
) -> Float[Tensor, "prism focus y x"]:
    """The image of a specimen to first order in Δn and κ, relative to the empty bright field.

    The weaker the specimen, the better it agrees with `image`. Arguments as of `image`, errors as of
    `transfer_function`.
    """
    pad = fidelity.padding
    grid = volume.grid.widened(pad, pad)
    n0, dtype, device = volume.background, volume.delta.dtype, volume.delta.device
    M, through = _kernel(grid, microscope, acquisition, n0.to(device, dtype), fidelity)
    scattered = to_spectrum(F.pad(volume.delta, (pad,) * 4))
    if volume.absorption is not None:
        scattered = scattered + 1j * to_spectrum(F.pad(volume.absorption, (pad,) * 4))
    wave = torch.einsum("fzyx,zyx->fyx", M, scattered)
    frequencies = grid.frequencies(dtype=dtype, device=device)
    images = []
    for prism in acquisition.prisms:
        D0D = torch.ones_like(frequencies[0]) if prism is None else _two_beams(prism, microscope, frequencies)
        # in space the two cross terms are complex conjugates of each other
        images.append(D0D[0, 0].real * through + 2 * to_field(D0D * wave).real)
    return torch.stack(images)[..., pad : grid.shape[1] - pad, pad : grid.shape[2] - pad]


def _two_beams(prism: Prism, microscope: Microscope, frequencies: Float[Tensor, "2 y x"]) -> Tensor:
    """The prism's factor conj(D(0))·D(f) of the linear transfer, (y, x); complex where the polarisers aren't ideal.

    Of the polarisers' intensity a|S|² + b|C|² + Re(c·C·S*) only the part that is linear in the scattered light counts.
    S and C are the field times real factors, so the factor is a·S(0)S(f) + b·C(0)C(f) + ½[c·S(0)C(f) + c*·C(0)S(f)].
    """
    if not microscope.condenser_prism:
        raise ValueError(
            "the linear transfer takes a prism's factor out of the sum over sources: it needs a condenser prism"
        )
    S, polarisers = prism.transfer(frequencies), microscope.polarisers
    if polarisers is None:
        return S[0, 0] * S
    C = prism.parallel(frequencies)
    a, b, c = (v.to(S.device) for v in polarisers.form(prism.bias))
    factor = a * S[0, 0] * S + b * C[0, 0] * C + (c * S[0, 0] * C + c.conj() * C[0, 0] * S) / 2
    return factor.to(S.dtype.to_complex())


def _kernel(
    grid: Grid,
    microscope: Microscope,
    acquisition: Acquisition,
    background: Tensor,
    fidelity: Fidelity,
) -> tuple[Complex[Tensor, "focus z y x"], Float[Tensor, ""]]:
    """M(f; z_f − z) of the module's docstring, (focus, z, y, x), and the share of the light that passes the pupil."""
    microscope = in_medium(microscope, number(background), background.dtype)
    if microscope.lenses is not None:
        raise ValueError(
            "the linear transfer takes a prism's factor out of the sum over waves: it can't hold a polarisation pupil"
        )
    colours = microscope.colours()
    kernels = [
        shared(_cross_terms, _part_of_cross_terms, grid, part, acquisition, background, fidelity) for part, _ in colours
    ]
    through = [_passing(part, background, fidelity) for part, _ in colours]
    if microscope.spectrum is None:
        return kernels[0], through[0]
    shares = [share for _, share in colours]
    M, passed = (
        torch.stack([share * part for share, part in zip(shares, parts, strict=True)]).sum(0)
        for parts in (kernels, through)
    )
    return M, passed


def _passing(microscope: Microscope, background: Tensor, fidelity: Fidelity) -> Float[Tensor, ""]:
    """The share of the light that passes the pupil."""
    momentum, weights = microscope.sources(fidelity.sources, dtype=background.dtype, device=background.device)
    if microscope.objective is None:
        return weights.sum()
    return (weights * microscope.objective.aperture(momentum[:, :, None, None])[:, 0, 0]).sum()


def _part_of_cross_terms(
    grid: Grid, microscope: Microscope, acquisition: Acquisition, background: Tensor, fidelity: Fidelity
) -> Complex[Tensor, "focus z y x"]:
    """A rank's part of `_cross_terms`."""

    def terms(lit: Microscope, few: Acquisition, _: object) -> Tensor:
        return _cross_terms(grid, lit, few, background, fidelity)

    return own_part(terms, microscope, acquisition, fidelity, axis=0)


def _cross_terms(
    grid: Grid, microscope: Microscope, acquisition: Acquisition, background: Tensor, fidelity: Fidelity
) -> Complex[Tensor, "focus z y x"]:
    """M in light of one wavelength, by this process."""
    dtype, device = background.dtype, background.device
    k0, frequencies = 2 * math.pi / microscope.wavelength, grid.frequencies(dtype=dtype, device=device)
    spreads, plane = propagation_of(fidelity).spreads, fidelity.reference_plane or 0.0
    depths, overlaps = _slabs(grid, fidelity.steps if spreads else None, dtype, device)
    momentum, weights = microscope.sources(fidelity.sources, dtype=dtype, device=device)
    foci = torch.stack([scalar(z, momentum) for z in acquisition.focus])

    def contribution(momentum: Tensor, weights: Tensor) -> Tensor:
        waves = Waves(grid, microscope.wavelength, background, momentum, frequencies)
        pupil = Pupil.of(microscope.objective, waves)
        passed = pupil.through(torch.ones_like(pupil.pz)[:, None]).squeeze(1)
        # passed at f = 0 is the unscattered wave: a source that misses the pupil has no cross term
        pz = pupil.pz.clamp_min(LOWEST_PZ)
        to_focus, to_slice = foci, depths
        beating = pupil.difference
        if not spreads:
            to_focus, to_slice = foci - plane, depths - plane
            pz = pz[:, :1, :1]
            beating = -microscope.wavelength * torch.einsum("sa,ayx->syx", momentum, frequencies) / pz
        length = grid.spacing[0] if overlaps is None else 1.0
        cross = 1j * k0 * length * weights[:, None, None] * passed[:, :1, :1].conj() * passed * (background / pz)
        # exp(i k0 (z_f − z) q) is a product, so that a matrix product for each frequency sums the sources for all foci
        # and slices at once; the matrices' rows and columns lie side by side, or they would be copied one by one
        difference, beating, cross = (v.permute(1, 2, 0).contiguous() for v in (pupil.difference, beating, cross))
        at_focus = exp_i(k0 * to_focus[:, None] * difference[..., None, :]) * cross[..., None, :]
        at_slice = exp_i(-k0 * to_slice * beating[..., None])
        if overlaps is not None:
            at_slice = at_slice @ overlaps.to(at_slice.dtype)
        return (at_focus @ at_slice).permute(2, 3, 0, 1)

    planes = len(depths) + grid.shape[0] + len(foci)
    pixels = grid.shape[1] * grid.shape[2]
    # complex planes, and the phases from which they are made
    each = 4 * planes * pixels * momentum.element_size()
    return sum_over_sources(contribution, (momentum, weights), max(1, spared(fidelity.memory, device) // each))


def _slabs(
    grid: Grid, steps: int | None, dtype: torch.dtype, device: torch.device
) -> tuple[Float[Tensor, " slab"], Float[Tensor, "slab z"] | None]:
    """Depths in µm of split-step propagation's slabs, and the length in µm over which each overlaps each slice.

    steps: number of slabs; None is that of the slices. The lengths are None where slabs and slices are the same.
    """
    nz, extent = grid.shape[0], grid.extent[0]
    steps = steps or nz
    faces, borders = ((torch.arange(n + 1, dtype=torch.float64) / n - 0.5) * extent for n in (steps, nz))
    depths = ((faces[1:] + faces[:-1]) / 2).to(device, dtype)
    if steps == nz:
        return depths, None
    lengths = torch.minimum(faces[1:, None], borders[1:]) - torch.maximum(faces[:-1, None], borders[:-1])
    return depths, lengths.clamp_min(0).to(device, dtype)


def _reversed(spectrum: Tensor) -> Tensor:
    """A spectrum (…, y, x) at −f."""
    return spectrum.flip((-2, -1)).roll((1, 1), (-2, -1))


def _medium(
    background: float | Tensor, dtype: torch.dtype | None, device: torch.device | str | None
) -> tuple[Tensor, torch.dtype, torch.device]:
    """The background as a tensor, with its dtype and device."""
    given = background if isinstance(background, Tensor) else torch.tensor(background, dtype=dtype, device=device)
    n0 = given.to(dtype=dtype or given.dtype, device=device or given.device)
    return n0, n0.dtype, n0.device
