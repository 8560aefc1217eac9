"""The direction of shear, from a single DIC image of a weak specimen."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Real

from recon.recording.background import background_surface

_MIN_PIXELS = 32

_MIN_CYCLES = 3  # the window smears the direction of frequencies with fewer cycles across it

_DYNAMIC = 1e-3  # rings weaker than this fraction of the strongest show the optics and the noise, not the specimen

_ABOVE_NOISE = 4.0  # a ring is used where its power is this many times that of the noise

_SIGNIFICANT = 2.0  # an anisotropy of fewer standard errors than this shows no direction

_HANN_CELLS = 1.5**2  # equivalent noise bandwidth of a Hann window, in cells of the spectrum


@dataclass(frozen=True)
class ShearAxis:
    """The line along which the two beams are sheared. The image does not tell which way along it.

    angle: rad in [0, π), from +x toward +y (down the screen).
    direction: the unit vector (y, x) along the line; its sign is arbitrary.
    anisotropy: |Σ w P e^{2iθ}| / Σ w P; ½ for a pure derivative, 0 for an image without a direction.
    uncertainty: of the angle, rad, from the number of independent frequencies. It is 1.5 times the scatter of images
        of random blobs.
    """

    angle: float
    direction: tuple[float, float]
    anisotropy: float
    uncertainty: float


def estimate_shear_axis(image: Real[np.ndarray, "y x"], pixel_size: tuple[float, float] = (1.0, 1.0)) -> ShearAxis:
    """Estimate the shear axis from one DIC image of a weak specimen.

    image: (y, x), in any unit that is linear in the intensity.
    pixel_size: (y, x), in any length.

    A weak phase φ shows as I ≈ background + ½ sin(bias) s·∇φ, whose power is P ∝ (f·s)²|Φ(f)|². Around each ring of
    |f| it varies as cos²(θ − θ_s), if the specimen has no direction of its own. Over the rings that the specimen fills,
        θ_s = ½ arg Σ w(|f|) P(f) e^{2iθ},    w = 1/mean of P over the ring.
    The sign stays unknown, because shear and bias reversed together give the same image.

    Raises ValueError for less than 32 × 32 pixels, for nothing above the noise, and for an image without a direction.
    """
    if image.ndim != 2 or min(image.shape) < _MIN_PIXELS:
        shown = " × ".join(str(n) for n in image.shape)
        raise ValueError(f"image of {shown} pixels: a spectrum needs 2 axes of at least {_MIN_PIXELS}")
    fy, fx = (np.fft.fftfreq(n, d) for n, d in zip(image.shape, pixel_size, strict=True))
    whitened = _whitened_power(image, np.hypot(fy[:, None], fx), pixel_size)
    total = float(whitened.sum())
    theta = np.arctan2(fy[:, None], fx)
    moment = complex((whitened * np.exp(2j * theta)).sum()) / total
    anisotropy = abs(moment)
    independent = total / (2 * _HANN_CELLS)  # the spectrum of a real image repeats each frequency at −f
    error = math.sqrt(float((whitened**2).sum()) / total / (2 * independent))
    if anisotropy < _SIGNIFICANT * error:
        raise ValueError(
            f"image shows no shear axis: its anisotropy {anisotropy:.3f} is below "
            f"{_SIGNIFICANT:g} times its error {error:.3f}"
        )
    angle = (math.atan2(moment.imag, moment.real) / 2) % math.pi
    return ShearAxis(angle, (math.sin(angle), math.cos(angle)), anisotropy, error / (2 * anisotropy))


def _whitened_power(image: np.ndarray, radius: np.ndarray, pixel_size: tuple[float, float]) -> np.ndarray:
    """The power of each frequency, divided by the mean over its ring; 0 in rings that do not show the specimen.

    radius: |f| of each frequency of the image's spectrum. So divided, every ring counts alike; undivided, a few strong
    rings would decide. Raises ValueError where no ring shows the specimen.
    """
    # a smooth window, because the jump at the border would draw a cross along the axes of the spectrum
    window = np.outer(np.hanning(image.shape[0]), np.hanning(image.shape[1]))
    power = np.abs(np.fft.fft2((image - background_surface(image)) * window)) ** 2
    cycle = 1 / min(n * d for n, d in zip(image.shape, pixel_size, strict=True))  # one along the shorter side
    nyquist = 0.5 / max(pixel_size)
    ring = np.where((radius >= _MIN_CYCLES * cycle) & (radius < nyquist), radius / cycle, 0).astype(int)
    cells = np.bincount(ring.ravel())
    mean = np.bincount(ring.ravel(), power.ravel()) / np.maximum(cells, 1)
    mean[0] = 0  # the frequencies that are in no ring
    noise = float(np.median(power[radius > 0.9 * nyquist])) / math.log(2)  # its power is distributed exponentially
    rounding = (np.finfo(np.float64).eps * float(np.abs(image).max())) ** 2 * image.size
    used = (mean > _DYNAMIC * mean.max()) & (mean > _ABOVE_NOISE * noise) & (mean > rounding)
    if not used.any():
        raise ValueError("image holds nothing above its noise: it shows no shear axis")
    return np.where(used[ring], power / np.where(used, mean, 1)[ring], 0)
