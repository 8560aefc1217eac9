"""Priors: their values, their majorants, and what they say of specimens of other contrasts and voxels."""

import math
from dataclasses import replace

import pytest
import torch

from data_synthetic import GaussianBall
from recon.prior.base import Majorant, Prior, contrast, weighted
from recon.prior.edges import (
    EDGE,
    SMOOTHING,
    LogTotalVariation,
    Smoothness,
    TotalVariation,
    among_neighbours,
    gradient_length,
    total_variation,
)
from recon.prior.magnitude import Magnitude
from recon.prior.schedule import held_then_annealed
from torchdic import Grid, Volume

BACKGROUND = 1.5
GRID = Grid((4, 6, 5), (0.5, 0.2, 0.2))
CONTRAST = 0.02
PRIORS = {
    "tv": TotalVariation(),
    "log-tv": LogTotalVariation().at_contrast(CONTRAST),
    "log-tv of unknown contrast": LogTotalVariation(),
    "smooth": Smoothness().at_contrast(CONTRAST),
    "smooth of unknown contrast": Smoothness(),
    "magnitude": Magnitude(0.25),
}
# Shares of an edge that lies between two voxels, of the voxels that it counts in: half at the corners of each, and
# weights 1, 2, 1 across.
SHARES = ((1 / 2, 1 / 2), (1 / 8, 3 / 8, 3 / 8, 1 / 8), (1 / 8, 3 / 8, 3 / 8, 1 / 8))
each = pytest.mark.parametrize("prior", PRIORS.values(), ids=PRIORS)


def volume_of(delta, grid=GRID):
    return Volume(grid, delta, BACKGROUND)


def drawn(scale=CONTRAST, grid=GRID):
    return scale * torch.randn(grid.shape, dtype=torch.float64)


def value(majorant, delta, grid=GRID):
    """The majorant's sum at a Δn."""
    length = gradient_length(delta, grid.spacing)
    total = majorant.edges * length + majorant.sparse * delta.abs() + majorant.rough / 2 * length.square()
    return float(total.mean())


def one_step(height, axis):
    """A step half way along one axis, in a volume of the grid's size."""
    delta = torch.zeros(GRID.shape, dtype=torch.float64)
    size = GRID.shape[axis]
    delta.narrow(axis, size // 2, size - size // 2).fill_(height)
    return delta


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_step_counts_by_its_height_over_the_voxels_across_it(axis):
    """The mean over all voxels, of which 1 in each line along the axis has an edge; along z by 0.2/0.5."""
    height, edges = 0.03, 1 / GRID.shape[axis]
    jump = height * GRID.spacing[2] / GRID.spacing[axis]
    volume, eps = volume_of(one_step(height, axis)), EDGE * CONTRAST
    empty = volume_of(torch.zeros(GRID.shape, dtype=torch.float64))

    def found(prior):
        """Without what the rounded corner gives to an empty volume."""
        return float(prior(volume) - prior(empty))

    assert found(TotalVariation()) == pytest.approx(edges * jump, rel=2e-3)
    shares = SHARES[axis]
    expected = sum(eps * math.log(1 + share * jump / eps) for share in shares) * edges
    assert found(PRIORS["log-tv"]) == pytest.approx(expected, rel=2e-3)
    assert found(PRIORS["smooth"]) == pytest.approx(edges * jump**2 / (2 * eps), rel=2e-3)
    assert found(PRIORS["smooth of unknown contrast"]) == pytest.approx(edges * jump**2 / 0.02, rel=2e-3)


def test_the_length_of_a_gradient_is_that_of_all_axes():
    delta = torch.zeros(GRID.shape, dtype=torch.float64)
    delta[1, 2, 2] = 0.05
    # at each corner the voxel itself has all three differences, and three neighbours have one each
    expected = 0.05 * (math.sqrt(2 + 0.4**2) + 1 + 1 + 0.4) / math.prod(GRID.shape)
    assert float(total_variation(delta, GRID.spacing)) == pytest.approx(expected + SMOOTHING, rel=1e-3)


def test_a_mirrored_section_has_the_same_total_variation():
    """With gradients at one corner alone, edges that face it would cost less."""
    section = drawn()[:1]
    usual = float(total_variation(section, GRID.spacing))
    for axes in ((1,), (2,), (1, 2)):
        assert float(total_variation(section.flip(axes), GRID.spacing)) == pytest.approx(usual, rel=1e-12)
    volume = drawn()
    usual = float(total_variation(volume, GRID.spacing))
    for axes in ((0, 1), (0, 2), (1, 2)):
        assert float(total_variation(volume.flip(axes), GRID.spacing)) == pytest.approx(usual, rel=1e-12)


def test_the_magnitude_is_the_mean_size():
    delta = torch.zeros(GRID.shape, dtype=torch.float64)
    delta[0, 0, 0], delta[1, 1, 1] = 0.3, -0.1
    assert float(Magnitude(1.0)(volume_of(delta))) == pytest.approx(0.4 / math.prod(GRID.shape))


def test_an_axis_of_one_voxel_has_no_differences():
    grid = Grid((1, 6, 5), (0.5, 0.2, 0.2))
    assert float(TotalVariation()(volume_of(torch.full(grid.shape, 0.1), grid))) == pytest.approx(SMOOTHING, rel=1e-3)


@each
def test_a_majorant_touches_its_prior_and_lies_above_it_elsewhere(prior):
    here = drawn()
    majorant, at = prior.majorant(volume_of(here)), float(prior(volume_of(here)))
    constant = at - value(majorant, here)
    for scale in (0.1, 0.5, 1.0, 3.0):
        there = drawn(scale * CONTRAST)
        assert value(majorant, there) + constant >= float(prior(volume_of(there))) - 1e-12
    near = here + 1e-6 * drawn()
    slope = (float(prior(volume_of(near))) - at) / 1e-6
    assert (value(majorant, near) - value(majorant, here)) / 1e-6 == pytest.approx(slope, rel=1e-3)


@each
def test_its_gradient_is_that_of_differences(prior):
    delta = drawn().requires_grad_()
    assert torch.autograd.gradcheck(lambda d: prior(volume_of(d)), (delta,), eps=1e-8, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("factor", [0.1, 7.0])
@pytest.mark.parametrize("prior", [TotalVariation(), LogTotalVariation(), Smoothness(), Magnitude(1.0)], ids=str)
def test_a_prior_for_its_contrast_is_proportional_to_it(prior, factor):
    """So that one weight serves data of any contrast: misfit·contrast stays."""
    delta = 2 * torch.rand(GRID.shape, dtype=torch.float64)  # far above the rounded corner, which isn't scaled
    one = float(prior.at_contrast(contrast(delta))(volume_of(delta)))
    other = float(prior.at_contrast(contrast(factor * delta))(volume_of(factor * delta)))
    assert other == pytest.approx(factor * one, rel=1e-4)


@pytest.mark.parametrize("prior", [LogTotalVariation(), Smoothness()], ids=["log-tv", "smooth"])
def test_a_contrast_of_0_leaves_a_prior_as_it_is(prior):
    assert prior.at_contrast(0.0) == prior
    assert prior.at_contrast(0.02) == replace(prior, width=EDGE * 0.02)


@pytest.mark.parametrize("prior", [TotalVariation(), LogTotalVariation(width=0.007)], ids=["tv", "log-tv"])
def test_voxels_half_as_high_leave_the_prior_of_a_smooth_object_alone(prior):
    """A mean over the voxels of |∇Δn|·dx, in which dx alone is a length."""
    coarse, fine = (Grid((n, 24, 24), (6.0 / n, 0.25, 0.25)) for n in (24, 48))
    ball = GaussianBall(0.8, 0.05, BACKGROUND)
    values = [float(prior(volume_of(ball.delta(grid, dtype=torch.float64), grid))) for grid in (coarse, fine)]
    assert values[1] == pytest.approx(values[0], rel=0.02)


def test_a_logarithm_takes_less_of_high_edges():
    low, high = (volume_of(one_step(h, 2)) for h in (0.001, 0.1))
    log, tv = LogTotalVariation(width=0.007), TotalVariation()
    assert float(log(low) / tv(low)) > 0.9
    assert float(log(high) / tv(high)) < 0.5
    weights = log.majorant(high).edges
    assert isinstance(weights, torch.Tensor)
    outer, inner = (1 / (1 + share * 0.1 / 0.007) for share in SHARES[2][:2])
    assert float(weights.max()) == pytest.approx((1 + outer) / 2, rel=1e-3)  # with the edge on both sides, periodic
    assert float(weights.min()) == pytest.approx((3 * inner + outer) / 4, rel=1e-3)


def test_a_voxel_that_stands_out_alone_pays_more_of_its_edge_than_a_surface():
    """So that the noise's specks don't become edges. By each corner's own logarithm it would pay less."""
    speck = torch.zeros(GRID.shape, dtype=torch.float64)
    speck[2, 3, 2] = 0.04
    log, tv, eps = LogTotalVariation(width=0.01), TotalVariation(), 0.01
    volumes = [volume_of(delta) for delta in (speck, one_step(0.04, 2))]
    alone, surface = (float(log(volume) / tv(volume)) for volume in volumes)
    assert alone > surface
    lengths = [gradient_length(volume.delta, GRID.spacing) for volume in volumes]
    alone, surface = (float((eps * torch.log1p(length / eps)).mean() / length.mean()) for length in lengths)
    assert alone < surface


def test_neighbours_share_edges_and_none_is_lost():
    lengths = torch.zeros(4, *GRID.shape, dtype=torch.float64)
    lengths[:, 1, 2, 0] = 1.0
    shared = among_neighbours(lengths)
    row = torch.tensor([2.0, 1.0, 0.0, 0.0, 1.0], dtype=torch.float64)  # periodic
    torch.testing.assert_close(shared[1, 2], row / 8)
    torch.testing.assert_close(shared[1, 3], row / 16)
    assert float(shared.sum()) == pytest.approx(1.0)
    other = torch.rand(GRID.shape, dtype=torch.float64)
    alone = torch.rand(GRID.shape, dtype=torch.float64)
    left, right = ((among_neighbours(a[None]) * b).sum() for a, b in ((other, alone), (alone, other)))
    torch.testing.assert_close(left, right)  # it is its own adjoint, as the majorant needs


# the specimen's contrast


def test_the_contrast_of_a_block_is_its_height_however_much_medium_is_around_it():
    for size in (8, 20):
        delta = torch.zeros(size, size, size)
        delta[2:5, 2:5, 2:5] = -0.03
        assert contrast(delta) == pytest.approx(0.03, rel=1e-5)
    assert contrast(torch.zeros(3, 3, 3)) == 0


def test_the_contrast_scales_with_the_specimen():
    delta = drawn()
    for factor in (1e-6, 1e4):
        assert contrast(factor * delta) == pytest.approx(factor * contrast(delta), rel=1e-9)
    weak = 1e-12 * drawn().float()
    assert contrast(weak) > 0  # no cube of it underflows


# weights and sums


def test_weights_are_multiplied_and_nothing_of_weight_0_is_left():
    priors = [TotalVariation(4.0, 1.0), LogTotalVariation(0.0, 0.0), Magnitude(0.5), Magnitude(0.0)]
    found = weighted(priors, 10.0, 0, 100)
    assert found == [(40.0, priors[0]), (5.0, priors[2])]
    assert weighted(priors, 10.0, 99, 100)[0] == (10.0, priors[0])
    assert weighted(priors, 0.0, 0, 100) == []


def test_a_weight_is_held_and_then_moved():
    found = [held_then_annealed(step, 100, 16.0, 1.0) for step in (0, 39, 60, 80, 99)]
    assert found == pytest.approx([16.0, 16.0, 4.0, 1.0, 1.0])
    assert held_then_annealed(60, 100, 16.0, 0.0) == pytest.approx(8.0)


def test_majorants_add_up():
    total = 2.0 * Majorant(edges=torch.ones(2, 2, 2), sparse=1.0) + 3.0 * Majorant(edges=1.0, rough=2.0)
    assert isinstance(total.edges, torch.Tensor)
    assert float(total.edges.min()) == float(total.edges.max()) == 5.0
    assert (total.sparse, total.rough) == (2.0, 6.0)


def test_a_prior_without_a_majorant_says_so():
    class Quartic(Prior):
        """The mean fourth power of Δn."""

        def weight(self, step, steps):
            return 1.0

        def __call__(self, volume):
            return volume.delta.pow(4).mean()

    with pytest.raises(NotImplementedError, match="Quartic has no majorant: fit with method 'adam'"):
        Quartic().majorant(volume_of(drawn()))
    assert float(Quartic().at_contrast(0.1)(volume_of(torch.ones(GRID.shape)))) == 1.0


@pytest.mark.parametrize("weight", [-1.0, math.inf, math.nan])
def test_a_magnitude_of_an_impossible_weight_is_refused(weight):
    with pytest.raises(ValueError, match=f"weight {weight} of the magnitude must be at least 0"):
        Magnitude(weight)
