"""The time left of a descent: known kinds of steps by their own seconds, others by what they cost."""

import math
from dataclasses import replace

import pytest
import torch

from recon.fit.newton.correction import drafts
from recon.fit.newton.descent import COARSE_STEPS
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.report import forecast as forecast_room
from recon.report.forecast import WITH_GRADIENT, Bar, Forecast, spoken
from torchdic import Acquisition, Condenser, Fidelity, Grid, Microscope, Objective, Prism
from torchdic.planning.cost import work

GRID = Grid((4, 12, 10), (0.5, 0.25, 0.25))
ACQUISITION = Acquisition([Prism((0.0, 0.2), 1.2)], [-1.0, 1.0])


def problem(fidelity=None, **recipe):
    data = 0.3 + 0.1 * torch.rand(1, 2, 12, 10, generator=torch.Generator().manual_seed(0))
    medium = empty_medium(GRID, 1.5, data)
    setup = Setup(medium, Microscope(0.546, Objective(0.6), Condenser(0.4)), ACQUISITION)
    return Problem.from_recipe(data, setup, fidelity or Fidelity(sources=128, padding=4), Recipe(**recipe))


@pytest.mark.parametrize("method", ["newton", "adam"])
@pytest.mark.parametrize("fidelity", [None, 0.1])
def test_the_time_before_the_first_step_is_that_of_all_steps(method, fidelity):
    forecast = Forecast(problem(fidelity, method=method))
    assert forecast.left(0) is None  # before the trial
    whole, left = forecast.whole(), forecast.left(0)
    if fidelity is not None and method == "adam":
        assert whole is left is None  # the fidelity has yet to be planned
    else:
        assert 0 < whole < math.inf
        # Newton's ends by itself, after fewer steps than it may take
        assert whole == pytest.approx(left) if method == "adam" else whole < 0.95 * left


def test_the_trial_is_an_image_with_its_gradient(monkeypatch):
    """Its seconds, over its cost, are the rate of all steps."""
    monkeypatch.setattr(forecast_room, "timed", lambda run, repeats, _: [run() or 2.0] * repeats)
    made = problem(steps=6)
    first = drafts(made.fidelity.coarse, made.fidelity.draft_sources)[0]
    forecast = Forecast(made)
    image = work(first, made.setup.volume, made.setup.microscope, made.setup.acquisition)
    costs = sum(forecast.cost(number) for number in range(6))
    assert forecast.whole() == pytest.approx(2.0 * costs / (WITH_GRADIENT * image))
    assert forecast.whole(5) == pytest.approx(2.0 * forecast.cost(5) / (WITH_GRADIENT * image))


@pytest.mark.parametrize(("first", "later", "counted"), [(0.4, 0.1, 0.1), (2.0, 0.3, 0.3), (40.0, 0.0, 40.0)])
def test_a_first_image_in_which_memory_is_measured_is_not_counted(monkeypatch, first, later, counted):
    """Of one that takes long it is a small part, and another one would take long, too."""
    seconds = iter([first])
    monkeypatch.setattr(forecast_room, "timed", lambda _run, repeats, _: [next(seconds, later) for _ in range(repeats)])
    slow = Forecast(problem(steps=6)).whole()
    seconds = iter([counted] * 9)
    assert slow == pytest.approx(Forecast(problem(steps=6)).whole())


@pytest.mark.parametrize(("seconds", "words"), [(0.2, "1 s"), (99.4, "99 s"), (150, "2 min"), (7200, "2.0 h")])
def test_a_time_in_words(seconds, words):
    assert spoken(seconds) == words


def test_steps_that_cost_what_was_foreseen_leave_what_was_foreseen():
    made = problem(steps=12)
    forecast = Forecast(made)
    costs = [forecast.cost(number) for number in range(12)]
    for number, cost in enumerate(costs[:-1], 1):
        forecast.taken(number, 0.01 * cost)
        assert forecast.left(number) == pytest.approx(0.01 * sum(costs[number:]))
    assert forecast.left(12) == 0


def test_careful_steps_are_known_to_take_longer_before_the_first_of_them():
    forecast = Forecast(problem(steps=20))
    forecast.taken(1, 2.0)
    forecast.taken(2, 1.0)
    assert forecast.left(2) > 20 - 2
    coarse, fine = forecast.cost(1), forecast.cost(COARSE_STEPS + 1)
    assert fine > coarse


def test_a_specimen_in_which_few_directions_mislead_is_foreseen_to_take_longer(monkeypatch):
    def foreseen(misled):
        monkeypatch.setattr(forecast_room, "timed", lambda run, repeats, _: [run() or 2.0] * repeats)
        monkeypatch.setattr(forecast_room, "expected_misled", lambda _: misled)
        forecast = Forecast(problem(steps=20))
        return forecast.whole(), [forecast.cost(number) for number in range(20)]

    (usual, costs), (longer, costs_of_all) = foreseen(False), foreseen(True)
    assert costs[:COARSE_STEPS] == costs_of_all[:COARSE_STEPS]
    assert all(more > less for less, more in zip(costs[COARSE_STEPS:], costs_of_all[COARSE_STEPS:], strict=True))
    assert longer > 1.3 * usual


def going_on(made):
    """The same problem, from a volume that is known."""
    nothing = torch.zeros(made.setup.volume.grid.shape)
    return replace(made, unknowns=[replace(made.unknowns[0], given=nothing), *made.unknowns[1:]])


def test_a_descent_that_goes_on_from_a_volume_has_no_steps_of_the_fewest_directions():
    made = problem(steps=20)
    usual, onward = Forecast(made), Forecast(going_on(made))
    assert onward.cost(1) == usual.cost(COARSE_STEPS + 1) > usual.cost(1)
    assert onward.cost(0) == usual.cost(COARSE_STEPS) > onward.cost(1)  # with all that such steps begin with


def test_another_descents_steps_take_what_those_of_the_first_have_taken():
    made = problem(steps=20)
    first = Forecast(made)
    for number in range(1, 7):
        first.taken(number, 0.01 * first.cost(number - 1))
    other = first.of_another(going_on(replace(made, steps=6)))
    assert not other.untried
    assert other.left(0) == pytest.approx(0.01 * sum(other.cost(number) for number in range(6)))


def test_a_kind_of_step_that_was_seen_is_known_by_its_own_seconds():
    forecast = Forecast(problem(method="adam", steps=10, draft_sources=8))
    for number in range(1, 9):  # the last four steps take all directions, here no longer than the others
        forecast.taken(number, 1.0)
    assert forecast.left(8) == pytest.approx(2.0)


def test_the_bar_says_what_is_left(capsys):
    with Bar(Forecast(problem(steps=12)), 12, 0) as bar:
        bar.step(1, 60.0, 0.5)
        bar.refresh()
    said = capsys.readouterr().err
    assert "1/12 steps" in said
    assert " left, misfit=0.5" in said
    with Bar(Forecast(problem(0.1, steps=12)), 12, 0) as bar:
        bar.refresh()
    assert "time unknown" in capsys.readouterr().err
