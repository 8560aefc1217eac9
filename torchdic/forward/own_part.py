"""A rank's part of an image: an equal share of the condenser's directions, and where these are few, of the planes too.

An image is a sum over directions, and so is what this gives over the ranks. Of R ranks and S directions, where S < R,
each direction serves ⌊R/S⌋ ranks, which compute its light's way through the specimen alike and form the images of
different focus planes. Ranks that are left over add 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from torchdic.fidelity import Fidelity
from torchdic.instrument.microscope import Acquisition, Microscope
from torchdic.ranks.group import rank, ranks

# Images of (prism, focus, y, x) of a microscope and an acquisition, by the directions of their numbers.
Images = Callable[[Microscope, Acquisition, Sequence[int]], Tensor]


@dataclass(frozen=True)
class OwnPart:
    """What a rank computes. directions, planes: their numbers. idle: whether another rank computes it as well."""

    directions: range
    planes: range
    idle: bool = False

    @classmethod
    def among(cls, directions: int, planes: int, number: int, of: int) -> "OwnPart":
        """The part of rank `number` of `of`."""
        lights = min(of, directions)
        groups = min(of // lights, planes)
        if number >= lights * groups:
            return cls(range(1), range(1), idle=True)
        light, group = number % lights, number // lights
        first, last = (planes * g // groups for g in (group, group + 1))
        return cls(range(light, directions, lights), range(first, last))


def own_part(
    images: Images, microscope: Microscope, acquisition: Acquisition, fidelity: Fidelity, *, axis: int = 1
) -> Tensor:
    """The own part of this rank of a sum over the condenser's directions, such as images (prism, focus, y, x).

    images: computes the sum over some directions, whose weights sum to 1, for some planes. axis: of the planes.
    The sum over all ranks is that over all directions.
    """
    points, weights = microscope.sources(fidelity.sources, dtype=torch.float64)
    planes = len(acquisition.focus)
    part = OwnPart.among(len(points), planes, rank(), ranks())
    chosen = list(part.directions)
    few = replace(acquisition, focus=acquisition.focus[part.planes.start : part.planes.stop])
    found = images(microscope.lit_from(points[chosen], weights[chosen]), few, chosen)
    share = torch.zeros_like(weights[0]) if part.idle else weights[chosen].sum()
    around = [0] * (2 * found.ndim)
    around[-2 * axis - 2 : -2 * axis or None] = part.planes.start, planes - part.planes.stop
    return F.pad(share.to(found) * found, around)
