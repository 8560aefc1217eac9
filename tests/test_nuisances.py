import math
from dataclasses import replace

import pytest
import torch

from data_synthetic import GaussianBall
from recon.fit.nuisances.bias import Bias, CommonBias
from recon.fit.nuisances.drift import Drift
from recon.fit.nuisances.focus import FocusErrors
from recon.fit.nuisances.light import Brightness, Lamp
from recon.fit.nuisances.shear import ShearError
from recon.fit.problem import Recipe
from recon.fit.setup import Setup
from recon.misfit.gaussian import GaussianMisfit
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume

BACKGROUND = 1.5
GRID = Grid((8, 16, 18), (0.4, 0.2, 0.21))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.05, 0.24), 1.3, 0.2), None, Prism((0.24, 0.0), -1.3)], [-0.7, 0.1, 0.9])
FIDELITY = Fidelity(sources=3)
ALL = [Brightness(), Drift(), Bias(), CommonBias(), FocusErrors(), ShearError(), Lamp()]
NAMES = [type(unknown).__name__ for unknown in ALL]
each = pytest.mark.parametrize("unknown", ALL, ids=NAMES)


@pytest.fixture
def known():
    delta = GaussianBall(0.5, 0.02, BACKGROUND, (0.3, -0.3, 0.4)).delta(GRID, dtype=torch.float64)
    return Setup(Volume(GRID, delta, BACKGROUND), MICROSCOPE, ACQUISITION)


@pytest.fixture
def misfit(known):
    return GaussianMisfit(known.images(FIDELITY))


def images(unknown, parameter, known):
    return unknown.put(unknown.value(parameter), known).images(FIDELITY)


def off(unknown, known, misfit, steps=1.0):
    """A parameter that is off its start by about so many steps."""
    start = unknown.start(known, misfit)
    return start + steps * unknown.step * torch.randn(start.shape, dtype=start.dtype)


@each
def test_a_start_is_what_is_declared(unknown, known, misfit):
    start = unknown.start(known, misfit)
    assert start.dtype == misfit.data.dtype
    torch.testing.assert_close(images(unknown, start, known), misfit.data, rtol=0, atol=1e-12)


@each
def test_images_differentiate_in_it(unknown, known, misfit):
    """Autograd against central differences, float64, in a projection of the images that sees every pixel."""
    weight = torch.randn(misfit.data.shape, dtype=torch.float64)
    parameter = off(unknown, known, misfit).requires_grad_()

    def projected(parameter):
        return (weight * images(unknown, parameter, known)).sum()

    assert torch.autograd.gradcheck(projected, (parameter,), eps=1e-5, atol=1e-6, rtol=1e-6)
    (gradient,) = torch.autograd.grad(projected(parameter), parameter)
    seen = gradient.abs() > 0
    if isinstance(unknown, Bias):  # bright field has none
        assert seen.tolist() == [True, False, True]
    else:
        assert bool(seen.all())


@each
def test_an_entry_moves_its_own_images_alone(unknown, known, misfit):
    """As `acting` says, along the directions that `directions` gives."""
    parameter = off(unknown, known, misfit)
    start = unknown.told(parameter)
    acting = unknown.acting(parameter, (3, 3))
    directions = unknown.directions(parameter)
    assert acting.shape == (3, 3, len(directions), parameter.numel())
    at = unknown.put(unknown.of_entries(start), known).images(FIDELITY)
    h = 1e-5
    columns = [
        (unknown.put(unknown.of_entries(start + h * direction), known).images(FIDELITY) - at) / h
        for direction in directions
    ]
    for entry in range(parameter.numel()):
        moved = parameter.clone().flatten()
        moved[entry] += h
        found = (images(unknown, moved.reshape(parameter.shape), known) - at) / h
        weights = acting[..., entry][..., None, None]
        expected = sum(weights[:, :, d] * column for d, column in enumerate(columns))
        assert isinstance(expected, torch.Tensor)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-3 * max(float(c.abs().max()) for c in columns))


@pytest.mark.parametrize("unknown", [Drift(), FocusErrors()], ids=["drift", "focus"])
def test_what_is_common_to_all_plays_no_part(unknown, known, misfit):
    parameter = off(unknown, known, misfit)
    value = unknown.value(parameter)
    axes = tuple(range(len(unknown.axes)))
    torch.testing.assert_close(value.mean(axes), torch.zeros_like(value.mean(axes)), rtol=0, atol=1e-15)
    torch.testing.assert_close(unknown.value(parameter + 0.3), value, rtol=0, atol=1e-15)


def test_a_common_focus_offset_is_the_volumes_depth(known):
    """So it can't be told: the specimen moved by a slice and all planes with it give the same images."""
    delta = known.volume.delta.clone()
    delta[-2:] = 0
    delta[:1] = 0
    here = replace(known, volume=Volume(GRID, delta, BACKGROUND))
    moved = replace(known, volume=Volume(GRID, delta.roll(1, 0), BACKGROUND))
    planes = Acquisition(ACQUISITION.prisms, [focus + GRID.spacing[0] for focus in ACQUISITION.focus])
    expected = replace(moved, acquisition=planes).images(FIDELITY)
    torch.testing.assert_close(here.images(FIDELITY), expected, rtol=0, atol=1e-9)


def test_brightness_is_above_0_whatever_its_parameter(known, misfit):
    assert float(Brightness().value(torch.full((3, 3), -5.0)).min()) > 0
    declared = 0.5 + torch.rand(3, 3)
    start = Brightness().start(replace(known, brightness=declared), misfit)
    torch.testing.assert_close(Brightness().value(start), declared.double(), rtol=1e-6, atol=0)
    with pytest.raises(ValueError, match=r"brightness -0.1 must be above 0"):
        Brightness().start(replace(known, brightness=torch.full((3, 3), -0.1)), misfit)


def test_a_declared_drift_is_where_a_drift_starts(known, misfit):
    declared = torch.randn(3, 3, 2, dtype=torch.float64)
    assert torch.equal(Drift().start(replace(known, drift=declared), misfit), declared)


def test_each_prism_has_its_own_bias(known):
    put = Bias().put(torch.tensor([0.5, 9.0, -2.0]), known).acquisition.prisms
    assert put[1] is None
    assert (float(put[0].bias), float(put[2].bias)) == (0.5, -2.0)
    assert put[0].shear is ACQUISITION.prisms[0].shear
    assert put[0].axis == 0.2


def test_a_common_bias_keeps_each_prisms_sign(known, misfit):
    assert float(CommonBias().start(known, misfit)) == pytest.approx(1.3)
    put = CommonBias().put(torch.tensor(1.5), known).acquisition.prisms
    assert put[1] is None
    assert (float(put[0].bias), float(put[2].bias)) == (1.5, -1.5)


def test_prisms_of_unlike_biases_have_no_common_one(known, misfit):
    unlike = Acquisition([Prism((0.0, 0.2), 1.3), Prism((0.0, 0.2), -0.7)])
    with pytest.raises(ValueError, match=r"\|bias\| 0.7 and 1.3 rad have no common one"):
        CommonBias().start(replace(known, acquisition=unlike), misfit)


@pytest.mark.parametrize(
    ("unknown", "what"), [(Bias(), "bias"), (CommonBias(), "bias"), (ShearError(), "shear")], ids=str
)
def test_bright_field_has_nothing_of_a_prism_to_learn(unknown, what, known, misfit):
    bright = replace(known, acquisition=Acquisition([None], [0.0]))
    with pytest.raises(ValueError, match=f"all images are bright field: there is no {what} to learn"):
        unknown.start(bright, misfit)


def test_a_shear_is_stretched_and_turned_from_x_towards_y(known):
    put = ShearError().put(torch.tensor([1.1, math.pi / 2]), known).acquisition.prisms
    assert put[1] is None
    assert [float(s) for s in put[0].shear] == pytest.approx([1.1 * 0.24, -1.1 * 0.05], abs=1e-6)
    assert [float(s) for s in put[2].shear] == pytest.approx([0.0, -1.1 * 0.24], abs=1e-6)
    assert float(put[0].axis) == pytest.approx(0.2 + math.pi / 2)
    assert put[2].axis is None
    assert put[0].bias == 1.3


def test_focus_errors_are_added_to_the_planes(known):
    put = FocusErrors().put(torch.tensor([0.1, -0.2, 0.1], dtype=torch.float64), known).acquisition
    assert [float(focus) for focus in put.focus] == pytest.approx([-0.6, -0.1, 1.0])
    assert put.prisms == ACQUISITION.prisms


@each
@pytest.mark.parametrize(
    ("values", "law"),
    [
        ({"learning_rate": 0.0}, "learning_rate 0.0 must be above 0"),
        ({"step": -1.0}, "step -1.0 must be above 0"),
        ({"step": math.nan}, "step nan must be above 0"),
    ],
)
def test_an_unphysical_rate_or_step_is_refused(unknown, values, law):
    with pytest.raises(ValueError, match=f"{unknown.name}: {law}"):
        replace(unknown, **values)


def test_brightness_beside_a_learned_bias_is_relative_to_its_prisms_mean():
    """Else a prism's bias, its brightness and the specimen's contrast could not be told apart."""
    index, brightness, bias = Recipe(learn=("bias",)).unknowns()
    parameter = torch.tensor([[0.1, 0.2, -0.1], [0.3, 0.3, 0.6]], dtype=torch.float64)
    factors = brightness.value(parameter)
    torch.testing.assert_close(factors.log().mean(1), torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(factors[:, 0] / factors[:, 1], (parameter[:, 0] - parameter[:, 1]).exp())
    assert (index.name, brightness.name, bias.name) == ("delta", "brightness", "bias")
    assert torch.equal(Recipe().unknowns()[1].value(parameter), parameter.exp())
