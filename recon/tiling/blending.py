"""The volume and the images of a whole field, put together from those of its tiles."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from recon.tiling.layout import Layout, Span, Tile


def blended_volume(
    layout: Layout, slices: int, tiles: Iterable[tuple[Tile, Float[Tensor, "z row column"]]]
) -> Float[Tensor, "z y x"]:
    """Δn of the field, float32 on the CPU; what no tile covers is 0.

    slices: of the volume. tiles: each with its Δn, its margin included; one is held at a time.
    """
    along_y, along_x, margin = layout.along_y, layout.along_x, layout.margin
    weights_y, weights_x = along_y.weights_of_voxels(), along_x.weights_of_voxels()
    whole = torch.zeros(slices, along_y.voxels, along_x.voxels)
    for tile, delta in tiles:
        there_y, own_y = _within(tile.rows, margin, along_y.voxels)
        there_x, own_x = _within(tile.columns, margin, along_x.voxels)
        row, column = tile.place
        weight = weights_y[row, there_y, None] * weights_x[column, there_x]
        whole[:, there_y, there_x] += weight.to(whole) * delta[:, own_y, own_x].to(whole)
    return whole


def blended_images(
    layout: Layout, stack: tuple[int, int], tiles: Iterable[tuple[Tile, Float[Tensor, "prism focus row column"]]]
) -> Float[Tensor, "prism focus y x"]:
    """The images of the field, float32 on the CPU; what no tile covers is 1, as an empty medium.

    stack: prisms and planes. tiles: each with its images; one is held at a time.
    """
    weights_y, weights_x = layout.along_y.weights_of_pixels(), layout.along_x.weights_of_pixels()
    whole = torch.ones(*stack, layout.along_y.pixels, layout.along_x.pixels)
    for tile, images in tiles:
        rows, columns = tile.rows.pixels, tile.columns.pixels
        weight = weights_y[tile.place[0], rows, None] * weights_x[tile.place[1], columns]
        whole[..., rows, columns] += weight.to(whole) * (images.to(whole) - 1)
    return whole


def _within(span: Span, margin: int, voxels: int) -> tuple[slice, slice]:
    """Where a tile with its margin lies within the field, and which part of it does."""
    start, stop = span.voxels.start - margin, span.voxels.stop + margin
    first, last = max(start, 0), min(stop, voxels)
    return slice(first, last), slice(first - start, last - start)
