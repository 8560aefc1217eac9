"""Priors of edges: there are few of them, or none."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from recon.prior.base import Majorant, Prior
from recon.prior.schedule import held_then_annealed
from torchdic import Volume

# Rounds off the corner of |∇Δn| at 0. It is far below any contrast that DIC sees.
SMOOTHING = 1e-6

# Edges from this share of the specimen's Δn on count less than in proportion to their height.
EDGE = 0.25

# A gradient is taken at four corners of each voxel, by the differences along z, y and x to the next voxel (0) or to the
# previous one (1). At one corner alone, edges that face it would cost less than others, and surfaces come out rough.
CORNERS = ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 0))


def gradient_length(
    delta: Float[Tensor, "z y x"], spacing: tuple[float, float, float]
) -> Float[Tensor, "corner z y x"]:
    """|∇Δn| at each of the CORNERS times the spacing along x, at least SMOOTHING: (corner, z, y, x), differentiable.

    delta: Δn (z, y, x). spacing: of its voxels (z, y, x), µm.
    """
    squares = delta.new_full((len(CORNERS), *delta.shape), SMOOTHING**2)
    for axis, step in enumerate(spacing):
        if delta.shape[axis] > 1:
            onward = delta.diff(dim=axis, append=delta.narrow(axis, -1, 1)) * (spacing[2] / step)
            both = onward.square(), onward.roll(1, axis).square()
            squares = squares + torch.stack([both[corner[axis]] for corner in CORNERS])
    return squares.sqrt()


def total_variation(delta: Float[Tensor, "z y x"], spacing: tuple[float, float, float]) -> Float[Tensor, ""]:
    """Mean of |∇Δn| over voxels and corners, times the spacing along x."""
    return gradient_length(delta, spacing).mean()


@dataclass(frozen=True)
class Edges(Prior):
    """What the priors of edges share: a weight that is held and then annealed, as `held_then_annealed` says.

    first, last: the weight. With a weight that follows the noise, both are 1.
    """

    first: float = 1.0
    last: float = 1.0

    def weight(self, step: int, steps: int) -> float:
        """The weight at one of the steps."""
        return held_then_annealed(step, steps, self.first, self.last)


@dataclass(frozen=True)
class TotalVariation(Edges):
    """Few and sharp edges: `total_variation` of Δn."""

    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """Total variation of the volume's Δn."""
        return total_variation(volume.delta, volume.grid.spacing)

    def majorant(self, volume: Volume) -> Majorant:
        """It is its own."""
        return Majorant(edges=1.0)


def among_neighbours(lengths: Float[Tensor, "corner z y x"]) -> Float[Tensor, "z y x"]:
    """The mean over a voxel's corners and its neighbours across, weighted 1, 2, 1 along y and along x; periodic."""
    mean = lengths.mean(0)
    for axis in (1, 2):
        mean = (2 * mean + mean.roll(1, axis) + mean.roll(-1, axis)) / 4
    return mean


@dataclass(frozen=True)
class LogTotalVariation(Edges):
    """Few edges, however high, that form surfaces: mean ε·log(1 + l/ε), with l = |∇Δn| `among_neighbours`.

    Total variation takes a part of every edge's height; this takes less the higher the edge is. A voxel that stands out
    alone shares its edge with neighbours that have none, and pays nearly as much for it as in total variation. So the
    noise's specks don't become edges, while surfaces do, which go on from voxel to voxel. ε is EDGE of the specimen's
    contrast, so that the prior is the same for weak and strong specimens.

    width: ε; None, before the contrast is known, is plain total variation.

    E. J. Candès, M. B. Wakin and S. P. Boyd, J. Fourier Anal. Appl. 14, 877 (2008); of groups that overlap: P.-Y. Chen
    and I. W. Selesnick, IEEE Trans. Signal Process. 62, 3464 (2014).
    """

    width: float | None = None

    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """The term's value without its weight."""
        lengths = gradient_length(volume.delta, volume.grid.spacing)
        if self.width is None:
            return lengths.mean()
        return self.width * torch.log1p(among_neighbours(lengths) / self.width).mean()

    def majorant(self, volume: Volume) -> Majorant:
        """The tangent of the logarithm: total variation weighted by 1/(1 + l/ε), `among_neighbours` once more."""
        if self.width is None:
            return Majorant(edges=1.0)
        lengths = among_neighbours(gradient_length(volume.delta, volume.grid.spacing))
        return Majorant(edges=among_neighbours((1 / (1 + lengths / self.width))[None]))

    def at_contrast(self, contrast: float) -> Prior:
        """With ε for a specimen of this contrast."""
        return replace(self, width=EDGE * contrast) if contrast > 0 else self


@dataclass(frozen=True)
class Smoothness(Edges):
    """No edges, for graded specimens: mean |∇Δn|²/(2ε), with ε as in `LogTotalVariation`.

    width: ε; None, before the contrast is known, is 0.01.
    """

    width: float | None = None

    def __call__(self, volume: Volume) -> Float[Tensor, ""]:
        """The term's value without its weight."""
        return gradient_length(volume.delta, volume.grid.spacing).square().mean() / (2 * (self.width or 0.01))

    def majorant(self, volume: Volume) -> Majorant:
        """It is its own."""
        return Majorant(rough=1 / (self.width or 0.01))

    def at_contrast(self, contrast: float) -> Prior:
        """With ε for a specimen of this contrast."""
        return replace(self, width=EDGE * contrast) if contrast > 0 else self
