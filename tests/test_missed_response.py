"""What few condenser directions miss of a weak specimen's images, and what a fit makes of it."""

from dataclasses import replace

import pytest
import torch

from recon.fit.descent import minimise
from recon.fit.newton import correction
from recon.fit.newton.correction import Correction
from recon.fit.newton.missed import MissedResponse, share_of
from recon.fit.planned import GivenFidelity
from recon.fit.problem import Problem, Recipe
from recon.fit.setup import Setup, empty_medium
from recon.report.metrics import volume_error
from torchdic import Acquisition, Camera, Condenser, Fidelity, Grid, Microscope, Objective, Prism, Volume

GRID = Grid((8, 20, 18), (0.4, 0.2, 0.2))
MICROSCOPE = Microscope(0.546, Objective(0.8), Condenser(0.5))
ACQUISITION = Acquisition([Prism((0.0, 0.24), 1.5), None, Prism((0.24, 0.0), -1.2)], [-1.2, 0.4])
FEW, MANY = Fidelity(sources=6, order=1), Fidelity(sources=40, order=1)
pytestmark = pytest.mark.filterwarnings("ignore::torchdic.errors.WrapAroundWarning")


def setup_of(delta, dtype=torch.float64):
    return Setup(Volume(GRID, delta.to(dtype), 1.5), MICROSCOPE, ACQUISITION)


def blob(highest):
    """A smooth specimen aside of the centre."""
    z, y, x = (GRID.coordinates(axis, dtype=torch.float64) for axis in range(3))
    return highest * torch.exp(-((z[:, None, None] - 0.3) ** 2 + (y[:, None] + 0.4) ** 2 + (x - 0.2) ** 2) / 0.4)


def difference(delta):
    """The images of many directions minus those of few."""
    setup = setup_of(delta)
    with torch.no_grad():
        return setup.formed(MANY) - setup.formed(FEW)


def test_of_a_weak_specimen_it_is_the_difference_of_the_images():
    delta = blob(1e-5)
    true, linear = difference(delta), MissedResponse(setup_of(delta), FEW, MANY)(delta)
    assert float((linear - true).norm() / true.norm()) < 1e-3
    assert share_of(linear, true) == pytest.approx(1, abs=1e-3)


def test_it_is_linear_and_its_gradient_is_the_adjoint():
    missed, random = MissedResponse(setup_of(blob(0.0)), FEW, MANY), torch.Generator().manual_seed(0)
    delta = torch.randn(GRID.shape, dtype=torch.float64, generator=random, requires_grad=True)
    images = missed(delta)
    torch.testing.assert_close(missed(3 * delta), 3 * images)
    residual = torch.randn(images.shape, dtype=torch.float64, generator=random)
    (gradient,) = torch.autograd.grad((images * residual).sum(), delta)
    other = torch.randn(GRID.shape, dtype=torch.float64, generator=random)
    torch.testing.assert_close((gradient * other).sum(), (missed(other) * residual).sum())


def test_a_share_is_believed_as_far_as_the_images_bear_it_out():
    random = torch.Generator().manual_seed(0)
    linear, unlike = torch.randn(2, 5000, generator=random)
    unlike = unlike - linear * (linear @ unlike) / (linear @ linear)
    assert share_of(linear, 0.7 * linear + unlike) == pytest.approx(0.7, abs=1e-5)
    assert share_of(linear, 2 * linear) == 1
    assert share_of(linear, unlike - linear) == 0
    assert share_of(torch.zeros(4), torch.ones(4)) == 0
    shares = [
        share_of(MissedResponse(setup_of(blob(h)), FEW, MANY)(blob(h)), difference(blob(h))) for h in (0.001, 0.3)
    ]
    assert shares[0] > 0.95
    assert shares[1] < 0.5  # strong: light is bent


def test_a_correction_follows_a_weak_specimen():
    """Made at one volume, it serves another: the error that is left is of second order in Δn."""
    at, later = blob(0.002), blob(0.002).roll((1, 2), (1, 2))
    missed = MissedResponse(setup_of(at), FEW, MANY)
    with torch.no_grad():
        made = Correction().renewed(setup_of(at), setup_of(at).formed(FEW), MANY, missed, lambda change: 1.0)
        drafts, careful = setup_of(later).formed(FEW), setup_of(later).formed(MANY)
        followed, held = made.to(drafts, later, missed), made.to(drafts, later, None)
    assert float((followed - careful).norm()) < 0.1 * float((held - careful).norm())


def test_it_is_left_out_where_it_has_no_room_and_where_no_direction_is_missing():
    data = setup_of(blob(0.01), torch.float32).formed(MANY).detach()
    known = replace(setup_of(blob(0.01), torch.float32), volume=empty_medium(GRID, 1.5, data))
    problem = Problem.from_recipe(data, known, MANY, Recipe(draft_sources=6, steps=6))
    wanted = MissedResponse.bytes_for(known, 4)

    def shares(fidelity):
        return [step.state["newton"]["correction"]["share"] for step in minimise(replace(problem, fidelity=fidelity))]

    assert shares(GivenFidelity(MANY, 6, wanted))[-1] > 0.5
    assert shares(GivenFidelity(MANY, 6, wanted - 1))[-1] == 0
    assert shares(GivenFidelity(MANY, None))[-1] == 0


@pytest.mark.slow
def test_noise_is_not_fitted_at_frequencies_that_few_directions_alone_see(monkeypatch):
    """A dim stack: a fit errs as much with few directions as with all, but for what of the response it doesn't know."""
    delta, random = (2 * blob(0.01)).clamp(max=0.01), torch.Generator().manual_seed(4)
    data = Camera(photons=2000.0).record(setup_of(delta, torch.float32).formed(MANY).detach(), random)
    known = replace(setup_of(delta, torch.float32), volume=empty_medium(GRID, 1.5, data))

    def error(sources):
        *_, last = minimise(Problem.from_recipe(data, known, MANY, Recipe(draft_sources=sources)))
        return volume_error(last.delta, delta)

    every = error(None)
    assert error(6) == pytest.approx(every, rel=0.03)
    monkeypatch.setattr(correction, "share_of", lambda linear, true: 0.0)
    assert error(6) > 1.1 * every
