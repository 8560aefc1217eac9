"""Far from focus light leaves the array: estimated, warned about, and held by the padding that the warning names."""

import re
import warnings

import pytest
import torch

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.wrap_around import UNREMARKED, WrapAroundWarning

GRID = Grid((3, 24, 20), (0.4, 0.25, 0.25))
MICROSCOPE = Microscope(0.546, Objective(0.5), Condenser(0.2, torch.tensor([[0.0, 0.0], [0.1, -0.15]])))


def specimen():
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    return Volume(GRID, (0.03 * torch.exp(-(y**2 + x**2) / 0.3)).expand(GRID.shape).contiguous(), 1.36)


def seen(propagation, focus, padding=0):
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0)], [focus])
    return image(specimen(), MICROSCOPE, acquisition, Fidelity(propagation, padding=padding))


@pytest.mark.parametrize("focus", [16.0, -40.0])
def test_named_padding_holds_the_light(propagation, focus):
    with pytest.warns(WrapAroundWarning) as caught:
        wrapped = seen(propagation, focus)
    line = str(caught[0].message)
    padding = int(re.search(r"(\d+) more voxels of padding", line)[1])
    part = float(re.search(r"([\d.]+) % of the light", line)[1]) / 100
    assert UNREMARKED < part < 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", WrapAroundWarning)
        held, wide = seen(propagation, focus, padding), seen(propagation, focus, 3 * padding)
    # what wraps changes an image by about the root of its part of the light
    assert 0.2 < float((wrapped - wide).abs().max()) / part**0.5 < 5
    assert float((held - wide).abs().max()) < 2 * UNREMARKED**0.5


@pytest.mark.parametrize("focus", [0.0, 3.0, -3.0])
def test_light_within_the_array_is_not_remarked(propagation, focus):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        seen(propagation, focus)


def test_empty_field_wraps_nothing(propagation):
    volume = Volume(GRID, torch.zeros(GRID.shape), 1.36)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image(volume, MICROSCOPE, Acquisition(focus=[500.0]), Fidelity(propagation))
