"""Where a voxel's centre is, and which frequencies an array holds."""

import math

import pytest
import torch

from torchdic import Grid

GRID = Grid((4, 5, 6), (0.5, 0.2, 0.3))


def test_voxel_i_has_its_centre_at_i_minus_half_of_n_minus_1_times_spacing():
    for axis, (n, d) in enumerate(zip(GRID.shape, GRID.spacing, strict=True)):
        expected = torch.tensor([(i - (n - 1) / 2) * d for i in range(n)], dtype=torch.float64)
        torch.testing.assert_close(GRID.coordinates(axis, dtype=torch.float64), expected, rtol=0, atol=1e-15)
        assert [GRID.centre(axis, i) for i in range(n)] == pytest.approx(expected.tolist(), abs=1e-15)


def test_index_is_the_inverse_of_centre():
    for axis in range(3):
        for index in (0, 1.3, -2.7, 8):
            assert GRID.index(axis, GRID.centre(axis, index)) == pytest.approx(index, abs=1e-12)


def test_box_is_centred_on_the_origin_faces_included():
    assert GRID.extent == pytest.approx((2.0, 1.0, 1.8))
    for axis in range(3):
        assert GRID.centre(axis, -0.5) == pytest.approx(-GRID.extent[axis] / 2)
        assert GRID.centre(axis, GRID.shape[axis] - 0.5) == pytest.approx(GRID.extent[axis] / 2)
        assert float(GRID.coordinates(axis, dtype=torch.float64).sum()) == pytest.approx(0, abs=1e-14)


def test_frequencies_are_those_of_the_fft(dtype):
    """A wave exp(2πi f·x) sampled at the centres has its one amplitude where frequencies say f."""
    frequencies = GRID.frequencies(dtype=dtype)
    assert frequencies.shape == (2, 5, 6)
    assert frequencies.dtype == dtype
    y, x = torch.meshgrid(*(GRID.coordinates(a, dtype=torch.float64) for a in (1, 2)), indexing="ij")
    for row, column in ((1, 2), (4, 5), (2, 0)):
        fy, fx = (float(f[row, column]) for f in frequencies)
        wave = torch.exp(2j * math.pi * (fy * y + fx * x))
        spectrum = torch.fft.fft2(wave, norm="forward").abs()
        assert float(spectrum[row, column]) == pytest.approx(1, abs=1e-6)
        assert float(spectrum.sum()) == pytest.approx(1, abs=1e-5)


def test_default_dtype_is_torchs():
    assert GRID.coordinates(0).dtype == torch.get_default_dtype()
    assert GRID.frequencies().dtype == torch.get_default_dtype()


@pytest.mark.parametrize("shape", [(0, 5, 6), (4, -1, 6), (4, 5)], ids=str)
def test_impossible_shape_is_an_error_that_shows_it(shape):
    with pytest.raises((ValueError, TypeError)):
        Grid(shape, (0.5, 0.2, 0.3))


def test_errors_state_the_number_and_the_law():
    with pytest.raises(ValueError, match=r"shape \(4, 0, 6\) must be three whole numbers .* at least 1"):
        Grid((4, 0, 6), (0.5, 0.2, 0.3))
    for bad in (0.0, -0.2, math.nan, math.inf):
        with pytest.raises(ValueError, match=r"spacing .* must be three lengths .* above 0"):
            Grid((4, 5, 6), (0.5, bad, 0.3))
