"""Exact fields and scattering amplitudes of spheres and of balls of any radial index.

Weyl's expansion of e^{ikr}/r gives a scattered wave f(cosγ)·e^{ikr}/r as plane waves:
    ψ_sc(r) = (i/2π) ∫ d²k⊥/k_z · f(k̂·k̂0) · e^{ik·r}.
An array of period L holds one wave for each of its frequencies, with (2π/L)² of that integral: a DFT coefficient
that needs no near field.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Complex, Float, Inexact
from scipy.special import eval_legendre
from torch import Tensor

from data_synthetic.exact.radial import RadialIndex, radial_waves
from data_synthetic.exact.sphere import ScatteredWaves, partial_waves
from data_synthetic.specimen import require_above_zero, require_finite, require_propagating, require_vector
from torchdic.grid import Grid


def sphere_field(
    grid: Grid,
    wavelength: float,
    radius: float,
    n_sphere: float,
    n_medium: float,
    points: Float[Tensor, "source 2"],
    plane: float = 0.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    padding: float = 2.0,
    na: float | None = None,
) -> Complex[Tensor, "source y x"]:
    """The field behind a sphere as an objective sees it: envelopes (source, y, x), complex128.

    An envelope is the field divided by the source's own plane wave: it is 1 where nothing scatters. It holds the waves
    that travel toward +z, extrapolated through the medium to z = plane, the plane on which a microscope focuses. The
    plane may lie within the sphere.

    grid: its (y, x) pixels are the field's.
    wavelength: in vacuum, in µm.
    radius: of the sphere, in µm.
    n_sphere, n_medium: refractive indices.
    points: direction of each source, (source, 2), (y, x) in NA units, n·sinθ.
    plane: z in µm.
    centre: of the sphere, (z, y, x) in µm.
    padding: the waves have the period of an array that is so many times as wide as the grid, to which the field is then
        cropped.
    na: keeps the waves within a numerical aperture, edge included; None keeps all.

    A padding of 1 is exact for a periodic array of spheres. The error for a single sphere falls as 1/padding. For beads
    half as wide as the grid and na 0.9 its rms, over the scattered field's rms, is 0.4 to 0.8 % at 1, 0.1 to 0.3 % at 2
    and 0.04 to 0.09 % at 4. Without na, where some waves graze the plane, it is 2 to 5 %, 1.5 % and 0.5 %. A cropped
    field that is then imaged as periodic gives images that are wrong by 1 % of their standard deviation at any padding.
    For images of a single sphere take a grid twice as wide with padding 1, image that, and crop the image (0.2 %).

    Waves beyond the grid's Nyquist frequency are absent: 1/(2·spacing) should cover (na + |point|)/wavelength.
    Raises ValueError for a length not above 0, an index below 1, a source direction that the medium cannot carry and a
    padding below 1.
    """
    sphere = partial_waves(wavelength, radius, n_sphere, n_medium)
    return _array_of_waves(_Window(grid, plane, centre, padding, na), wavelength, sphere, n_medium, points)


def radial_field(
    grid: Grid,
    wavelength: float,
    index: RadialIndex,
    radius: float,
    n_medium: float,
    points: Float[Tensor, "source 2"],
    plane: float = 0.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    padding: float = 2.0,
    na: float | None = None,
    step: float | None = None,
) -> Complex[Tensor, "source y x"]:
    """The field behind a ball of radial index n(r): envelopes (source, y, x), complex128.

    index: a function from distances r from the centre in µm to n, a numpy array each. Only r < radius is evaluated.
    radius: in µm; beyond it there is medium. A jump of the index at the radius costs no accuracy, but one inside does.
        Choose the radius at a sharp surface, or where n equals the medium's to rounding.
    step: largest step of the radial integration in µm; the error falls with its fourth power. None is 1/100 of the
        shortest wavelength in the ball: then no |a_l| ≤ 1 errs by more than 3e-8 at Δn 0.1 and 2e-9 at Δn 0.03 (radii
        of 3 to 30 µm).
    The other arguments and errors are those of `sphere_field`. Raises ValueError also for a step not above 0.
    """
    waves = radial_waves(wavelength, index, radius, n_medium, step)
    return _array_of_waves(_Window(grid, plane, centre, padding, na), wavelength, waves, n_medium, points)


@dataclass(frozen=True)
class _Window:
    """Where a field is computed, and from which waves.

    grid: its (y, x) pixels.
    plane: depth in µm.
    centre: of the ball, (z, y, x) in µm.
    padding: period of the waves, in sides of the grid.
    na: largest aperture of the waves; None keeps all waves.
    Raises ValueError if a value breaks its law.
    """

    grid: Grid
    plane: float
    centre: tuple[float, float, float]
    padding: float
    na: float | None

    def __post_init__(self) -> None:
        require_finite("plane", self.plane, "µm")
        require_vector("centre", self.centre, "z, y, x")
        if not (math.isfinite(self.padding) and self.padding >= 1):
            raise ValueError(f"padding {self.padding} must be at least 1, the grid itself")
        if self.na is not None:
            require_above_zero("numerical aperture", self.na, "(n·sinθ)")


def _array_of_waves(
    window: _Window, wavelength: float, waves: ScatteredWaves, n_medium: float, points: Float[Tensor, "source 2"]
) -> Complex[Tensor, "source y x"]:
    """The envelopes (source, y, x) that the scattered plane waves of the array's frequencies sum up to."""
    grid, centre = window.grid, window.centre
    sources = _wave_vectors(points, wavelength, n_medium)

    shape = [math.ceil(window.padding * n) for n in grid.shape[1:]]
    ky, kx = (2 * np.pi * np.fft.fftfreq(n, d) for n, d in zip(shape, grid.spacing[1:], strict=True))
    period = [n * d for n, d in zip(shape, grid.spacing[1:], strict=True)]
    # The first pixel of the array is that of the grid: cropping keeps [0, n), and copies lie a full period away.
    phase_y = np.exp(1j * ky * (grid.centre(1, 0) - centre[1]))[:, None]
    phase_x = np.exp(1j * kx * (grid.centre(2, 0) - centre[2]))
    phase = phase_y * phase_x
    # 1/k_z is integrable but unbounded: no wave may exceed its mean over the last half step of frequency.
    lowest_kz = math.sqrt(waves.k * 2 * math.pi / max(period)) / 2
    aperture = waves.k if window.na is None else min(waves.k, 2 * math.pi * window.na / wavelength)

    fields = np.empty((len(sources), *grid.shape[1:]), dtype=np.complex128)
    for field, (z0, y0, x0) in zip(fields, sources, strict=True):
        transverse2 = (ky[:, None] + y0) ** 2 + (kx + x0) ** 2
        # The edge counts as inside; the margin of 1e-12 keeps rounding from deciding that.
        kept = transverse2 <= aperture**2 * (1 + 1e-12)
        kz = np.sqrt(np.maximum(waves.k**2 - transverse2[kept], 0))
        along = kz * z0 + ((ky[:, None] + y0) * y0 + (kx + x0) * x0)[kept]
        wave = waves.amplitude(np.clip(along / waves.k**2, -1, 1)) / np.maximum(kz, lowest_kz)
        wave *= np.exp(1j * (kz - z0) * (window.plane - centre[0])) * phase[kept]
        spectrum = np.zeros(shape, dtype=np.complex128)
        spectrum[kept] = 2j * math.pi / math.prod(period) * wave
        spectrum[0, 0] += 1  # the source itself
        field[:] = np.fft.ifft2(spectrum, norm="forward")[: grid.shape[1], : grid.shape[2]]
    return torch.from_numpy(fields).to(points.device)


def sphere_near_field(
    position: Float[Tensor, "*position 3"],
    wavelength: float,
    radius: float,
    n_sphere: float,
    n_medium: float,
    point: Float[Tensor, "2"],
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Complex[Tensor, "*position"]:
    """The exact field of one source at any place, inside the sphere or outside, as a sum of partial waves; complex128.

    position: the places, (..., 3), (z, y, x) in µm.
    point: direction of the source, (2,), (y, x) in NA units.
    The result (...) is the field divided by the source's plane wave, as in `sphere_field`. But evanescent waves are
    included, and nothing is extrapolated or periodic. The other arguments and errors are those of `sphere_field`. Each
    place costs about a hundred terms.
    """
    sphere = partial_waves(wavelength, radius, n_sphere, n_medium)
    require_vector("centre", centre, "z, y, x")
    k0 = _wave_vectors(point[None], wavelength, n_medium)[0]
    offset = position.detach().cpu().to(torch.float64) - torch.tensor(centre, dtype=torch.float64)
    places = offset.numpy().reshape(-1, 3)
    r = np.linalg.norm(places, axis=1)
    phase = places @ k0
    # At the very centre, where the angle is undefined, only l = 0 survives: any cosine serves.
    cosine = np.clip(phase / (sphere.k * np.maximum(r, 1e-300)), -1, 1)
    orders = np.arange(len(sphere.a))[:, None]
    terms = (2 * orders + 1) * 1j**orders * eval_legendre(orders, cosine)
    inside = r < radius
    field = np.exp(1j * phase)
    field[inside] = (terms[:, inside] * sphere.inside(r[inside])).sum(0)
    field[~inside] += (terms[:, ~inside] * sphere.scattered(r[~inside])).sum(0)
    envelope = torch.from_numpy(field * np.exp(-1j * phase))
    return envelope.reshape(position.shape[:-1]).to(position.device)


def scattering_amplitude(
    cosine: Inexact[Tensor, "*angle"], wavelength: float, radius: float, n_sphere: float, n_medium: float
) -> Complex[Tensor, "*angle"]:
    """The amplitude f(cosγ) in µm of the wave f·e^{ikr}/r scattered at angle γ from the source; complex128.

    cosine: cosγ; a complex one continues f to evanescent waves.
    The other arguments and errors are those of `sphere_field`.
    """
    sphere = partial_waves(wavelength, radius, n_sphere, n_medium)
    return torch.as_tensor(sphere.amplitude(cosine.detach().cpu().numpy())).to(cosine.device)


def radial_amplitude(
    cosine: Inexact[Tensor, "*angle"],
    wavelength: float,
    index: RadialIndex,
    radius: float,
    n_medium: float,
    *,
    step: float | None = None,
) -> Complex[Tensor, "*angle"]:
    """The amplitude f(cosγ) in µm, as `scattering_amplitude` gives it, for a ball of radial index; complex128.

    cosine: cosγ. The other arguments and errors are those of `radial_field`.
    """
    waves = radial_waves(wavelength, index, radius, n_medium, step)
    return torch.as_tensor(waves.amplitude(cosine.detach().cpu().numpy())).to(cosine.device)


def radial_coefficients(
    wavelength: float, index: RadialIndex, radius: float, n_medium: float, *, step: float | None = None
) -> Complex[Tensor, " order"]:
    """The coefficients a_l of the scattered partial waves of a ball of radial index, l = 0, 1, …; complex128.

    |1 + 2a_l| = 1 where nothing is absorbed. The arguments and errors are those of `radial_field`.
    """
    return torch.from_numpy(radial_waves(wavelength, index, radius, n_medium, step).a)


def _wave_vectors(points: Float[Tensor, "source 2"], wavelength: float, n_medium: float) -> np.ndarray:
    """Wave vectors (source, 3), (z, y, x) in rad/µm, of source directions in NA units."""
    momentum = points.detach().cpu().to(torch.float64)
    pz = require_propagating(momentum, n_medium)
    return 2 * math.pi / wavelength * torch.cat((pz[:, None], momentum), 1).numpy()
