"""How a recording's noise grows with its light: a camera's gain and read noise, given or measured in the images."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Real
from torch import Tensor

from recon.recording.background import NORMAL_MAD

# Fourth differences along both axes: 0 for anything smooth, and little for all that an objective resolves.
_DIFFERENCES = 4
_NORM = 70  # root of the sum of their squares, (1 + 16 + 36 + 16 + 1)

_SIDE = 8  # pixels of a block, whose mean is the level of its pixels

_BINS = 32  # of equal width between the darkest and the brightest half per cent of the blocks

_FEWEST = 8  # blocks of a bin

_TUKEY = 4.685  # Tukey's biweight, as for backgrounds

_UNSURE = 0.1  # a gain whose standard error is a larger part of it can't be told


@dataclass(frozen=True)
class NoiseModel:
    """Shot noise and read noise of a recording, in the unit of its intensities (counts without dark counts, or other).

    gain: intensity of one photon (photoelectron), above 0. read: standard deviation of the read noise, at least 0.
    Both are numbers or tensors that broadcast to the images. Light that was subtracted from them still has its noise:
    it counts as read noise, read² + gain·light.
    Raises ValueError for other values.
    """

    gain: float | Tensor
    read: float | Tensor

    def __post_init__(self) -> None:
        gain, read = torch.as_tensor(self.gain), torch.as_tensor(self.read)
        if len(wrong := gain[~(torch.isfinite(gain) & (gain > 0))]):
            raise ValueError(f"gain {float(wrong[0]):g} must be above 0 and finite")
        if len(wrong := read[~(torch.isfinite(read) & (read >= 0))]):
            raise ValueError(f"read noise {float(wrong[0]):g} must be at least 0 and finite")

    def variance(self, intensity: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
        """The noise's variance, gain·intensity + read², where the mean intensity is this; below 0 it is read²."""
        return self.gain * intensity.clamp_min(0) + self.read**2

    def in_unit(self, unit: float | Tensor) -> "NoiseModel":
        """The model of the same images after a division by `unit`, which is above 0."""
        return NoiseModel(self.gain / unit, self.read / unit)

    def part(self, rows: slice, columns: slice) -> "NoiseModel":
        """The model of a part of the images: of their rows and columns."""
        return NoiseModel(*(_part(value, rows, columns) for value in (self.gain, self.read)))

    def like(self, data: Float[Tensor, "prism focus y x"]) -> "TensorNoise":
        """The same with the data's dtype and device. Raises ValueError where it doesn't broadcast to their shape."""
        tensors = [torch.as_tensor(value, dtype=data.dtype, device=data.device) for value in (self.gain, self.read)]
        for name, value in zip(("gain", "read noise"), tensors, strict=True):
            try:
                value.broadcast_to(data.shape)
            except RuntimeError as error:
                raise ValueError(f"the {name} has shape {tuple(value.shape)}, the data {tuple(data.shape)}") from error
        return TensorNoise(*tensors)


@dataclass(frozen=True)
class TensorNoise(NoiseModel):
    """A noise model whose numbers are tensors of the data's dtype, on their device."""

    gain: Tensor
    read: Tensor


def _part(value: float | Tensor, rows: slice, columns: slice) -> float | Tensor:
    """What of a value that broadcasts to images broadcasts to a part of them."""
    if not isinstance(value, Tensor):
        return value
    for axis, within in ((-2, rows), (-1, columns)):
        if value.ndim >= -axis and value.shape[axis] > 1:
            value = value.movedim(axis, 0)[within].movedim(0, axis)
    return value


def noise_of_level(
    images: Real[np.ndarray, "*planes y x"], mask: Bool[np.ndarray, "*planes y x"] | None = None
) -> NoiseModel | None:
    """The gain and the read noise of a recording, from how its noise grows with its light; None where it can't tell.

    images: (..., y, x), in any unit, with the dark counts removed and not yet flattened. mask: the pixels that count
    (True), which saturated ones don't; None is all.

    Blocks of 8 × 8 pixels are sorted into 32 levels by their mean. At each level the variance follows from the median
    magnitude of the fourth differences along both axes, which a specimen hardly moves, and a line is fitted to the
    variances with Tukey's biweight (as Foi et al., IEEE Trans. Image Processing 17, 1737, 2008, do with wavelets). It
    gives None for fewer than 4 levels, a gain that is uncertain by more than a tenth, and noise that falls to nothing
    far above intensity 0, where dark counts are left.
    """
    levels, variances, blocks = variances_of_levels(images, mask)
    if len(levels) < 4:
        return None
    straight = np.stack([np.ones_like(levels), levels], axis=1)
    (intercept, slope), error = fitted_line(straight, variances, blocks)
    if intercept < -3 * error[0] or not slope > error[1] / _UNSURE:
        return None
    if intercept < 0:
        line, _ = fitted_line(straight[:, 1:], variances, blocks)
        intercept, slope = 0.0, line[0]
    return NoiseModel(float(slope), math.sqrt(intercept))


def variances_of_levels(images: np.ndarray, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean level of each bin that has enough blocks, the noise's variance there, and the number of its blocks."""
    found = list(_blocks(images, mask))
    levels = np.concatenate([level for level, _ in found])
    if len(levels) < _FEWEST:
        return np.empty(0), np.empty(0), np.empty(0)
    magnitudes = np.concatenate([magnitude for _, magnitude in found])
    low, high = np.quantile(levels, (0.005, 0.995))
    bins = np.floor((levels - low) / max(high - low, np.finfo(np.float64).tiny) * _BINS)
    chosen = [members for b in range(_BINS) if (members := bins == b).sum() >= _FEWEST]
    variances = [(float(np.median(magnitudes[members])) / NORMAL_MAD) ** 2 for members in chosen]
    return (
        np.array([levels[members].mean() for members in chosen]),
        np.array(variances),
        np.array([members.sum() for members in chosen], np.float64),
    )


def _blocks(images: np.ndarray, mask: np.ndarray | None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each plane, the means (block,) of its blocks and the magnitudes (block, pixel) of their filtered pixels.

    The magnitudes are those of the noise. Blocks that a pixel out of the mask has a part in are left out.
    """
    ny, nx = images.shape[-2:]
    ky, kx = ((n - _DIFFERENCES) // _SIDE for n in (ny, nx))
    if min(ky, kx) < 1:
        yield np.empty(0), np.empty((0, _SIDE**2), np.float32)
        return
    edge = _DIFFERENCES // 2
    masks = None if mask is None else mask.reshape(-1, ny, nx)
    for number, plane in enumerate(images.reshape(-1, ny, nx)):
        light = plane.astype(np.float64)
        if masks is not None:
            light[~masks[number]] = np.nan
        filtered = np.diff(np.diff(light, n=_DIFFERENCES, axis=0), n=_DIFFERENCES, axis=1) / _NORM
        level, magnitude = (
            values[: ky * _SIDE, : kx * _SIDE].reshape(ky, _SIDE, kx, _SIDE).swapaxes(1, 2).reshape(ky * kx, -1)
            for values in (light[edge:-edge, edge:-edge], np.abs(filtered))
        )
        known = np.isfinite(magnitude).all(1)
        yield level[known].mean(1), magnitude[known].astype(np.float32)


def fitted_line(basis: np.ndarray, variances: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of a fit to variances, and their standard errors.

    The scatter of a variance is proportional to the fitted one and falls with the root of the blocks' number.
    """
    floor, unit = 1e-3 * float(variances.max()), np.abs(basis).max(0)
    predicted, weight = np.maximum(variances, floor), np.ones_like(variances)
    line = error = np.zeros(basis.shape[1])
    for _ in range(50):
        precision = weight * blocks / predicted**2
        inverse = np.linalg.inv((basis / unit).T @ (precision[:, None] * basis / unit))
        previous, line = line, inverse @ ((basis / unit).T @ (precision * variances))
        fitted = basis / unit @ line
        predicted = np.maximum(fitted, floor)
        standard = (variances - fitted) * np.sqrt(blocks) / predicted
        typical = float(np.median(np.abs(standard))) / NORMAL_MAD
        freedom = max(float(weight.sum()) - len(line), 1)
        error = np.sqrt(np.diag(inverse) * float((weight * standard**2).sum()) / freedom)
        if typical == 0 or np.abs(line - previous).max() <= 1e-6 * np.abs(line).max():
            break
        weight = np.clip(1 - (standard / (_TUKEY * typical)) ** 2, 0, None) ** 2
    return line / unit, error / unit
