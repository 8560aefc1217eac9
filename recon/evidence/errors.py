"""Error bars of each voxel: of what the noise does, and of the whole error.

Noise: the root mean square of how far the refits to other noise lie from the one without noise. Priors draw noisy
images' volume in more than noiseless ones', and that is in it. Of so few refits it is itself uncertain, by 1/√(2n), so
each voxel's square is averaged with the mean of its six neighbours'. Noise moves few voxels far, those of faint edges,
and most hardly at all. So how many deviations hold 68 % of what it does is told by each refit beside the others.

The whole error: where the images say little, an estimate errs by how Δn changes from a voxel to its neighbours: it
blurs, rounds and draws out. So the squared error is taken as a sum of the estimate's local variances in windows of
three sizes, and of Δn² (a contrast that is lost), with weights of at least 0 that explain the errors of the turned
copies, of which the truth is known. A common factor then makes the bars hold 68 % of the copies' voxels (as in
conformal prediction: G. Shafer and V. Vovk, J. Mach. Learn. Res. 9, 371, 2008).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, convolve, gaussian_filter
from scipy.optimize import nnls
from torch import Tensor

from recon.evidence.refits import Refit
from torchdic import Grid

# Windows of local variances, in lengths of the finest detail along x.
WINDOWS = (1.0, 2.0, 4.0)

# A voxel is inside a specimen from this share of its largest |Δn| on, and near it so many voxels around.
INSIDE, AROUND = 0.05, 2

# What a bar of one standard deviation holds.
HELD = 0.6827

# A voxel counts as much as its six neighbours together.
NEIGHBOURS = np.zeros((3, 3, 3))
NEIGHBOURS[1, 1, :] = NEIGHBOURS[1, :, 1] = NEIGHBOURS[:, 1, 1] = 1 / 12
NEIGHBOURS[1, 1, 1] = 1 / 2


def near(delta: Float[Tensor, "z y x"]) -> Bool[Tensor, "z y x"]:
    """The voxels inside a specimen and near it; none of an empty volume."""
    magnitude = delta.abs()
    inside = magnitude > INSIDE * magnitude.max()
    return torch.from_numpy(binary_dilation(inside.numpy(), iterations=AROUND))


def noise_deviation(off: Float[Tensor, "refit z y x"]) -> Float[Tensor, "z y x"]:
    """Standard deviation of each voxel by noise. off: how far each refit with noise lies from that without."""
    squares = off.square().mean(0).numpy()
    pooled = convolve(squares, NEIGHBOURS.astype(squares.dtype), mode="nearest")
    return torch.from_numpy(pooled).clamp_min(0).sqrt()


def noise_interval(off: Float[Tensor, "refit z y x"], where: Bool[Tensor, "z y x"]) -> float:
    """How many standard deviations of voxels hold 68 % of what noise does: 1 if it were normal.

    off: as in `noise_deviation`; each refit is compared with the others. where: voxels that count. 1 too where nothing
    has moved, and of fewer than two refits, which don't tell.
    """
    if len(off) < 2:
        return 1.0
    ratios = []
    for place, moved_by in enumerate(off):
        expected = noise_deviation(torch.cat([off[:place], off[place + 1 :]]))
        moved = where & ((moved_by != 0) | (expected > 0))
        ratios.append((moved_by.abs() / expected.clamp_min(torch.finfo(off.dtype).tiny))[moved])
    together = torch.cat(ratios).numpy()
    return float(np.quantile(together, HELD)) if together.size else 1.0


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """How far an estimate's voxels are off, from how the estimate varies around them.

    grid: of the volumes. finest: length of the finest detail across z, µm. weights: of the local variances, and of Δn².
    """

    grid: Grid
    finest: float
    weights: NDArray[np.floating]

    @classmethod
    def of_copies(cls, copies: Sequence[Refit], grid: Grid, finest: float) -> "ErrorModel | None":
        """The model that explains the errors of turned copies; None where these hold nothing to learn from."""
        terms, squares = [], []
        for refit in copies:
            assert refit.truth is not None
            where = (near(refit.delta) | near(refit.truth)).numpy()
            terms.append(_terms(refit.delta, grid, finest)[:, where])
            squares.append((refit.delta - refit.truth).double().square().numpy()[where])
        if not terms or not any(part.any() for part in squares):
            return None
        columns, squared = np.concatenate(terms, 1).T, np.concatenate(squares)
        size = np.maximum(columns.mean(0), np.finfo(float).tiny)
        weights = nnls(columns / size, squared)[0] / size
        predicted = columns @ weights
        known = predicted > 0
        if not known.any():
            return None
        factor = np.quantile(squared[known] / predicted[known], HELD)
        return cls(grid, finest, weights * factor)

    def deviation(self, delta: Float[Tensor, "z y x"]) -> Float[Tensor, "z y x"]:
        """How far an estimate's voxels are off, as a standard deviation."""
        squares = np.tensordot(self.weights, _terms(delta, self.grid, self.finest), 1)
        return torch.from_numpy(np.sqrt(squares)).to(delta)


def _terms(delta: Float[Tensor, "z y x"], grid: Grid, finest: float) -> NDArray[np.floating]:
    """Local variances of a volume in each window, and Δn²: (term, z, y, x), float64."""
    values, spacing = delta.double().numpy(), np.array(grid.spacing)
    found = []
    for window in WINDOWS:
        widths = window * finest / spacing
        mean = gaussian_filter(values, widths)
        found.append(np.clip(gaussian_filter(values**2, widths) - mean**2, 0, None))
    return np.stack([*found, values**2])
