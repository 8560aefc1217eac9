"""Cells of the table of `python benchmarks/exact_fields.py`, as bounds: exact fields against each propagation.

docs/validation.md holds the whole table. A bound is its cell's number with a fifth to spare at most.
"""

import importlib
import sys
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def table():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        yield importlib.import_module("exact_fields")
        for name in ("exact_fields", "comparison"):
            patch.delitem(sys.modules, name)


@pytest.fixture(scope="module")
def exact(table):
    """The exact images by case and condenser NA, each computed once."""
    found = {}

    def of(case, na):
        if (case, na) not in found:
            found[case, na] = table.exact(table.CASES[case], na)
        return found[case, na]

    return of


def errors(table, exact, case, na, propagation, steps):
    return torch.tensor(table.errors(table.CASES[case], na, propagation, steps, exact(case, na))[0])


@pytest.mark.parametrize(
    ("case", "na", "steps", "bound"),
    [
        pytest.param("smooth ball", 0.2, 36, 0.0003, marks=pytest.mark.slow),
        pytest.param("smooth ball", 0.5, 36, 0.0008, marks=pytest.mark.slow),
        # test_reference holds a smooth ball to the same
        pytest.param("smooth ball", 0.8, 36, 0.003, marks=pytest.mark.slow),
        pytest.param("strong smooth ball", 0.8, 72, 0.011, marks=pytest.mark.slow),
        ("sharp bead", 0.8, 40, 0.03),
        pytest.param("strong bead", 0.2, 80, 0.035, marks=pytest.mark.slow),
        pytest.param("strong bead", 0.8, 160, 0.044, marks=pytest.mark.slow),
        pytest.param("strong bead", 0.8, 640, 0.03, marks=pytest.mark.slow),
    ],
)
def test_wave_is_right_at_high_contrast_and_high_angle(table, exact, case, na, steps, bound):
    found = errors(table, exact, case, na, "wave", steps)
    assert float(found.max()) < bound, found


@pytest.mark.slow
@pytest.mark.parametrize("na", [0.2, 0.5, 0.8])
def test_rays_err_by_thousandths_on_the_smooth_ball_at_every_aperture(table, exact, na):
    found = errors(table, exact, "smooth ball", na, "rays", 36)
    assert float(found.max()) < 0.003, found


@pytest.mark.slow
def test_rays_err_by_thousandths_on_the_strong_smooth_ball_too(table, exact):
    found = errors(table, exact, "strong smooth ball", 0.8, "rays", 72)
    assert float(found.max()) < 0.0105, found


@pytest.mark.slow  # what the smooth ball asks of straight rays stands in test_ablation and test_reference
@pytest.mark.parametrize(
    ("case", "na", "floor"),
    [
        ("smooth ball", 0.8, 0.10),
        ("sharp bead", 0.8, 0.15),
        ("strong bead", 0.8, 0.3),
    ],
)
def test_straight_rays_are_not_enough(table, exact, case, na, floor):
    """The table tells the propagations apart: its errors are not those of the comparison."""
    found = errors(table, exact, case, na, "projection", table.CASES[case].grid.shape[0])
    assert float(found.max()) > floor, found


@pytest.mark.slow
def test_wider_condenser_asks_more_of_straight_rays(table, exact):
    found = [errors(table, exact, "smooth ball", na, "projection", 72).max() for na in (0.2, 0.5, 0.8)]
    assert found[0] < found[1] / 2 < found[2] / 4


def test_directions_reach_the_condenser_s_edge_on_all_sides(table):
    points, weights = table.microscope(0.8).sources(40, dtype=torch.float64)
    assert points.shape == (13, 2)
    assert float(points.norm(dim=1).max()) == pytest.approx(0.8)
    torch.testing.assert_close(weights @ points, torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-15)
