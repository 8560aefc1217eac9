"""A fit of a tile: the leaders have two."""

from dataclasses import dataclass

from recon.tiling.layout import Tile


@dataclass(frozen=True)
class Visit:
    """One fit of a tile. again: whether it goes on from an earlier one."""

    tile: Tile
    again: bool = False

    def __str__(self) -> str:
        """The tile's row and column, and whether it is fitted again."""
        return f"{self.tile} again" if self.again else str(self.tile)
