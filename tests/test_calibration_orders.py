"""Signs and orders: what may have been recorded instead of what was declared, and which of it explains a stack."""

import math

import pytest
import torch

from recon.calibration.part import part_of
from recon.calibration.trials.declared import all_mistakes, images_of, one_mistake
from recon.calibration.trials.orders import LIKELY, Orders, Round, Tried, find_orders
from recon.fit.problem import Problem, Recipe
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume, image

GRID = Grid((6, 24, 22), (0.5, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.7), Condenser(0.5))
FOCUS = (-1.5, -0.5, 0.5, 1.5)
BIAS = 1.4
ONE = Acquisition([Prism((0.1, 0.2), BIAS)], FOCUS)
PAIR = Acquisition([Prism((0.0, 0.24), BIAS), Prism((0.0, 0.24), -BIAS)], FOCUS)
TWO = Acquisition([Prism((0.0, 0.24), BIAS), Prism((0.24, 0.0), BIAS)], FOCUS)
NOISE = 0.004
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")


def names(acquisition):
    return [other.name for other in all_mistakes(acquisition)]


def test_the_declared_acquisition_comes_first_and_every_other_once():
    found = all_mistakes(TWO)
    assert found[0].name == "as declared"
    assert images_of(found[0].acquisition) == images_of(TWO)
    assert len({images_of(other.acquisition) for other in found}) == len(found)
    assert [other.mistakes for other in found] == sorted(other.mistakes for other in found)


@pytest.mark.parametrize(("acquisition", "number"), [(ONE, 16), (PAIR, 8), (TWO, 16)])
def test_axes_signs_and_orders_make_so_many_descriptions(acquisition, number):
    """Eight turns of the axes by two orders of planes; a shear along x is its own mirror image in y."""
    assert len(all_mistakes(acquisition)) == number


def test_exchanging_a_pair_of_opposite_bias_is_reversing_its_sign():
    assert "sign" in names(PAIR)
    assert not any("prisms" in name for name in names(PAIR))


def test_every_description_has_a_name_of_its_own_that_says_its_order():
    shears = ((0.0, 0.24), (0.24, 0.0))
    declared = Acquisition([Prism(shear, bias) for shear in shears for bias in (BIAS, 0.5 * BIAS)], FOCUS)
    found = {other.name: other for other in all_mistakes(declared)}
    assert len(found) == len(all_mistakes(declared))
    a, b, c, d = declared.prisms
    assert found["prisms 1↔3"].acquisition.prisms == (c, b, a, d)
    assert found["prisms in order 2, 3, 1, 4"].acquisition.prisms == (b, c, a, d)
    assert found["prisms in order 2, 3, 1, 4"].advice == "put acquisition.prisms in the order 2, 3, 1, 4"
    tried = tuple(Tried(other, 1.0, 1.0, 1) for other in found.values())
    table = Orders(tried, 0.0, tried[0].otherwise, told=True).table(30)
    assert "prisms 1↔3 " in table
    assert "prisms: of acquisition.prisms, from 1" in table


def test_two_mistakes_at_once_are_among_them():
    assert "sign and focus" in names(ONE)
    assert {other.name for other in one_mistake(ONE)} <= {*names(ONE), "axes and sign"}


def test_a_reversed_order_of_planes_keeps_their_range():
    lopsided = Acquisition([Prism((0.0, 0.24), BIAS)], (0.0, 1.0, 2.0))
    back = next(other for other in all_mistakes(lopsided) if other.name == "focus")
    assert back.acquisition.focus == (2.0, 1.0, 0.0)


def test_a_part_is_taken_around_the_strongest_structure():
    data = torch.ones(1, 9, 40, 50) + 1e-3 * torch.randn(1, 9, 40, 50, generator=torch.Generator().manual_seed(0))
    data[..., 27:33, 8:14] += 0.5
    part = part_of(data, None, Grid((30, 40, 50), (0.2, 0.2, 0.2)), 20, 5, 10)
    assert part.data.shape == (1, 5, 20, 20)
    assert part.planes == (0, 2, 4, 6, 8)
    assert part.grid.shape == (10, 20, 20)
    assert part.grid.extent[0] == pytest.approx(6.0)
    y, x = part.corner
    assert y <= 27
    assert y + 20 >= 33
    assert x <= 8
    assert x + 20 >= 14


@pytest.fixture(scope="module")
def truth():
    """A ball off the centre, so that no mirror image of it is the same."""
    z, y, x = ((torch.arange(n) - (n - 1) / 2) * d for n, d in zip(GRID.shape, GRID.spacing, strict=True))
    distance = ((z[:, None, None] - 0.5) ** 2 + (y[:, None] + 0.4) ** 2 + (x - 0.5) ** 2).sqrt()
    return 0.02 * torch.sigmoid((0.9 - distance) / 0.1)


def orders_of(truth, true, declared):
    with torch.no_grad():
        images = image(Volume(GRID, truth, 1.335), MICROSCOPE, true, Fidelity(sources=30))
    data = images + NOISE * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))
    part, noise = part_of(data, None, GRID), [NOISE] * len(data)

    def problem_of(acquisition, slices, recipe):
        setup = part.sliced(slices).setup(1.335, MICROSCOPE, acquisition)
        return Problem.from_recipe(part.data, setup, Fidelity(), recipe, noise=noise)

    return find_orders(declared, problem_of, Recipe(), noise)


def reversed_shears(acquisition):
    return [Prism((-p.shear[0], -p.shear[1]), p.bias) for p in acquisition.prisms]


def test_what_was_declared_stays_where_noise_alone_tells_the_descriptions_apart(truth, monkeypatch):
    """And another description that explains the images as well is named."""
    monkeypatch.setattr("recon.calibration.trials.orders.ROUNDS", (Round(8, 3, 2, 6), Round(2, 4, 3, 6)))
    found = orders_of(0.01 * truth, PAIR, WRONG["sign"])
    assert found.chosen.name == "as declared"
    assert not found.told
    assert found.rival is not None
    assert found.rival.mistakes > 0


WRONG = {
    "as declared": PAIR,
    "sign": Acquisition(reversed_shears(PAIR), FOCUS),
    "focus": Acquisition(PAIR.prisms, FOCUS[::-1]),
    "sign and focus": Acquisition(reversed_shears(PAIR), FOCUS[::-1]),
    "axes": Acquisition([Prism(p.shear[::-1], p.bias) for p in PAIR.prisms], FOCUS),
}


@pytest.mark.parametrize(
    "name", ["sign and focus", *(pytest.param(n, marks=pytest.mark.slow) for n in WRONG if n != "sign and focus")]
)
def test_the_race_finds_what_was_declared_wrongly(truth, name, monkeypatch):
    monkeypatch.setattr("recon.calibration.trials.orders.ROUNDS", (Round(8, 3, 2, 6), Round(2, 4, 3, 6)))
    found = orders_of(truth, PAIR, WRONG[name])
    assert found.chosen.name == name
    assert images_of(found.chosen.acquisition) == images_of(PAIR)
    assert found.told
    assert found.rival is None
    assert name in found.table()


def test_axes_that_are_nearly_across_one_another_have_no_twin():
    """A quarter turn with the prisms exchanged is the declared acquisition within its uncertainty."""
    angles, bias = (math.radians(29.7), math.radians(119.5)), 1.4
    shears = [(0.2 * math.sin(angle), 0.2 * math.cos(angle)) for angle in angles]
    declared = Acquisition([Prism(shear, b) for shear in shears for b in (bias, -bias)], [-1.0, 0.0, 1.0])
    exact = [(0.1, 0.17320508), (0.17320508, -0.1)]
    across = Acquisition([Prism(shear, b) for shear in exact for b in (bias, -bias)], [-1.0, 0.0, 1.0])
    assert len(all_mistakes(declared)) == len(all_mistakes(across))


@pytest.mark.slow
def test_more_mistakes_are_tried_only_where_fewer_explain_nothing(truth, monkeypatch):
    monkeypatch.setattr("recon.calibration.trials.orders.ROUNDS", (Round(8, 3, 2, 6), Round(2, 4, 3, 6)))
    several = [other for other in all_mistakes(PAIR) if other.mistakes > LIKELY]
    assert several
    tried = {tried.otherwise.name for tried in orders_of(truth, PAIR, WRONG["sign and focus"]).tried}
    assert not tried & {other.name for other in several}
    monkeypatch.setattr("recon.calibration.trials.orders.STANDS_OUT", 0.0)
    tried = {tried.otherwise.name for tried in orders_of(truth, PAIR, WRONG["sign and focus"]).tried}
    assert tried == {other.name for other in all_mistakes(WRONG["sign and focus"])}
