"""A field cut into tiles: they cover it, count as the whole does, and their fits together are the fit of the whole."""

import errno
import json
import math
from collections import deque
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from distant import Device, bring, send
from hypothesis import given, settings
from hypothesis import strategies as st
from results import BESIDE
from test_reconstruct import command, content, interrupt_at, volume

from recon.config.reading import load
from recon.config.schema import ConfigError
from recon.descend import Problem, Recipe, minimise
from recon.fit.nuisances.light import Lamp
from recon.fit.setup import Setup, empty_medium
from recon.fit.step import Step
from recon.misfit.gaussian import GaussianMisfit
from recon.misfit.poisson import PoissonMisfit
from recon.misfit.robust import RobustMisfit
from recon.prior.base import contrast
from recon.prior.weight import record
from recon.recording.noise import NoiseModel
from recon.run import recorded
from recon.run.tiles import kept as kept_room
from recon.run.tiles import sizes
from recon.run.tiles.fitting import TiledFit, tiles_to_fit
from recon.run.tiles.sizes import cut_of, least_side, margin_of_tiles
from recon.tiling import leaders as leaders_room
from recon.tiling.blending import blended_images, blended_volume
from recon.tiling.layout import ALIGNED, Axis, Layout
from recon.tiling.leaders import leaders, strongest_first
from recon.tiling.part import (
    finding_of,
    gone_on_with,
    lacks,
    problem_of_tile,
    without_margin,
)
from recon.tiling.shared import Finding, LearnedByFirst, SharedPriors
from torchdic import (
    Acquisition,
    Camera,
    Condenser,
    Fidelity,
    Grid,
    Microscope,
    Objective,
    Prism,
    ShortOfMemoryError,
    Volume,
)
from torchdic.files.stack import write_stack

NOISE = 0.004


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


# --- layout ----------------------------------------------------------------------------------------------------------


@given(
    pixels=st.integers(1, 500),
    ratio=st.sampled_from([1.0, 2.0, 0.5, 1.5, 1.37, 2.9]),
    side=st.integers(90, 300),
    overlap=st.integers(0, 15),
)
@settings(max_examples=60, deadline=None)
def test_tiles_cover_a_field_and_their_weights_are_one_together(pixels, ratio, side, overlap):
    voxels = math.ceil(pixels * ratio)
    axis = Axis.cut(voxels, int(voxels / ratio + 1e-6), ratio, side, overlap)
    for weights in (axis.weights_of_pixels(), axis.weights_of_voxels()):
        assert torch.allclose(weights.sum(0), torch.ones(weights.shape[1], dtype=torch.float64))
        assert float(weights.min()) >= 0
    of_pixels = axis.weights_of_pixels()
    for row, span in zip(of_pixels, axis.spans, strict=True):
        outside = row.clone()
        outside[span.pixels] = 0
        assert float(outside.abs().max()) == 0  # a tile counts only where it has images
        assert span.pixels.stop - span.pixels.start == axis.size
        assert span.voxels.stop - span.voxels.start == axis.count
    assert axis.spans[0].pixels.start == 0
    assert axis.spans[-1].pixels.stop == axis.pixels


@pytest.mark.parametrize("ratio", [1.0, 2.0, 0.5, 1.5, 1.37])
def test_a_tiles_voxels_lie_behind_its_pixels(ratio):
    voxels = 600
    axis = Axis.cut(voxels, int(voxels / ratio + 1e-6), ratio, 150, 10)
    assert len(axis.spans) > 3
    assert max(axis.away(span.pixels.start) for span in axis.spans) <= ALIGNED


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.9, 3.3, 5.0, 8.0])
@pytest.mark.parametrize("overlap", [4, 10])
def test_the_smallest_tiles_are_tiles_whatever_the_pixels(ratio, overlap):
    field, pixels = Grid((2, 400, 400), (0.3, 0.1, 0.1)), Grid((2, 80, 40), (0.3, 0.1 * ratio, 0.1 * ratio))
    least = Layout.least_side(field, pixels, overlap)
    axis = Layout.of(field, pixels, least, 4, overlap).along_x
    assert torch.allclose(axis.weights_of_pixels().sum(0), torch.ones(40, dtype=torch.float64))
    with pytest.raises(ValueError, match=f"tiles of {least - 1} voxels can't overlap by .*: of {least} they can"):
        Layout.of(field, pixels, least - 1, 4, overlap)


def test_a_tile_that_holds_the_field_is_the_field():
    (span,) = Axis.cut(40, 40, 1.0, 64, 8).spans
    assert (span.pixels, span.voxels) == (slice(0, 40), slice(0, 40))


def layout_of(field, side, margin, overlap):
    return Layout.of(field, field, side, margin, overlap)


def test_the_parts_of_a_volume_make_the_volume_again():
    field = Grid((3, 50, 71), (0.3, 0.1, 0.1))
    layout = layout_of(field, 30, 4, 8)
    whole = torch.randn(field.shape, generator=generator())
    wide = torch.nn.functional.pad(whole, (4,) * 4)
    parts = []
    for tile in layout:
        rows, columns = tile.rows.voxels, tile.columns.voxels
        parts.append((tile, wide[:, rows.start : rows.stop + 8, columns.start : columns.stop + 8]))
    assert torch.allclose(blended_volume(layout, 3, parts), whole, atol=1e-6)
    images = 1 + torch.randn(2, 4, 50, 71, generator=generator(1))
    cut = [(tile, images[..., tile.rows.pixels, tile.columns.pixels]) for tile in layout]
    assert torch.allclose(blended_images(layout, (2, 4), cut), images, atol=1e-6)
    assert torch.equal(blended_images(layout, (2, 4), []), torch.ones(2, 4, 50, 71))  # as an empty medium


# --- misfit ----------------------------------------------------------------------------------------------------------


def kinds(data, mask):
    model = NoiseModel(torch.tensor([1e-4, 2e-4])[:, None, None, None], 1e-3)
    return [
        GaussianMisfit(data, None, mask),
        GaussianMisfit(data, model, mask),
        PoissonMisfit(data, model, mask),
        RobustMisfit(data, torch.tensor([0.01, 0.02]), mask),
    ]


@pytest.mark.parametrize("kind", range(4))
@pytest.mark.parametrize("masked", [False, True])
def test_a_misfit_is_the_mean_of_its_parts(kind, masked):
    """Each part counts by its pixels; edges lose a neighbour, which a noise model sees."""
    data = 1 + 0.05 * torch.randn(2, 3, 20, 16, dtype=torch.float64, generator=generator(2))
    mask = torch.rand(data.shape, generator=generator(3)) > 0.2 if masked else None
    images = 1 + 0.01 * torch.randn(data.shape, dtype=torch.float64, generator=generator(4))
    whole = kinds(data, mask)[kind]
    total = 0.0
    for rows in (slice(0, 8), slice(8, 20)):
        part = whole.part(rows, slice(None), whole)
        # of kind 0 the prisms are averaged, each over its own pixels
        weight = (part.pixels / whole.pixels).mean() if kind == 0 else part.pixels.sum() / whole.pixels.sum()
        total += float(part(images[:, :, rows]) * weight)
    assert total == pytest.approx(float(whole(images)), rel=2e-2 if kind == 1 else 1e-12)


def test_a_prism_of_which_few_pixels_count_in_a_part_counts_there_for_little():
    """As in the whole: a pixel's pull there keeps its ratio to that of any other prism's."""
    data = 1 + 0.05 * torch.randn(2, 3, 20, 16, dtype=torch.float64, generator=generator(2))
    mask = torch.ones(data.shape, dtype=torch.bool)
    mask[1, :, :, :8] = False
    mask[1, 0, 4, 4] = True
    whole = GaussianMisfit(data, None, mask)
    part = whole.part(slice(2, 18), slice(0, 8), whole)
    again = part.part(slice(1, 9), slice(1, 7), part)

    def pulls(misfit, row, column):
        images = misfit.data + 0.1
        images.requires_grad_()
        misfit(images).backward()
        assert torch.equal(misfit.curvature(images) > 0, images.grad > 0)
        assert torch.allclose(misfit.curvature(images) * 0.1, images.grad)
        return float(images.grad[0, 0, row, column] / images.grad[1, 0, row, column])

    expected = pulls(whole, 4, 4)
    assert pulls(part, 2, 4) == pytest.approx(expected)
    assert pulls(again, 1, 3) == pytest.approx(expected)
    noise = [0.01, 0.02]
    residual = torch.tensor(noise, dtype=torch.float64)[:, None, None, None]
    assert part.of_noise(noise) == pytest.approx(float(part(part.data + residual)))


def test_an_empty_part_has_a_misfit_in_the_units_of_another():
    data = torch.ones(1, 2, 8, 16)
    data[..., 8:] += 0.1 * torch.randn(1, 2, 8, 8, generator=generator(5))
    whole = GaussianMisfit(data)
    part = whole.part(slice(None), slice(0, 8), whole)
    assert float(part(torch.ones(1, 2, 8, 8))) == 0
    with pytest.raises(ValueError, match="uniform"):
        whole.part(slice(None), slice(0, 8))
    with pytest.raises(ValueError, match="no scale of the kind gaussian"):
        RobustMisfit(data, torch.tensor([0.1]), None, whole)


# --- problems --------------------------------------------------------------------------------------------------------

FIELD = Grid((5, 24, 64), (0.4, 0.17, 0.17))
MICROSCOPE = Microscope(0.546, Objective(0.9), Condenser(0.6))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), Prism((0.24, 0.0), -1.5)], focus=[-1.0, 0.0, 1.0])
FIDELITY = Fidelity(sources=18)


def scene():
    """Δn of three balls, one of which lies on the cut between two tiles."""
    z, y, x = (FIELD.coordinates(axis) for axis in range(3))
    delta = torch.zeros(FIELD.shape)
    for cy, cx, radius, high in ((0.2, -3.4, 0.8, 0.02), (-0.3, 0.1, 0.9, 0.015), (0.1, 3.2, 0.7, 0.02)):
        distance = (z[:, None, None] ** 2 + (y[:, None] - cy) ** 2 + (x - cx) ** 2).sqrt()
        delta = torch.maximum(delta, high * torch.sigmoid((radius - distance) / 0.06))
    return delta


@pytest.fixture(scope="module")
def field():
    """The problem of a whole field and its truth."""
    truth = scene()
    with torch.no_grad():
        images = Setup(Volume(FIELD, truth, 1.33), MICROSCOPE, ACQUISITION).images(Fidelity(sources=32, order=2))
    data = images + NOISE * torch.randn(images.shape, generator=generator(6))
    setup = Setup(empty_medium(FIELD, 1.33, data), MICROSCOPE, ACQUISITION)
    return Problem.from_recipe(data, setup, FIDELITY, Recipe(), GaussianMisfit, [NOISE] * 2), truth


def solved(problem):
    return deque(minimise(problem), maxlen=1).pop()


def fitted(whole, layout, out):
    """The field fitted tile by tile, with its tiles kept in a folder."""
    out.mkdir(exist_ok=True)
    tiles = tuple(strongest_first(layout, whole.misfit))
    return TiledFit(whole, layout, tiles, [NOISE] * 2, out, "these tiles", whole.steps)


def distance(found, other):
    return float((found - other).norm() / other.norm())


@pytest.mark.slow
def test_tiles_make_the_volume_that_the_whole_field_makes(field, tmp_path):
    """The second ball is cut in two by the seam."""
    whole, truth = field
    last = solved(whole)
    fit = fitted(whole, layout_of(FIELD, 40, 5, 10), tmp_path)
    step = fit.fitted().ended.step
    assert distance(step.delta, last.delta) < 0.03
    assert distance(step.delta, truth) < 1.1 * distance(last.delta, truth)
    # both tiles have led, and then they have gone by what they say together
    assert [str(visit) for visit in [*fit.leading, *fit.following]] == ["1-1", "1-2", "1-1 again", "1-2 again"]
    own = [fit.found(visit).step for visit in fit.leading]
    assert len({each.weights[-1]["tv"] for each in own}) == 2
    for visit in fit.last:
        assert {each["tv"] for each in fit.found(visit).step.weights} == {fit.priors.weight}
    assert step.weights[-1]["tv"] == fit.priors.weight


def learned_of(whole):
    """What a first tile may say of a field."""
    return LearnedByFirst(whole.misfit, {"brightness": torch.full((2, 3), 1.02)})


def test_a_leader_finds_its_own_weight_in_its_own_scale(field):
    whole, _ = field
    layout = layout_of(FIELD, 40, 5, 10)
    first, second = strongest_first(layout, whole.misfit)
    own = problem_of_tile(whole, layout, first, [NOISE] * 2)
    assert len(own.unknowns) == len(whole.unknowns)
    # the tile's own noise, in the unit of its own variance
    assert own.weight.noise_misfit == pytest.approx(NOISE**2 / float(own.misfit.variance.mean()), rel=0.05)
    learned = learned_of(whole)
    leader = problem_of_tile(whole, layout, second, [NOISE] * 2, learned)
    assert [unknown.name for unknown in leader.unknowns] == ["delta"]
    assert torch.equal(leader.setup.brightness, learned.values["brightness"])
    assert float(leader.misfit.variance.mean()) == pytest.approx(float(leader.misfit.data.var((2, 3)).mean()), rel=0.01)
    for problem in (own, leader):
        assert problem.contrast is None
        assert problem.weight.inside is not None
        assert (problem.weight.first, problem.weight.towards, problem.weight.held) == (None, None, False)


@pytest.mark.slow
def test_tiles_are_fitted_on_another_device_as_on_this_one(field, tmp_path, monkeypatch):
    """As on a GPU: two lead, and go on; what is kept is read onto the CPU."""
    original = kept_room.save

    def saved(path, ended):
        values = {name: bring(value) for name, value in ended.step.values.items()}
        step = replace(ended.step, delta=bring(ended.step.delta), values=values)
        original(path, replace(ended, step=step))

    whole, _ = field
    layout = layout_of(FIELD, 40, 5, 10)
    here = fitted(replace(whole, steps=4), layout, tmp_path / "here").fitted()
    monkeypatch.setattr(kept_room, "save", saved)
    with Device():
        data = send(whole.misfit.data)
        setup = Setup(empty_medium(FIELD, 1.33, data), MICROSCOPE, ACQUISITION)
        there = Problem.from_recipe(data, setup, FIDELITY, Recipe(steps=4), GaussianMisfit, [NOISE] * 2)
        found = fitted(there, layout, tmp_path / "there").fitted()
    assert len(here.record["steps"]) == 2
    assert found.record["steps"] == here.record["steps"]
    assert distance(found.ended.step.delta, here.ended.step.delta) < 1e-4
    assert distance(found.images, here.images) < 1e-4


def test_other_tiles_take_over_what_the_leaders_have_found(field):
    whole, _ = field
    layout = layout_of(FIELD, 40, 5, 10)
    _, second = strongest_first(layout, whole.misfit)
    learned, priors = learned_of(whole), SharedPriors(70.0, 40.0, 0.012)
    problem = problem_of_tile(whole, layout, second, [NOISE] * 2, learned, priors)
    assert [unknown.name for unknown in problem.unknowns] == ["delta"]
    assert (problem.weight.first, problem.weight.towards, problem.contrast) == (40.0, 70.0, 0.012)
    assert not problem.weight.held
    assert torch.equal(problem.setup.brightness, learned.values["brightness"])
    assert torch.equal(problem.misfit.variance, whole.misfit.variance)
    none_found = SharedPriors(None, None, 0.012)
    assert problem_of_tile(whole, layout, second, [NOISE] * 2, learned, none_found).weight.held


def test_a_leader_goes_on_with_the_weight_and_the_contrast_of_all(field):
    """From its own volume, and with its own lamp."""
    whole, truth = field
    whole = replace(whole, unknowns=[*whole.unknowns, Lamp()], steps=1)
    layout = layout_of(FIELD, 40, 5, 10)
    _, second = strongest_first(layout, whole.misfit)
    learned, priors = learned_of(whole), SharedPriors(70.0, 40.0, 0.012)
    problem = problem_of_tile(whole, layout, second, [NOISE] * 2, learned, priors)
    delta = torch.nn.functional.pad(truth, (5, 5, 5, 5))[..., :50].clone()
    lamp = torch.full((2, 5), 0.01)
    last = replace(solved(problem), delta=delta, values={"delta": delta, "lamp": lamp})
    again = gone_on_with(problem, last)
    assert (again.weight.first, again.weight.held, again.contrast) == (70.0, True, 0.012)
    assert torch.equal(again.unknowns[0].given, delta)
    assert torch.equal(again.setup.lamp, lamp)
    assert solved(again).state["newton"]["scale"] == 0.012


def test_leaders_count_by_their_share_of_the_specimen():
    """Δn² of a tile, whose contrast is Σ|Δn|³/Σ|Δn|²: that of all tiles is the mean by their squares."""
    volumes = [0.02 * torch.rand(2, 6, 8, generator=generator(7)), 0.01 * torch.rand(2, 6, 8, generator=generator(8))]
    steps = [
        Step(9, 0.0, 0.0, delta, 0.0, {}, {}, (), (record(0, least, ""), record(9, weight, "")))
        for delta, least, weight in zip(volumes, (10.0, 20.0), (40.0, 90.0), strict=True)
    ]
    findings = [Finding.by(step) for step in steps]
    shared = SharedPriors.by(findings)
    share = float(volumes[0].square().sum() / sum(v.square().sum() for v in volumes))
    assert share > 0.6
    assert shared.weight == pytest.approx(40 * (90 / 40) ** (1 - share))
    assert shared.least == pytest.approx(10 * 2 ** (1 - share))
    assert shared.contrast == pytest.approx(contrast(torch.cat(volumes)))
    # one of them has found no weight, and has no say; where none has, there is none
    none = replace(findings[1], weight=None, least=None)
    assert SharedPriors.by([findings[0], none]).weight == pytest.approx(40.0)
    assert SharedPriors.by([none, none]) == SharedPriors(None, None, none.contrast)
    # of empty tiles all count alike
    empty = [replace(finding, squares=0.0) for finding in findings]
    assert SharedPriors.by(empty).weight == pytest.approx(60.0)


@pytest.mark.parametrize("kind", range(4))
def test_a_leaders_weight_means_the_same_in_the_first_tiles_scale(field, kind):
    """Misfit and priors keep their ratio, whatever the kind of the misfit: both are scaled alike."""
    whole, truth = field
    whole = replace(whole, misfit=kinds(whole.misfit.data, None)[kind])
    tile = list(layout_of(FIELD, 40, 5, 10))[1]
    own, unit = (whole.misfit.part(tile.rows.pixels, tile.columns.pixels, unit) for unit in (None, whole.misfit))
    last = Step(9, 0.0, 0.0, truth, 0.0, {}, {}, (), (record(9, 30.0, ""),))
    found = finding_of(whole, tile, own, last, whole.misfit)
    images = own.data + 0.01 * torch.rand(own.data.shape, generator=generator(9))
    assert found.weight / 30 == pytest.approx(float(unit(images)) / float(own(images)), rel=1e-4)
    assert found.weight != pytest.approx(30.0, rel=0.005)


def test_tiles_lead_that_can_find_a_weight(field, monkeypatch):
    whole, _ = field
    grid = replace(FIELD, shape=(5, 24, 130))
    layout = layout_of(grid, 30, 5, 10)
    noise = NOISE * torch.randn(2, 3, 24, 66, generator=generator(10))
    data = torch.cat([whole.misfit.data, whole.misfit.data.mean((2, 3), keepdim=True) + noise], 3)
    setup = replace(whole.setup, volume=empty_medium(grid, 1.33, data))
    wide = replace(whole, misfit=GaussianMisfit(data), setup=setup)
    tiles = strongest_first(layout, wide.misfit)
    assert len(tiles) > 3
    shown = [tile for tile in tiles if tile.columns.pixels.start < 60]
    assert leaders(wide, tiles) == shown  # noise alone leads nobody
    monkeypatch.setattr(leaders_room, "ENOUGH", 2 * 2 * 3 * 24 * 30 - 1)  # a pixel less than two tiles have
    assert leaders(wide, tiles) == shown[:2]
    assert leaders(replace(wide, weight=None), tiles) == tiles[:1]
    assert leaders(replace(wide, method="adam"), tiles) == tiles[:1]
    # a tile in which the images of a prism are uniform finds nothing by itself, however much the other one shows
    flat = data.clone()
    first = shown[0].columns.pixels
    flat[1, :, :, first] = 0.5
    flat[0, :, :, first] *= 1 + torch.linspace(0, 0.5, 24)[:, None]
    other = replace(wide, misfit=GaussianMisfit(flat))
    again = strongest_first(layout, other.misfit)
    assert again[0] == shown[0]
    assert leaders(other, again)[0] != shown[0]
    assert shown[0] not in leaders(other, again)


def test_a_uniform_tile_among_the_leaders_is_fitted_all_the_same(field, tmp_path):
    """Each tile is fitted once at least, whichever lead."""
    whole, _ = field
    layout = layout_of(FIELD, 30, 5, 10)
    tiles = strongest_first(layout, whole.misfit)
    assert len(tiles) == 3
    data = whole.misfit.data.clone()
    data[1, :, :, tiles[0].columns.pixels] = 1.0
    flat = replace(whole, misfit=GaussianMisfit(data), steps=1)
    fit = TiledFit(flat, layout, tuple(tiles), [NOISE] * 2, tmp_path, "these tiles", 1)
    found = fit.fitted()
    assert fit.leading[0].tile != tiles[0]
    assert fit.others[0].tile == tiles[0]
    assert min(found.record["steps"].values()) == 1


def test_a_field_whose_tiles_all_have_uniform_images_is_refused(field):
    whole, _ = field
    layout = layout_of(FIELD, 30, 5, 10)
    data = torch.ones_like(whole.misfit.data)
    data[0, :, :, 0], data[1, :, :, -1] = 1.1, 1.1
    with pytest.raises(
        ConfigError, match=r"none of 3 tiles can be fitted by itself: in each the images of a prism are"
    ):
        tiles_to_fit(replace(whole, misfit=GaussianMisfit(data)), layout)


def test_the_first_tiles_weight_goes_by_the_pixels_that_count_in_the_field(field):
    """What the others show, as of a specimen beyond the margin, doesn't move it."""
    whole, _ = field
    layout = layout_of(FIELD, 40, 5, 10)
    left, right = layout
    rules = [problem_of_tile(whole, layout, tile, [NOISE] * 2).weight for tile in (left, right)]
    # 16 pixels overlap; beyond the middle quarter of them one tile counts alone
    assert [(rule.inside.rows, rule.inside.columns) for rule in rules] == [
        (slice(0, 24), slice(0, 34)),
        (slice(0, 24), slice(6, 40)),
    ]
    assert [rule.pixels for rule in rules] == [2 * 3 * 24 * 34] * 2
    rule, misfit = rules[0], problem_of_tile(whole, layout, left, [NOISE] * 2).misfit
    images = misfit.data + 0.01
    disturbed = images.clone()
    disturbed[..., 34:] += 1.0
    value, others = (float(misfit(each)) for each in (images, disturbed))
    assert others > 10 * value
    assert rule.heeded(disturbed, others) == pytest.approx(rule.heeded(images, value))
    assert rule.white(disturbed, misfit) == pytest.approx(rule.white(images, misfit))
    assert rule.heeded(images, value) == pytest.approx(value, rel=1e-3)  # in the unit of the whole tile


def test_where_a_prism_has_no_pixel_inside_a_tile_the_weight_goes_by_all(field):
    whole, _ = field
    layout = layout_of(FIELD, 40, 5, 10)
    mask = torch.ones(2, 3, 24, 64, dtype=torch.bool)
    mask[1, :, :, :34] = False
    masked = replace(whole, misfit=GaussianMisfit(whole.misfit.data, None, mask))
    left, right = layout
    assert problem_of_tile(masked, layout, left, [NOISE] * 2).weight.inside is None
    assert problem_of_tile(masked, layout, right, [NOISE] * 2).weight.inside is not None


def test_given_weights_mean_in_a_tile_what_they_mean_in_the_whole(field):
    """Per voxel: the misfit's slope and the priors' keep their ratio, though the tile has a margin."""
    whole, truth = field
    whole = Problem.from_recipe(
        whole.misfit.data, whole.setup, FIDELITY, Recipe(tv=(20.0, 20.0), l1=3.0), GaussianMisfit, [NOISE] * 2
    )
    layout = layout_of(FIELD, 40, 5, 10)
    tile = next(iter(layout))
    part = problem_of_tile(whole, layout, tile, [NOISE] * 2)
    assert part.weight is not None
    sides = part.setup.volume.grid.shape
    assert part.weight.first == pytest.approx(sides[1] * sides[2] / (24 * 40))
    assert part.weight.held

    def slopes(problem, delta):
        """Of misfit and priors, by a voxel in the middle of the tile."""
        delta = delta.clone().requires_grad_()
        setup = problem.unknowns[0].put(delta, problem.setup)
        factor = 1.0 if problem.weight is None else problem.weight.first
        priors = sum(factor * prior.weight(0, 1) * prior(setup.volume) for prior in problem.priors)
        values = problem.misfit(setup.images(FIDELITY)), priors
        return [torch.autograd.grad(value, delta, retain_graph=True)[0] for value in values]

    wide = torch.nn.functional.pad(truth, (5, 5, 5, 5))[:, :, : 40 + 10]
    (misfit, priors), (own_misfit, own_priors) = slopes(whole, truth), slopes(part, wide)
    here, there = (slice(None), slice(9, 15), slice(6, 14)), (slice(None), slice(14, 20), slice(11, 19))
    ratio = float(own_priors[there].norm() / priors[here].norm())
    assert float(own_misfit[there].norm() / misfit[here].norm()) == pytest.approx(ratio, rel=0.05)


@pytest.mark.parametrize("voxels_per_pixel", [1.0, 1.5, 2.0])
def test_a_tile_of_the_true_volume_has_the_images_of_the_field(voxels_per_pixel):
    """Away from the tile's border, where light comes from beside it; a camera's pixels lie where the field's do."""
    side = 0.17 * voxels_per_pixel
    microscope = replace(MICROSCOPE, camera=None if voxels_per_pixel == 1 else Camera(pixel_size=side))
    grid = replace(FIELD, shape=(5, 36, 90))
    truth = torch.nn.functional.pad(scene(), (13, 13, 6, 6))
    with torch.no_grad():
        whole_setup = Setup(Volume(grid, truth, 1.33), microscope, ACQUISITION)
        images = whole_setup.images(FIDELITY)
        setup = Setup(empty_medium(grid, 1.33, images), microscope, ACQUISITION)
        whole = Problem.from_recipe(images, setup, FIDELITY, Recipe(), GaussianMisfit, [NOISE] * 2)
        margin = 12
        layout = Layout.of(grid, setup.pixels, 60, margin, 12)
        assert len(layout) == 2
        wide = torch.nn.functional.pad(truth, (margin,) * 4)
        for tile in layout:
            rows, columns = tile.rows.voxels, tile.columns.voxels
            delta = wide[:, rows.start : rows.stop + 2 * margin, columns.start : columns.stop + 2 * margin]
            part = problem_of_tile(whole, layout, tile, [NOISE] * 2)
            found = part.unknowns[0].put(delta, part.setup).images(FIDELITY)
            off = found - part.misfit.data
            border = round(4 / voxels_per_pixel)
            inner = off[..., border:-border, border:-border]
            assert float(inner.abs().max()) < 0.02 * float((images - images.mean((2, 3), keepdim=True)).abs().max())


def test_a_support_is_cut_with_its_tile(field):
    whole, _ = field
    support = torch.zeros(FIELD.shape, dtype=torch.bool)
    support[:, 6:18, :12] = True
    whole = Problem.from_recipe(
        whole.misfit.data, whole.setup, FIDELITY, Recipe(), GaussianMisfit, [NOISE] * 2, support
    )
    layout = layout_of(FIELD, 40, 5, 10)
    left, right = layout
    part = problem_of_tile(whole, layout, left, [NOISE] * 2)
    assert part.support is not None
    assert torch.equal(part.setup.within_field(part.support), support[..., :40])
    assert lacks(whole, layout, left) is None
    assert lacks(whole, layout, right) == "no Δn is sought"


def test_a_tile_without_a_pixel_that_counts_is_left_out(field):
    whole, _ = field
    mask = torch.ones(whole.misfit.data.shape, dtype=torch.bool)
    mask[..., 24:] = False
    masked = Problem.from_recipe(
        whole.misfit.data, whole.setup, FIDELITY, Recipe(), lambda data: GaussianMisfit(data, None, mask), [NOISE] * 2
    )
    layout = layout_of(FIELD, 40, 5, 10)
    assert [lacks(masked, layout, tile) for tile in layout] == [None, "no pixel counts"]


def test_a_field_with_a_margin_is_cut_without_it(field):
    whole, _ = field
    setup = Setup(empty_medium(FIELD.widened(6, 6), 1.33, whole.misfit.data), MICROSCOPE, ACQUISITION, margin=6)
    support = torch.ones(FIELD.shape, dtype=torch.bool)
    wide = Problem.from_recipe(whole.misfit.data, setup, FIDELITY, Recipe(), GaussianMisfit, [NOISE] * 2, support)
    bare = without_margin(wide)
    assert bare.setup.volume.grid == FIELD
    assert bare.setup.margin == 0
    assert bare.support is not None
    assert bare.support.shape == FIELD.shape


# --- runs ------------------------------------------------------------------------------------------------------------

CONFIG = """
[volume]
shape = [3, 22, 40]
spacing = [0.4, 0.2, 0.2]
background = 1.4
[microscope]
wavelength = 0.546
objective = { na = 0.8 }
condenser = { na = 0.5 }
camera = { photons = 20000 }
[acquisition]
focus = [-0.6, 0.6]
prisms = [{ shear = [0.0, 0.24], bias = 1.5 }, { shear = [0.24, 0.0], bias = 1.5 }]
[specimen]
kind = "bead"
radius = 0.7
contrast = 0.03
[data]
path = "made/stack.ome.tif"
[reconstruction]
steps = 4
tiles = 25
[fidelity]
sources = 2
"""


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with a configuration, its stack, and an uninterrupted run by tiles in `whole`."""
    folder = tmp_path_factory.mktemp("tiles")
    path = folder / "a.toml"
    path.write_text(CONFIG, encoding="utf-8")
    assert command("simulate", path, "--out", folder / "made")[0] == 0
    assert command("reconstruct", path, "--out", folder / "whole")[0] == 0
    return folder


def test_a_run_by_tiles_leaves_what_any_run_leaves(workplace):
    out = workplace / "whole"
    assert set(content(out)) == {
        "volume.ome.tif", "metrics.json", "config.resolved.toml", "images.ome.tif", "images.png", "sections.png",
        "misfit.png", *BESIDE,
    }  # fmt: skip
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["tiles"]["steps"]) == {"1-1", "1-2"}
    assert min(metrics["tiles"]["steps"].values()) > 4  # both have led, and gone on
    assert metrics["weights"][-1]["reason"] == "the leading tiles' mean"
    assert metrics["tv"] == metrics["weights"][-1]["tv"]
    assert metrics["misfit"] < 0.5
    assert volume(out).shape == (3, 22, 40)
    assert load(out / "config.resolved.toml").reconstruction.tiles == 25


@pytest.mark.parametrize(
    ("fit", "number", "tile", "there"),
    [
        pytest.param(0, 3, "1-1", 0, marks=pytest.mark.slow),
        pytest.param(1, 2, "1-2", 1, marks=pytest.mark.slow),
        (2, 2, "1-1 again", 1),
        pytest.param(3, 2, "1-2 again", 1, marks=pytest.mark.slow),
    ],
)
def test_an_interrupted_run_by_tiles_goes_on_where_it_was(workplace, tmp_path, monkeypatch, fit, number, tile, there):
    out, path = tmp_path / "out", workplace / "a.toml"
    interrupt_in_tile(monkeypatch, fit, number)
    code, err = command("reconstruct", path, "--out", out)
    assert code == 130, err
    left = f"go on with --resume; volume.ome.tif holds Δn so far: {there} of 2 tiles, and this one as it is"
    assert f"tile {tile}: interrupted after step {number - 1} of 4; {left}" in err
    assert volume(out).shape == (3, 22, 40)
    code, err = command("reconstruct", path, "--out", out)
    assert code == 2
    assert "an interrupted run; go on with --resume, or begin anew with --restart" in err
    assert command("reconstruct", path, "--out", out, "--resume")[0] == 0
    assert torch.equal(volume(out), volume(workplace / "whole"))


def interrupt_in_tile(patch, tile, number):
    """Make the next run stop with KeyboardInterrupt in one of its fits, counted from 0, when it would take a step."""
    original, begun = recorded.minimise, []

    def minimise(*arguments):
        begun.append(arguments)
        if len(begun) == tile + 1:
            interrupt_at(patch, number)
            patched = recorded.minimise
            patch.setattr(recorded, "minimise", original)
            for step in original(*arguments):
                if step.number == number:
                    raise KeyboardInterrupt
                yield step
            assert patched is not None
        else:
            yield from original(*arguments)

    patch.setattr(recorded, "minimise", minimise)


def test_tiles_of_another_run_are_not_gone_on_with(workplace, tmp_path, monkeypatch):
    out, other = tmp_path / "out", workplace / "other.toml"
    interrupt_in_tile(monkeypatch, 1, 2)
    assert command("reconstruct", workplace / "a.toml", "--out", out)[0] == 130
    other.write_text(CONFIG.replace("steps = 4", "steps = 3"), encoding="utf-8")
    code, err = command("reconstruct", other, "--out", out, "--resume")
    assert code == 2
    assert "belongs to another configuration or other data: reconstruction.steps was 4, is 3" in err
    (out / "tiles" / "layout.json").write_text("{", encoding="utf-8")
    code, err = command("reconstruct", workplace / "a.toml", "--out", out, "--resume")
    assert code == 2
    assert "layout.json: can't be read" in err


@pytest.mark.slow
def test_a_run_by_tiles_in_place_of_a_whole_one_leaves_nothing_of_that(workplace, tmp_path):
    out, other = tmp_path / "out", workplace / "uncut.toml"
    other.write_text(CONFIG.replace("tiles = 25", "tiles = 'none'"), encoding="utf-8")
    assert command("reconstruct", other, "--out", out)[0] == 0
    assert {"log.csv", "checkpoint.pt"} <= set(content(out))
    assert command("reconstruct", workplace / "a.toml", "--out", out, "--restart")[0] == 0
    assert set(content(out)) == set(content(workplace / "whole"))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("tiles = 25", "tiles = 20"), "20 voxels are too few: light goes 4 voxels to the side"),
        (("tiles = 25", "tiles = 0"), "tiles 0 must be at least 1 voxel; 'none' cuts nothing"),
        (("tiles = 25", "tiles = 25\nmethod = 'linear'"), "'linear' solves the whole field at once"),
    ],
)
def test_tiles_that_make_no_sense_are_refused(workplace, tmp_path, change, told):
    path = workplace / "refused.toml"
    path.write_text(CONFIG.replace(*change), encoding="utf-8")
    code, err = command("reconstruct", path, "--out", tmp_path / "out")
    assert code == 2
    assert told in err
    assert not (tmp_path / "out").exists()


def test_a_field_of_which_no_tile_can_be_fitted_is_refused(workplace, tmp_path):
    """Either prism has pixels that count in one tile alone."""
    counts = np.zeros((2, 1, 22, 40), np.uint8)
    counts[0, ..., :12] = counts[1, ..., -12:] = 1
    write_stack(workplace / "mask.tif", counts)
    path = workplace / "masked.toml"
    path.write_text(CONFIG.replace("[data]", "[data]\nmask = 'mask.tif'"), encoding="utf-8")
    code, err = command("reconstruct", path, "--out", tmp_path / "out")
    assert code == 2
    (line,) = (line for line in err.splitlines() if "error" in line)
    assert line.endswith(
        "reconstruction.tiles: none of 2 tiles can be fitted: in tile 1-1 no pixel of prism 2 counts; "
        "take larger tiles, or leave out less of the images"
    )
    assert not (tmp_path / "out").exists()


def test_a_disk_that_is_full_after_the_first_steps_is_told_of_by_the_tile(workplace, tmp_path, monkeypatch):
    """What the tiles are is there by then."""
    replace_, full = Path.replace, []

    def fails(path, target):
        if full:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        full.extend([True] if Path(target).name == "layout.json" else [])
        return replace_(path, target)

    monkeypatch.setattr(Path, "replace", fails)
    code, err = command("reconstruct", workplace / "a.toml", "--out", tmp_path / "out")
    assert code == 2
    assert "fitted.pt: cannot be written: No space left on device; make room and go on with --resume" in err
    monkeypatch.setattr(Path, "replace", replace_)
    assert command("reconstruct", workplace / "a.toml", "--out", tmp_path / "out", "--resume")[0] == 0


def test_error_bars_say_that_a_fit_by_tiles_has_none(workplace):
    code, err = command("error-bars", workplace / "whole")
    assert code == 2
    assert "was fitted by tiles" in err


# --- sizes -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def little_memory(monkeypatch):
    """A function that sets the free memory, in which no whole field has room."""

    def without_room(*_):
        raise ShortOfMemoryError("no room")

    def free(number):
        monkeypatch.setattr(sizes, "free_bytes", lambda _: number)
        # of 400 bytes a voxel
        monkeypatch.setattr(
            sizes, "held_beside_images", lambda problem, *_: 400 * problem.misfit.data[0, 0].numel() * 5
        )
        monkeypatch.setattr(sizes, "check_room_for_descent", without_room)

    return free


def configured(tmp_path, **changes):
    path = tmp_path / "b.toml"
    text = CONFIG.replace("tiles = 25", "\n".join(f"{key} = {value!r}" for key, value in changes.items()))
    path.write_text(text, encoding="utf-8")
    return load(path)


def test_a_field_without_room_is_cut_into_tiles_as_large_as_the_memory(field, tmp_path, little_memory):
    whole, _ = field
    config = configured(tmp_path)
    found = {}
    for free in (12_000_000, 20_000_000):
        little_memory(free)
        cut = cut_of(config, whole, GaussianMisfit, None)
        assert cut is not None
        found[free] = cut.layout.side
        assert cut.memory <= free // 4
        assert cut.problem(whole).fidelity.fidelity.memory == cut.memory
    assert least_side(whole, margin_of_tiles(config)) <= found[12_000_000] < found[20_000_000]
    for free, budget in ((20_000_000, 6_000_000), (12_000_000, 1 << 30)):  # as half of the first; more than is free
        little_memory(free)
        with_budget = cut_of(config, whole, GaussianMisfit, budget)
        assert with_budget is not None
        assert with_budget.layout.side == found[12_000_000]


def test_without_room_for_the_smallest_tiles_a_field_is_refused(field, tmp_path, little_memory):
    little_memory(1_000_000)
    with pytest.raises(ShortOfMemoryError, match="Tiles of 24 voxels and 4 more on each side need at least"):
        cut_of(configured(tmp_path), field[0], GaussianMisfit, None)


def test_tiles_may_be_switched_off(field, tmp_path, little_memory):
    config = configured(tmp_path, tiles="none")
    little_memory(10**9)
    with pytest.raises(ShortOfMemoryError, match="no room"):
        cut_of(config, field[0], GaussianMisfit, None)


def test_a_field_with_room_stays_whole(field, tmp_path):
    assert cut_of(configured(tmp_path), field[0], GaussianMisfit, None) is None
    assert cut_of(configured(tmp_path, tiles=64), field[0], GaussianMisfit, None) is None
