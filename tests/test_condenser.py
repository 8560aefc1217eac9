"""The aperture as plane waves: a quadrature over the disc, or points as given."""

import math

import pytest
import torch

from data_synthetic import GaussianBall
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image
from torchdic.instrument.condenser import disc_quadrature


def disc_mean(p, q):
    """The mean of y^p·x^q over the unit disc: 0 for odd powers, else a ratio of Γ functions."""
    if p % 2 or q % 2:
        return 0.0
    return math.gamma((p + 1) / 2) * math.gamma((q + 1) / 2) / math.gamma((p + q) / 2 + 2) / math.pi


@pytest.mark.parametrize("count", [1, 2, 3, 7, 12, 20, 40, 61, 120])
def test_sources_lie_in_the_disc_with_weights_of_sum_one(count, dtype):
    points, weights = Condenser(0.6).sources(count, dtype=dtype)
    assert points.dtype == weights.dtype == dtype
    assert points.shape == (len(weights), 2)
    assert len(weights) <= count
    assert float(points.norm(dim=-1).max()) <= 0.6 * (1 + 1e-6)
    assert float(weights.min()) > 0
    assert float(weights.sum()) == pytest.approx(1, abs=4 * torch.finfo(dtype).eps)
    torch.testing.assert_close(weights @ points, torch.zeros(2, dtype=dtype), rtol=0, atol=1e-6)


@pytest.mark.parametrize(("count", "degree"), [(12, 3), (40, 7), (120, 13)])
def test_quadrature_is_exact_for_polynomials_over_the_disc(count, degree):
    points, weights = disc_quadrature(count)
    for p in range(degree + 1):
        for q in range(degree + 1 - p):
            found = (weights * points[:, 0] ** p * points[:, 1] ** q).sum()
            assert found == pytest.approx(disc_mean(p, q), abs=1e-13), (p, q)


def test_image_converges_fast_with_the_number_of_sources():
    """Against 400 sources: 6, 24 and 96 err ever less, 24 by less than 1 % of the contrast."""
    grid = Grid((8, 36, 36), (0.4, 0.18, 0.18))
    volume = Volume(grid, GaussianBall(0.7, 0.02, 1.36, (0.3, -0.2, 0.4)).delta(grid), 1.36)
    microscope = Microscope(0.546, Objective(0.8), Condenser(0.6))

    def of(count):
        acquisition = Acquisition([Prism((0.1, 0.2), 1.2)], [0.0, 1.5])
        return image(volume, microscope, acquisition, Fidelity("wave", sources=count))

    exact = of(400)
    contrast = float((exact - math.sin(0.6) ** 2).abs().max())
    error = [float((of(n) - exact).abs().max()) / contrast for n in (6, 24, 96)]
    assert error[1] < 0.01
    assert error[0] > 2 * error[1] > 3 * error[2]


def test_aperture_of_zero_is_one_axial_wave():
    points, weights = Condenser(0.0).sources(40, dtype=torch.float64)
    assert points.tolist() == [[0.0, 0.0]]
    assert weights.tolist() == [1.0]


def test_given_points_override_the_count_and_keep_their_order():
    given = torch.tensor([[0.1, -0.2], [0.0, 0.3], [-0.4, 0.0]], dtype=torch.float64)
    points, weights = Condenser(0.5, points=given).sources(1, dtype=torch.float64)
    assert torch.equal(points, given)
    torch.testing.assert_close(weights, torch.full((3,), 1 / 3, dtype=torch.float64))


def test_weights_are_made_to_sum_to_one_and_none_means_equal(smooth_field):
    grid = Grid((3, 9, 10), (0.5, 0.2, 0.2))
    volume = Volume(grid, smooth_field(grid, 0.02), 1.36)
    points = torch.tensor([[0.1, -0.2], [0.0, 0.3], [-0.4, 0.0]], dtype=torch.float64)

    def of(weights):
        microscope = Microscope(0.546, Objective(0.8), Condenser(0.4, points=points, weights=weights))
        return image(volume, microscope, Acquisition([Prism((0.1, 0.2), 1.2)]), Fidelity("wave"))

    uneven = torch.tensor([1.0, 3.0, 4.0], dtype=torch.float64)
    assert torch.equal(of(None), of(torch.full((3,), 5.0)))
    assert torch.equal(of(uneven), of(8 * uneven))
    alone = [of(torch.eye(3, dtype=torch.float64)[i]) for i in range(3)]
    torch.testing.assert_close(of(uneven), (alone[0] + 3 * alone[1] + 4 * alone[2]) / 8)
    assert float((of(uneven) - of(None)).abs().max()) > 1e-3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-0.1,), r"condenser NA -0\.1 must be at least 0"),
        ((math.inf,), r"condenser NA inf"),
        ((0.5, None, torch.ones(3)), r"weights need the points"),
        ((0.5, torch.zeros(2, 2), torch.tensor([1.0, -0.1])), r"weights must be at least 0"),
        ((0.5, torch.zeros(2, 2), torch.zeros(2)), r"positive finite sum"),
        ((0.5, torch.full((2, 2), math.nan)), r"points must be finite"),
        ((0.5, torch.zeros(0, 2)), r"points have shape \(0, 2\)"),
    ],
)
def test_errors_state_the_numbers_and_the_law(arguments, message):
    with pytest.raises(ValueError, match=message):
        Condenser(*arguments)


def test_no_sources_are_an_error():
    with pytest.raises(ValueError, match="at least 1 source, not 0"):
        Condenser(0.5).sources(0)


# --- annulus -------------------------------------------------------------------------------------------------------


def annulus_mean(p, q, hole):
    """The mean of y^p·x^q over hole ≤ r ≤ 1: the disc's less the inner disc's, by area."""
    return disc_mean(p, q) * (1 - hole ** (p + q + 2)) / (1 - hole**2)


@pytest.mark.parametrize("hole", [0.3, 0.7, 0.95])
@pytest.mark.parametrize("count", [2, 5, 12, 40, 120])
def test_annulus_lies_between_its_radii_with_weights_of_sum_one(hole, count, dtype):
    points, weights = Condenser(0.8, inner_na=0.8 * hole).sources(count, dtype=dtype)
    radius = points.norm(dim=-1)
    assert 2 <= len(weights) <= count
    assert float(radius.min()) >= 0.8 * hole * (1 - 1e-6)
    assert float(radius.max()) <= 0.8 * (1 + 1e-6)
    assert float(weights.min()) > 0
    assert float(weights.sum()) == pytest.approx(1, abs=4 * torch.finfo(dtype).eps)
    torch.testing.assert_close(weights @ points, torch.zeros(2, dtype=dtype), rtol=0, atol=1e-6)


@pytest.mark.parametrize("hole", [0.2, 0.6, 0.9])
@pytest.mark.parametrize(("count", "degree"), [(12, 3), (40, 7), (120, 10)])
def test_annulus_quadrature_is_exact_for_polynomials(hole, count, degree):
    points, weights = disc_quadrature(count, hole)
    # fewer rings suffice where the annulus is narrow: there their error is not zero but below 1e-4
    tolerance = 1e-13 if hole < 0.5 else 1e-4
    for p in range(degree + 1):
        for q in range(degree + 1 - p):
            found = (weights * points[:, 0] ** p * points[:, 1] ** q).sum()
            assert found == pytest.approx(annulus_mean(p, q, hole), abs=tolerance), (p, q)


def test_inner_aperture_of_zero_is_the_disc_exactly():
    for found, expected in zip(Condenser(0.6, inner_na=0.0).sources(40), Condenser(0.6).sources(40), strict=True):
        assert torch.equal(found, expected)


def test_equal_apertures_are_one_ring_to_which_narrow_annuli_tend():
    points, weights = Condenser(0.6, inner_na=0.6).sources(31, dtype=torch.float64)
    torch.testing.assert_close(points.norm(dim=-1), torch.full((31,), 0.6, dtype=torch.float64))
    assert len(weights.unique()) == 1
    narrow, _ = Condenser(0.6, inner_na=0.6 * (1 - 1e-7)).sources(31, dtype=torch.float64)
    torch.testing.assert_close(narrow, points, rtol=0, atol=1e-7)


def test_annulus_and_its_inner_disc_make_the_full_disc():
    """Images weighted by area, to the quadratures' error, which the pupil's sharp edge sets."""
    grid = Grid((6, 30, 32), (0.4, 0.18, 0.18))
    volume = Volume(grid, GaussianBall(0.6, 0.02, 1.36, (0.3, -0.2, 0.4)).delta(grid), 1.36)
    acquisition = Acquisition([Prism((0.1, 0.2), 1.2)], [0.0, 1.5])

    def of(condenser, sources):
        return image(
            volume, Microscope(0.546, Objective(0.8), condenser), acquisition, Fidelity("wave", sources=sources)
        )

    ring, inner, disc = of(Condenser(0.6, inner_na=0.4), 120), of(Condenser(0.4), 120), of(Condenser(0.6), 200)
    share = (0.4 / 0.6) ** 2
    contrast = float((disc - math.sin(0.6) ** 2).abs().max())
    assert float((share * inner + (1 - share) * ring - disc).abs().max()) < 5e-3 * contrast
    assert float((ring - disc).abs().max()) > 0.02 * contrast


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"na": 0.5, "inner_na": 0.6}, r"inner NA 0\.6 must be from 0 to its NA 0\.5"),
        ({"na": 0.5, "inner_na": -0.1}, r"inner NA -0\.1 must be from 0"),
        ({"na": 0.5, "inner_na": math.nan}, r"inner NA nan must be from 0"),
        ({"na": 0.5, "inner_na": 0.1, "points": torch.zeros(1, 2)}, r"inner NA 0\.1 would stop given points"),
    ],
)
def test_impossible_annuli_are_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        Condenser(**arguments)


def test_single_source_of_an_annulus_is_an_error():
    with pytest.raises(ValueError, match="at least 2 sources, not 1"):
        Condenser(0.5, inner_na=0.3).sources(1)


# --- an aperture that the objective's pupil divides ------------------------------------------------------------------


@pytest.mark.parametrize("inner", [None, 0.5])
@pytest.mark.parametrize("na", [0.61, 0.8, 1.2])
@pytest.mark.parametrize("count", [4, 5, 12, 40, 392])
def test_as_much_direct_light_passes_the_pupil_as_should(na, inner, count):
    condenser = Condenser(na, inner_na=inner)
    points, weights = Microscope(0.546, Objective(0.6), condenser).sources(count, dtype=torch.float64)
    radius, hole = points.norm(dim=-1), inner or 0.0
    assert len(weights) <= count
    assert float(radius.min()) >= hole
    assert float(radius.max()) <= na
    passes = float(weights[radius <= 0.6].sum())
    assert passes == pytest.approx((0.6**2 - hole**2) / (na**2 - hole**2), rel=1e-12)
    assert float(weights.sum()) == pytest.approx(1, rel=1e-12)
    if count >= 40:  # each has its opposite, of the same weight
        apart, opposite = torch.cdist(points, -points).min(1)
        assert float(apart.max()) < 1e-6
        torch.testing.assert_close(weights[opposite], weights)
    torch.testing.assert_close(weights @ points, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("propagation", ["projection", "rays", "wave"])
def test_empty_field_beyond_the_pupil_is_as_bright_as_the_light_that_passes(propagation):
    grid = Grid((3, 12, 13), (0.4, 0.15, 0.15))
    microscope = Microscope(0.546, Objective(0.6), Condenser(0.9))
    images = image(
        Volume(grid, torch.zeros(grid.shape, dtype=torch.float64), 1.36),
        microscope,
        Acquisition([None, Prism((0.1, 0.2), 1.2)]),
        Fidelity(propagation, sources=6),
    )
    passes = (0.6 / 0.9) ** 2
    for found, share in zip(images, (1.0, math.sin(0.6) ** 2), strict=True):
        torch.testing.assert_close(found, torch.full_like(found, passes * share), rtol=1e-6, atol=0)


@pytest.mark.parametrize("condenser", [Condenser(0.6), Condenser(0.5), Condenser(0.9, inner_na=0.6)])
def test_an_aperture_on_one_side_of_the_pupils_edge_is_one_rule(condenser):
    for found, expected in zip(
        Microscope(0.546, Objective(0.6), condenser).sources(40), condenser.sources(40), strict=True
    ):
        assert torch.equal(found, expected)


def test_a_pupil_that_divides_the_aperture_converges_with_the_number_of_sources():
    """Against 900 directions: the error of the images' contrast falls, and 40 leave less than a fifth of it."""
    grid = Grid((6, 40, 42), (0.4, 0.15, 0.15))
    volume = Volume(grid, GaussianBall(0.8, 0.05, 1.36, (0.1, -0.2, 0.3)).delta(grid), 1.36)
    microscope = Microscope(0.546, Objective(0.6), Condenser(0.8))

    def of(count):
        return image(volume, microscope, Acquisition([Prism((0.1, 0.2), 1.2)], [1.5]), Fidelity(sources=count))

    exact = of(900)
    few, many, most = (float((of(n) - exact).square().mean().sqrt() / exact.std()) for n in (40, 120, 400))
    assert few < 0.2
    assert few > 1.5 * many > 2 * most
