"""The specimen's contract: a learnable index on a grid."""

import pytest
import torch
from torch import nn

from data_synthetic import GaussianBall
from torchdic import Fidelity, Grid, Microscope, Volume, image
from torchdic.instrument.microscope import Acquisition

GRID = Grid((5, 6, 7), (0.4, 0.2, 0.3))


def field(value=0.01, dtype=torch.float64):
    return torch.full(GRID.shape, value, dtype=dtype)


def test_parameter_is_registered_and_a_tensor_is_a_buffer():
    learned = Volume(GRID, nn.Parameter(field()), 1.33, field(0.001))
    assert {n for n, _ in learned.named_parameters()} == {"delta"}
    assert set(learned.state_dict()) == {"delta", "background", "absorption"}
    fixed = Volume(GRID, field(), 1.33)
    assert not list(fixed.parameters())
    assert set(fixed.state_dict()) == {"delta", "background"}
    assert fixed.absorption is None


def test_state_dict_restores_the_volume():
    one, other = (Volume(GRID, nn.Parameter(torch.rand(GRID.shape)), n) for n in (1.33, 1.5))
    other.load_state_dict(one.state_dict())
    assert torch.equal(other.delta, one.delta)
    assert torch.equal(other.background, one.background)


def test_dtype_follows_delta(dtype):
    volume = Volume(GRID, field(dtype=dtype), torch.tensor(1.33), field(0.001, torch.float64))
    assert volume.background.dtype == dtype
    assert volume.absorption is not None
    assert volume.absorption.dtype == dtype
    assert image(volume, Microscope(0.5), Acquisition(), Fidelity("projection")).dtype == dtype


def test_background_number_keeps_its_digits():
    """1.36 through float32 would be 1.3600000143."""
    assert float(Volume(GRID, field(), 1.36).background) == 1.36


@pytest.mark.parametrize("slices", [15, 16])
def test_mean_plane_is_the_slice_or_face_nearest_to_the_weighted_mean_depth(slices):
    for centre, expected in ((0.75, 0.8), (-0.47, -0.4), (0.35, 0.4), (0.25, 0.2), (0.0, 0.0)):
        grid = Grid((slices, 12, 12), (0.4, 0.3, 0.3))
        delta = GaussianBall(0.5, 0.02, 1.36, (centre, 0.0, 0.3)).delta(grid)
        for sign in (1, -1):
            assert Volume(grid, sign * delta, 1.36).mean_plane() == pytest.approx(expected)
    assert Volume(GRID, torch.zeros(GRID.shape), 1.36).mean_plane() == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(5, 7, 6), 1.33), r"delta has shape \(5, 7, 6\), the grid has \(5, 6, 7\)"),
        ((field(), 1.33, torch.zeros(6, 6, 7)), r"absorption has shape \(6, 6, 7\)"),
        ((field(), 1.33, field(-1e-3)), r"absorption -0.001 is negative: κ must be at least 0"),
        ((field(), -1.0), r"background -1.0 must be a refractive index above 0"),
        ((field(), float("nan")), r"background nan must be a refractive index above 0"),
        ((field(-1.4), 1.33), r"index -0.07 = background 1.33 \+ delta must stay above 0"),
        ((field(float("nan")), 1.33), r"delta holds 210 values that are not finite"),
    ],
)
def test_errors_state_the_numbers_and_the_law(arguments, message):
    with pytest.raises(ValueError, match=message):
        Volume(GRID, *arguments)


@pytest.mark.parametrize("dtype", [torch.int64, torch.float16, torch.bfloat16, torch.complex64])
def test_what_images_are_not_computed_in_is_no_index(dtype):
    with pytest.raises(ValueError, match=rf"dtype {dtype}: it must be torch\.float32 or torch\.float64"):
        Volume(GRID, torch.zeros(GRID.shape, dtype=dtype), 1.33)
