"""Which tiles are fitted first, and which of them lead: by how much their images show."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from recon.fit.problem import Problem
from recon.misfit.base import Misfit, UniformImagesError
from recon.misfit.level import image_means
from recon.tiling.layout import Layout, Tile

# Pixels of all images that the leaders have together, if there are so many: their noise, by which the weight goes, is
# known to √(2/pixels), a tenth of a per cent. A leader costs its tile about half as many steps again.
ENOUGH = 1_500_000

# A leader shows at least this share of what the first one shows beyond the noise. An empty tile finds nothing.
LEADS = 0.1


def strongest_first(layout: Layout, misfit: Misfit) -> list[Tile]:
    """The tiles in the order in which they are fitted: by how much their images show."""
    power = _power(misfit)
    return sorted(layout, key=lambda tile: _shown(power, tile), reverse=True)


def leaders(whole: Problem, tiles: Sequence[Tile]) -> list[Tile]:
    """Those of some tiles that find what all share, the first tile first; none where each has uniform images.

    One leads where there is no weight to be found, or where the descent can't go on from a volume: Adam's rate has
    fallen to nothing by the end of its steps. whole: as in `lacks`. tiles: as `strongest_first` has them.
    """
    if whole.weight is None:
        return list(tiles[:1])
    power = _power(whole.misfit) - (whole.weight.noise_misfit or 0.0)
    found: list[Tile] = []
    pixels = 0
    for tile in tiles:
        if found and (pixels >= ENOUGH or whole.method != "newton"):
            break
        if _is_uniform(whole.misfit, tile):
            continue
        if found and _shown(power, tile) <= LEADS * max(_shown(power, found[0]), 0.0):
            break
        found.append(tile)
        pixels += whole.misfit.data[..., tile.rows.pixels, tile.columns.pixels].numel()
    return found


def _power(misfit: Misfit) -> Float[Tensor, "y x"]:
    """What the images show at each pixel: the square of their contrast, over its mean."""
    contrast = misfit.where_counted(misfit.data - image_means(misfit.data, misfit.mask)).square()
    return (contrast / misfit.variance).mean((0, 1))


def _shown(power: Float[Tensor, "y x"], tile: Tile) -> float:
    """What the images of a tile show together."""
    return float(power[tile.rows.pixels, tile.columns.pixels].sum())


def _is_uniform(misfit: Misfit, tile: Tile) -> bool:
    """Whether the images of a prism are uniform in a tile."""
    try:
        misfit.part(tile.rows.pixels, tile.columns.pixels)
    except UniformImagesError:
        return True
    return False
