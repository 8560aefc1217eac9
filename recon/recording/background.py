"""The slow background and the noise of an image that also shows a specimen."""

import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Real

_BLOCKS = 64  # the background is smooth, so it is fitted to block means, at most this many along an axis

_TUKEY = 4.685  # Tukey's biweight: 95 % efficient on Gaussian noise

NORMAL_MAD = 0.6745  # median of |x| for a standard normal x

# Where the background falls below this part of its highest value, as a vignette does, its logarithm is tried as a
# polynomial, of so many degrees more, and taken where the typical residual falls to this share; below _STEEP, where it
# falls at all. A vignette of cos⁴ that falls to 0.25 is then followed within 4 %; the plain polynomial falls to 0.05.
_VIGNETTE, _STEEP, _MORE, _BETTER = 0.75, 0.3, 2, 0.8


def background_surface(image: Real[np.ndarray, "y x"], order: int = 2) -> Float[np.ndarray, "y x"]:
    """The slow background of an image: a polynomial surface of total degree `order`.

    image: (y, x), in any unit. Pixels that are NaN are left out; at least one must not be.
    order: 0 is a constant, 1 a tilted plane, 2 a curved surface.

    Returns the surface (y, x) in the image's unit, float64. It is fitted to the means of blocks of pixels by least
    absolute deviations, then by least squares with Tukey's biweight; both are reweighted until the coefficients no
    longer change. A specimen that stands out of the noise and leaves most of the field empty hardly bends it.
    A background of light that falls below three quarters of its highest value, as a vignette does, is described by the
    exponential of a polynomial, of degree order + 2, where that is nearer: it stays above 0. An order below 2 stays a
    polynomial.
    """
    means, rows, columns = _block_means(image)
    known = np.isfinite(means)
    values = means[known]
    middle = float(np.median(values))  # subtracted to keep digits where a bright background is nearly flat
    rounding = 100 * np.finfo(np.float64).eps * max(abs(middle), float(np.abs(values - middle).max()))

    def basis(degree: int) -> np.ndarray:
        return _polynomials(rows, columns, image.shape, degree).reshape(-1, len(means)).T[known]

    def at_pixels(coefficients: np.ndarray, degree: int) -> np.ndarray:
        ny, nx = image.shape
        return np.tensordot(coefficients, _polynomials(np.arange(ny), np.arange(nx), (ny, nx), degree), axes=1)

    plain = _robust_fit(basis(order), values - middle, rounding)
    surface = middle + at_pixels(plain, order)
    if order < 2 or not _is_vignette(surface, values):
        return surface
    degree = order + _MORE
    steep = _robust_exponential(basis(degree), values, rounding)
    residuals = [middle + basis(order) @ plain - values, np.exp(basis(degree) @ steep) - values]
    before, after = (float(np.median(np.abs(residual))) for residual in residuals)
    enough = 1.0 if surface.min() < _STEEP * surface.max() else _BETTER
    return np.exp(at_pixels(steep, degree)) if after < enough * before else surface


def _is_vignette(surface: np.ndarray, values: np.ndarray) -> bool:
    """Whether a surface falls far below its highest value, and describes light: nearly all values are above 0."""
    return float(surface.min()) < _VIGNETTE * float(surface.max()) and float((values > 0).mean()) > 0.98


def _block_means(image: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means of equal blocks of pixels, row by row, and the pixel indices of the blocks' centres along y and x.

    The mean of a block without any known pixel is NaN.
    """
    by, bx = (math.ceil(n / _BLOCKS) for n in image.shape)
    ky, kx = image.shape[0] // by, image.shape[1] // bx
    blocks = image[: ky * by, : kx * bx].astype(np.float64).reshape(ky, by, kx, bx)
    rows, columns = (np.arange(ky) + 0.5) * by - 0.5, (np.arange(kx) + 0.5) * bx - 0.5
    known = np.isfinite(blocks)
    if known.all():
        return blocks.mean(axis=(1, 3)).ravel(), rows, columns
    number = known.sum(axis=(1, 3))
    totals = np.where(known, blocks, 0).sum(axis=(1, 3))
    return np.where(number > 0, totals / np.maximum(number, 1), np.nan).ravel(), rows, columns


def _robust_fit(basis: np.ndarray, values: np.ndarray, rounding: float) -> np.ndarray:
    """Coefficients of a fit that outliers hardly move. Residuals below `rounding` count as none."""
    coefficients = _weighted_fit(basis, values, np.ones_like(values))
    # biweights alone would stay near the plain least-squares fit, which outliers bend; absolute deviations bend less
    for weight in (_absolute, _biweight):
        for _ in range(100):
            residual = np.abs(values - basis @ coefficients)
            typical = float(np.median(residual))
            if typical <= rounding:
                break  # more than half of the image lies on the surface
            previous = coefficients
            coefficients = _weighted_fit(basis, values, weight(residual / typical))
            if np.abs(coefficients - previous).max() < 1e-4 * typical:
                break
    return coefficients


def _robust_exponential(basis: np.ndarray, values: np.ndarray, rounding: float) -> np.ndarray:
    """Coefficients c of a fit of exp(basis·c) that outliers hardly move, by Gauss's and Newton's steps."""
    coefficients = _robust_fit(basis, np.log(np.maximum(values, 1e-3 * float(np.median(values)))), 0.0)
    for _ in range(100):
        fitted = np.exp(basis @ coefficients)
        residual = values - fitted
        typical = float(np.median(np.abs(residual)))
        if typical <= rounding:
            break
        step = _weighted_fit(basis * fitted[:, None], residual, _biweight(np.abs(residual) / typical))
        coefficients = coefficients + step
        if np.abs(basis @ step).max() < 1e-5:
            break
    return coefficients


def _weighted_fit(basis: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients of weighted least squares, from the Gram matrix, which Legendre polynomials keep near diagonal."""
    weighted = basis * weight[:, None]
    return np.linalg.lstsq(weighted.T @ basis, weighted.T @ values, rcond=None)[0]


def _absolute(residual: np.ndarray) -> np.ndarray:
    """Weights of least absolute deviations. residual: relative to the median residual."""
    return 1 / np.maximum(residual, 1e-3)


def _biweight(residual: np.ndarray) -> np.ndarray:
    """Tukey's biweights. residual: relative to the median residual."""
    return np.clip(1 - (residual * (NORMAL_MAD / _TUKEY)) ** 2, 0, None) ** 2


def known_levels(levels: Iterable[float | None]) -> list[float] | None:
    """The noise of each prism where it is known of all of them; None where it isn't."""
    each = list(levels)
    known = [level for level in each if level is not None]
    return known if len(known) == len(each) else None


def noise_level(images: Real[np.ndarray, "*planes y x"]) -> float | None:
    """The standard deviation of the noise in images; None for images of less than 3 × 3 pixels.

    images: (..., y, x), in any unit, which is the result's unit too. Pixels that are NaN are left out; where they leave
    no 3 × 3 pixels the result is None.

    The images are filtered with a mask that gives 0 for anything smooth, and the noise follows from the median
    magnitude of the result (Immerkær, Computer Vision and Image Understanding 64, 300, 1996, who takes the mean;
    edges of the specimen move the median less).
    """
    if min(images.shape[-2:]) < 3:
        return None
    along_x = np.diff(images.astype(np.float64), n=2, axis=-1)
    masked = np.diff(along_x, n=2, axis=-2)  # [1 −2 1]ᵀ[1 −2 1], whose squares sum to 36
    known = masked[np.isfinite(masked)]
    return float(np.median(np.abs(known))) / (6 * NORMAL_MAD) if known.size else None


def _polynomials(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], order: int) -> np.ndarray:
    """Products of Legendre polynomials of total degree up to `order` at pixel indices: (term, y, x)."""
    ny, nx = shape
    along_y = np.polynomial.legendre.legvander(2 * (rows + 0.5) / ny - 1, order)
    along_x = np.polynomial.legendre.legvander(2 * (columns + 0.5) / nx - 1, order)
    terms = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    return np.stack([np.outer(along_y[:, i], along_x[:, j]) for i, j in terms])
