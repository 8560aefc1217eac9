"""Two beams, displaced by the shear and out of phase by the bias."""

import math

import pytest
import torch

from torchdic import Grid, Prism

GRID = Grid((1, 8, 9), (1.0, 0.2, 0.3))


def test_transfer_is_the_difference_of_two_displaced_beams():
    """½[U(x + s/2)·e^{ib/2} − U(x − s/2)·e^{−ib/2}] = i·D·U: displacement by s is a factor exp(2πi f·s)."""
    frequencies = GRID.frequencies(dtype=torch.float64)
    shear, bias = (0.17, -0.31), 0.9
    displacement = torch.exp(2j * math.pi * (frequencies[0] * shear[0] + frequencies[1] * shear[1]) / 2)
    lead = complex(math.cos(bias / 2), math.sin(bias / 2))
    expected = (displacement * lead - displacement.conj() * lead.conjugate()) / 2
    found = 1j * Prism(shear, bias).transfer(frequencies)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)


def test_numbers_and_tensors_are_the_same_prism(dtype):
    frequencies = GRID.frequencies(dtype=dtype)
    expected = Prism((0.17, -0.31), 0.9).transfer(frequencies)
    assert expected.dtype == dtype
    pair = torch.tensor([0.17, -0.31], dtype=torch.float64)
    bias = torch.tensor(0.9, dtype=torch.float64)
    for shear in (pair, (pair[0], pair[1]), (0.17, pair[1])):
        assert torch.equal(Prism(shear, bias).transfer(frequencies), expected)


def test_gradient_reaches_shear_and_bias_from_zero():
    shear, bias = torch.zeros(2, dtype=torch.float64, requires_grad=True), torch.zeros((), requires_grad=True)
    Prism(shear, bias).transfer(GRID.frequencies(dtype=torch.float64)).square().sum().backward()
    assert shear.grad is not None
    assert bias.grad is not None
    assert torch.equal(shear.grad, torch.zeros(2, dtype=torch.float64))  # sin² is flat at 0: a gradient, and it is 0


@pytest.mark.parametrize(
    ("shear", "bias", "message"),
    [
        ((0.1, math.nan), 0.2, "shear x nan must be a finite number"),
        ((math.inf, 0.1), 0.2, "shear y inf must be a finite number"),
        ((0.1, 0.1), math.inf, "bias inf must be a finite number"),
        ((0.1, 0.1), torch.tensor(math.nan), "bias nan must be a finite number"),
    ],
)
def test_errors_state_the_number(shear, bias, message):
    with pytest.raises(ValueError, match=message):
        Prism(shear, bias)
