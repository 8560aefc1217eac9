"""Far from focus light leaves the array: estimated, warned about, and held by the padding that the warning names."""

import math
import re
import warnings

import pytest
import torch

from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image, image_field
from torchdic.errors import WrapAroundWarning
from torchdic.imaging.wrap_around import UNREMARKED

GRID = Grid((3, 24, 20), (0.4, 0.25, 0.25))
MICROSCOPE = Microscope(0.546, Objective(0.5), Condenser(0.2, torch.tensor([[0.0, 0.0], [0.1, -0.15]])))


def specimen():
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    return Volume(GRID, (0.03 * torch.exp(-(y**2 + x**2) / 0.3)).expand(GRID.shape).contiguous(), 1.36)


def seen(propagation, focus, padding=0, **options):
    acquisition = Acquisition([Prism((0.1, 0.2), 1.0)], [focus])
    return image(specimen(), MICROSCOPE, acquisition, Fidelity(propagation, padding=padding, **options))


@pytest.mark.parametrize(
    ("propagation", "focus"),
    [
        pytest.param(way, focus, marks=pytest.mark.slow if way == "rays" and focus != 16.0 else ())
        for focus in (16.0, -40.0)
        for way in ("projection", "rays", "wave")
    ],
)
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


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
@pytest.mark.parametrize(
    ("propagation", "focus", "gain"),
    [
        pytest.param(way, *case, marks=pytest.mark.slow if way == "rays" and case != (16.0, 1.3) else ())
        for case in ((16.0, 1.3), (-40.0, 2.5), (80.0, 3.0))
        for way in ("projection", "rays", "wave")
    ],
)
def test_band_limit_is_nearer_to_the_wide_array_and_the_more_so_the_farther(propagation, focus, gain):
    """A specimen alone: its light that left belongs nowhere in the array, against one wide enough to hold it all."""
    wide = seen(propagation, focus, padding=math.ceil(0.45 * abs(focus) / 0.25) + 40)
    wrapped, limited = (
        float((seen(propagation, focus, band_limit=limit) - wide).abs().max()) for limit in (False, True)
    )
    assert gain * limited < wrapped


def test_band_limit_is_no_part_of_an_image_whose_light_stays(propagation):
    assert torch.equal(seen(propagation, 3.0, band_limit=True), seen(propagation, 3.0))


def test_band_limit_leaves_an_empty_field_as_it_is(propagation):
    volume = Volume(GRID, torch.zeros(GRID.shape, dtype=torch.float64), 1.36)
    fidelity = Fidelity(propagation, band_limit=True)
    images = image(volume, MICROSCOPE, Acquisition([Prism((0.1, 0.2), 1.0), None], [500.0]), fidelity)
    expected = torch.tensor([math.sin(0.5) ** 2, 1.0], dtype=torch.float64)
    torch.testing.assert_close(images, expected[:, None, None, None].expand_as(images), rtol=0, atol=1e-14)


@pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")
def test_periodic_specimen_repeats_itself_at_talbots_distance_unless_it_is_limited():
    """A grating's image comes back at λ/(n0 − √(n0² − (λ/period)²)): light that wraps around is its neighbours'."""
    grid = Grid((1, 1, 24), (0.4, 0.25, 0.25))
    period = grid.extent[2] / 2
    _, x = grid.frequencies(dtype=torch.float64)[0], grid.coordinates(2, dtype=torch.float64)
    field = (1 + 0.1 * torch.cos(2 * math.pi * x / period))[None]
    talbot = 0.546 / (1.36 - math.sqrt(1.36**2 - (0.546 / period) ** 2))

    def of(focus, limit):
        microscope, fidelity = Microscope(0.546, Objective(0.5)), Fidelity(band_limit=limit)
        return image_field(field, grid, microscope, Acquisition(focus=[focus]), background=1.36, fidelity=fidelity)

    assert talbot * 0.546 / period > grid.extent[2] / 2
    torch.testing.assert_close(of(talbot, False), of(0.0, False), rtol=0, atol=1e-12)
    assert float((of(talbot, True) - of(0.0, True)).abs().max()) > 0.1


def test_light_that_is_cut_is_that_which_the_warning_names():
    """Of the light that the pupil passes, by Parseval: the mean of the bright field falls by it."""
    microscope, acquisition = Microscope(0.546, Objective(0.5)), Acquisition(focus=[-40.0])

    def mean(limit):
        fidelity = Fidelity("projection", band_limit=limit)
        with pytest.warns(WrapAroundWarning) as caught:
            images = image(specimen(), microscope, acquisition, fidelity)
        return float(images.mean()), str(caught[0].message)

    (whole, wraps), (rest, is_cut) = mean(False), mean(True)
    part = float(re.search(r"([\d.]+) % of the light leaves the array and is cut", is_cut)[1]) / 100
    advice = ", and band_limit = true would cut it"
    assert wraps == is_cut.replace("is cut", "comes back in at the opposite side") + advice
    assert part > UNREMARKED
    # named to two digits
    assert 1 - rest / whole == pytest.approx(part, rel=0.05)


def test_an_image_in_batches_warns_once_and_its_gradient_not_again():
    """Of the worst batch: the two sources' light spreads differently."""
    volume = specimen()
    volume = Volume(GRID, volume.delta.requires_grad_(), 1.36)
    acquisition = Acquisition([None], [40.0])
    parts = []
    for batch in (1, 2):
        with pytest.warns(WrapAroundWarning) as caught:
            images = image(volume, MICROSCOPE, acquisition, Fidelity("projection", memory=1 if batch == 1 else 1 << 40))
        assert len(caught) == 1
        parts.append(float(re.search(r"([\d.]+) % of the light", str(caught[0].message))[1]))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            images.sum().backward()
    assert parts[0] >= parts[1]
