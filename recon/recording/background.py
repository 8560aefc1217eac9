"""The slow background and the noise of an image, found in spite of the specimen in it."""

import math

import numpy as np
from jaxtyping import Float, Real

_BLOCKS = 64  # the background is smooth: its fit sees block means, at most this many along an axis

_TUKEY = 4.685  # Tukey's biweight: 95 % efficient on Gaussian noise

_NORMAL_MAD = 0.6745  # median of |x| for a standard normal x


def background_surface(image: Real[np.ndarray, "y x"], order: int = 2) -> Float[np.ndarray, "y x"]:
    """The slow background of an image (y, x), in its unit: a polynomial surface of total degree `order`.

    Fitted to block means by least absolute deviations, then by least squares with Tukey's biweight, each
    reweighted until it stands still: a specimen that stands out of the noise and leaves most of the field
    empty loses its say. Returns float64 of the image's shape.
    """
    ny, nx = image.shape
    by, bx = math.ceil(ny / _BLOCKS), math.ceil(nx / _BLOCKS)
    ky, kx = ny // by, nx // bx
    blocks = image[: ky * by, : kx * bx].astype(np.float64).reshape(ky, by, kx, bx)
    values = blocks.mean(axis=(1, 3)).ravel()
    middle = float(np.median(values))  # keeps digits where a bright background is nearly flat
    values -= middle
    rows, columns = (np.arange(ky) + 0.5) * by - 0.5, (np.arange(kx) + 0.5) * bx - 0.5
    basis = _polynomials(rows, columns, (ny, nx), order)
    basis = basis.reshape(len(basis), -1).T
    rounding = 100 * np.finfo(np.float64).eps * max(abs(middle), float(np.abs(values).max()))
    coefficients = _weighted_fit(basis, values, np.ones_like(values))
    # biweights alone would keep what plain least squares has bent to; absolute deviations bend less
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
    surface = _polynomials(np.arange(ny), np.arange(nx), (ny, nx), order)
    return middle + np.tensordot(coefficients, surface, axes=1)


def _weighted_fit(basis: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Coefficients of weighted least squares, from the Gram matrix: Legendre's is near diagonal."""
    weighted = basis * weight[:, None]
    return np.linalg.lstsq(weighted.T @ basis, weighted.T @ values, rcond=None)[0]


def _absolute(residual: np.ndarray) -> np.ndarray:
    """Weights of least absolute deviations; residuals are relative to their median."""
    return 1 / np.maximum(residual, 1e-3)


def _biweight(residual: np.ndarray) -> np.ndarray:
    """Tukey's weights; residuals are relative to their median."""
    return np.clip(1 - (residual * (_NORMAL_MAD / _TUKEY)) ** 2, 0, None) ** 2


def noise_level(images: Real[np.ndarray, "*planes y x"]) -> float | None:
    """The standard deviation of the noise in images (..., y, x), in their unit; None below 3 × 3 pixels.

    From the median magnitude under a mask that is blind to anything smooth (Immerkær, Computer Vision
    and Image Understanding 64, 300, 1996; his mean is a median here, for the sake of edges).
    """
    if min(images.shape[-2:]) < 3:
        return None
    along_x = np.diff(images.astype(np.float64), n=2, axis=-1)
    masked = np.diff(along_x, n=2, axis=-2)  # [1 −2 1]ᵀ[1 −2 1], whose squares sum to 36
    return float(np.median(np.abs(masked))) / (6 * _NORMAL_MAD)


def _polynomials(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int], order: int) -> np.ndarray:
    """Products of Legendre polynomials of total degree up to `order` at pixel indices: (term, y, x)."""
    ny, nx = shape
    along_y = np.polynomial.legendre.legvander(2 * (rows + 0.5) / ny - 1, order)
    along_x = np.polynomial.legendre.legvander(2 * (columns + 0.5) / nx - 1, order)
    terms = [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]
    return np.stack([np.outer(along_y[:, i], along_x[:, j]) for i, j in terms])
