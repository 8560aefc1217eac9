"""Straight rays: the integral along each source's direction."""

import math

import pytest
import torch
from through import project

from data_synthetic import GaussianBall
from torchdic import Fidelity, Grid, Volume

N0 = 1.36


@pytest.mark.parametrize("direction", [(0.0, 0.0), (0.4, -0.2), (-0.1, 0.7)], ids=str)
@pytest.mark.parametrize("plane", [0.0, 1.2])
def test_opd_is_the_integral_along_the_sources_direction(direction, plane):
    """Weak contrast: W = ∫Δn ds in the line's exact value, for rays that cross `plane` at the pixels."""
    grid = Grid((60, 30, 34), (0.1, 0.25, 0.25))
    contrast = 1e-5
    ball = GaussianBall(0.6, contrast, N0, (0.2, -0.4, 0.5))
    momentum = torch.tensor([direction], dtype=torch.float64)
    fidelity = Fidelity("projection", interpolation="cubic")
    field = project(Volume(grid, ball.delta(grid), N0), 1.0, momentum, plane, fidelity)[0]
    y, x = torch.meshgrid(*(grid.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    position = torch.stack((y, x), -1)
    exact = ball.straight_opd(position, momentum[0].expand_as(position), plane=plane, start=-3.0, end=3.0)
    # spline of voxels of 0.4 σ: 1e-3 of the peak; rays that leave by the side see the edge voxel
    inside = (y.abs() < 2) & (x.abs() < 2.5)
    difference = (field.angle() / (2 * math.pi) - exact)[inside].abs().max()
    assert float(difference) < 3e-3 * float(exact.max())


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_axial_projection_is_the_sum_over_slices(interpolation, smooth_field):
    grid = Grid((5, 9, 8), (0.3, 0.2, 0.2))
    delta, kappa = smooth_field(grid, 0.03), 0.002 * smooth_field(grid, seed=1).abs()
    fidelity = Fidelity("projection", interpolation=interpolation, steps=2)
    field = project(Volume(grid, delta, N0, kappa), 0.5, torch.zeros(1, 2, dtype=torch.float64), 0.4, fidelity)
    opd, absorbed = 0.3 * delta.sum(0), 0.3 * kappa.sum(0)
    expected = torch.polar(torch.exp(-4 * math.pi * absorbed), 4 * math.pi * opd)
    torch.testing.assert_close(field[0], expected, rtol=0, atol=1e-12)


def test_phase_object_stays_a_phase_object(smooth_field):
    grid = Grid((5, 9, 8), (0.3, 0.2, 0.2))
    momentum = torch.tensor([[0.3, 0.1], [0.0, -0.5]], dtype=torch.float64)
    field = project(Volume(grid, smooth_field(grid, 0.05), N0), 0.5, momentum, 0.0, Fidelity("projection"))
    torch.testing.assert_close(field.abs(), torch.ones(2, 9, 8, dtype=torch.float64))
